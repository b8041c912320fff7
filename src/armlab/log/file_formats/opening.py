"""Opening files: format detection, hash, bounds on the uncompressed size, optional packages."""

from __future__ import annotations

import hashlib
import mmap
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from armlab.errors import ArmlabError, LogError, MissingExtra

FIRST = 1024
"""Number of bytes needed by `format_of`, because an HDF5 file may start with a user block of 512 bytes."""

BAGS = ("rosbag2", "SQLite (rosbag2)", "ROS 1 bag")
"""Formats recorded by ROS programs, in addition to MCAP."""

_HDF5 = b"\x89HDF\r\n\x1a\n"

_FIRST_BYTES = {
    b"\x89MCAP0\r\n": "MCAP",
    _HDF5: "HDF5",
    b"MATLAB 7.3": "MAT v7.3",
    b"PAR1": "Parquet",
    b"MATLAB 5.0": "MAT v5",
    b"SQLite format 3\0": "SQLite (rosbag2)",
    b"#ROSBAG V": "ROS 1 bag",
    b"\x1f\x8b": "gzip",
    b"\x28\xb5\x2f\xfd": "zstd",
    b"PK\x03\x04": "zip",
}


def format_of(first: bytes) -> str:
    """Return the file format indicated by the first bytes: "MCAP", "LabComm", ..., "text", "empty" or "unknown"."""
    if not first:
        return "empty"
    for magic, name in _FIRST_BYTES.items():
        if first.startswith(magic):
            return name
    if first.startswith((b"\0\0\0\2", b"\x0bLabComm2013")) or (first[0] == 1 and b"LabComm2014" in first[:20]):
        return "LabComm"
    if first[512:520] == _HDF5:
        return "HDF5"
    text = b"\0" not in first and first[0] >= 9  # text does not start with a control character
    return "text" if text else "unknown"


def is_text(path: str | Path) -> bool:
    """Return whether a file exists and begins with text or gzip data, for `log.read_csv`."""
    return format_at(path) in ("text", "gzip")


def format_at(path: str | Path) -> str:
    """Return the format of a file, "rosbag2" for a rosbag2 folder; "" if unreadable."""
    path = Path(path)
    if path.is_dir() and ((path / "metadata.yaml").is_file() or bag_files(path)):
        return "rosbag2"
    if not path.is_file():
        return ""
    try:
        with path.open("rb") as file:
            return format_of(file.read(FIRST))
    except OSError:
        return ""


def bag_files(folder: Path) -> list[Path]:
    """Return the files of a rosbag2 in order, run/run_0.mcap, run/run_1.mcap, ...; empty for other folders."""
    name = re.escape(folder.resolve().name)
    numbers = {one: re.fullmatch(rf"{name}_(\d+)\.(mcap|db3)", one.name) for one in folder.iterdir()}
    return [one for _, one in sorted((int(found[1]), one) for one, found in numbers.items() if found)]


def check_readable(path: str | Path) -> None:
    """Check that a file exists and is an MCAP recording."""
    try:
        if Path(path).is_fifo():  # opening a FIFO waits for a writer
            raise LogError(f"Expected a log at {path}, got a pipe. Pass a file, because reading needs random access.")
        with Path(path).open("rb") as file:
            first = file.read(FIRST)
    except OSError as error:
        raise LogError(f"Expected a log at {path}, got: {error.strerror}.") from None
    found = format_of(first)
    if found == "MCAP":
        return
    if found == "empty":
        raise LogError(f"Expected a log at {path}, got an empty file.")
    shown = f"{found} ({first[:8].hex(' ')})" if found == "unknown" else found
    raise LogError(
        f"Expected an MCAP log at {path}, got a file of format {shown}; MCAP files begin with 89 4d 43 41 50."
    )


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path of the file to a LogError that does not name it."""
    try:
        yield
    except LogError as error:
        if re.search(rf"(?<!\w){re.escape(str(path))}(?!\w)", str(error)):
            raise
        raise LogError(f"Expected a valid log in {path}, got an error: {error}") from None


@contextmanager
def undamaged(what: str, raised: Any = Exception) -> Iterator[None]:
    """Convert the various errors that readers raise for corrupt files to a one-line LogError."""
    try:
        yield
    except ArmlabError:
        raise
    except raised as error:
        words = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise LogError(f"Expected a valid {what}, got a corrupt one: {words[:200]}.") from None


@contextmanager
def opened(path: Path) -> Iterator[memoryview]:
    """Map a file into memory."""
    try:
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise LogError(f"Expected a log at {path}, got: {error}.") from None
    yield memoryview(mapped)  # the mapping is released with the last array that uses it


_ANY, _RATIO = 1 << 26, 1000  # bytes that are always allowed; maximum expansion ratio above that (constant columns)


def check_unpacked_size(path: Path, size: int) -> None:
    """Reject a file whose contents would expand far beyond its size."""
    most = max(_ANY, _RATIO * path.stat().st_size)
    if size > most:
        raise LogError(
            f"Expected arrays of at most {most} bytes in {path}, {_RATIO} times its size, got {size}. If you trust "
            "the file, write it without compression."
        )


def needed(module: str, purpose: str, otherwise: str = "") -> Any:
    """Import a module of the extra `data`."""
    try:
        return import_module(module)
    except ImportError:
        package, rest = module.partition(".")[0], f", {otherwise}" if otherwise else ""
        raise MissingExtra(
            f"Expected the package {package} {purpose}, but it is not installed. Install it: pip install "
            f"'armlab[data]'{rest}."
        ) from None


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def origin(path: str | Path) -> str:
    """Return the first source entry of a table: file name and hash (for a folder, of all its files)."""
    path = Path(path)
    if not path.is_dir():
        return f"{path.name} sha256 {file_hash(path)}"
    files = [f"{one.name} {file_hash(one)}\n" for one in sorted(path.iterdir()) if one.is_file()]
    return f"{path.name} sha256 {hashlib.sha256(''.join(files).encode()).hexdigest()}"
