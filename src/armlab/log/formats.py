"""Which format a file has, told by its first bytes, not by its name."""

from __future__ import annotations

from pathlib import Path

from armlab.errors import LogError

__all__ = ["check_readable", "format_of", "is_labcomm", "is_text"]

_FIRST_BYTES = {
    b"\x89MCAP0\r\n": "MCAP",
    b"\x89HDF\r\n\x1a\n": "HDF5",
    b"PAR1": "Parquet",
    b"MATLAB 5.0": "MAT v5",
    b"SQLite format 3\0": "SQLite (rosbag2)",
    b"#ROSBAG V": "ROS 1 bag",
    b"\x1f\x8b": "gzip",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"PK\x03\x04": "zip",
}


def format_of(first: bytes) -> str:
    """Return the name of the format that begins so: "MCAP", "LabComm", ..., "text", "empty" or "unknown"."""
    if not first:
        return "empty"
    for magic, name in _FIRST_BYTES.items():
        if first.startswith(magic):
            return name
    if first.startswith((b"\0\0\0\2", b"\x0bLabComm2013")) or (first[0] == 1 and b"LabComm2014" in first[:20]):
        return "LabComm"
    text = b"\0" not in first and sum(byte < 9 for byte in first) == 0
    return "text" if text else "unknown"


def is_text(path: str | Path) -> bool:
    """Tell whether a file is there and begins as text or gzip, which `log.read_csv` reads."""
    return _begins(Path(path)) in ("text", "gzip")


def is_labcomm(path: str | Path) -> bool:
    """Tell whether a file is there and begins as a LabComm stream, which `log.read_labcomm` reads."""
    return _begins(Path(path)) == "LabComm"


def _begins(path: Path) -> str:
    if not path.is_file():
        return ""
    try:
        with path.open("rb") as file:
            return format_of(file.read(64))
    except OSError:
        return ""


def check_readable(path: str | Path) -> None:
    """Check that a file is there and is a recording in MCAP.

    Raises
    ------
    LogError : the file is missing, empty, a pipe or of another format; says which was expected and which came.
    """
    try:
        if Path(path).is_fifo():  # opening it would wait for a writer
            raise LogError(f"Expected a log at {path}, got a pipe; a log is read in any order, so it must be a file.")
        with Path(path).open("rb") as file:
            first = file.read(64)
    except OSError as error:
        raise LogError(f"Expected a log at {path}, got: {error.strerror}.") from None
    found = format_of(first)
    if found == "MCAP":
        return
    if found == "empty":
        raise LogError(f"Expected a log at {path}, got an empty file.")
    shown = f"{found} ({first[:8].hex(' ')})" if found == "unknown" else found
    raise LogError(
        f"Expected a log in MCAP at {path}, got a file of format {shown}; MCAP files begin with 89 4d 43 41 50."
    )
