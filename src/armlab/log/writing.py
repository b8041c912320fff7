"""`write` stores a `Table` in a file that `read`, a spreadsheet or another program can open."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from armlab.errors import ConfigError, LogError, ShapeError
from armlab.log.column import Column
from armlab.log.file_formats.delimited import describe, sidecar_path, write_csv
from armlab.log.file_formats.description import Progress
from armlab.log.file_formats.hdf5_parquet import write_hdf5, write_parquet
from armlab.log.file_formats.mat import write_mat
from armlab.log.file_formats.rosbag2 import write_rosbag2
from armlab.log.recording.file import RecordingFile
from armlab.log.recording.rows import RowLayout
from armlab.log.table import Table
from armlab.robots import Robot

_EXACT = 2**53  # integers up to this value are exact as floats
_TOLD = 1000  # rows of a recording between two progress reports
_FILES: dict[str, Callable[[Table, BinaryIO, Progress], None]] = {
    ".csv": write_csv,
    ".mat": write_mat,
    ".parquet": write_parquet,
    ".h5": write_hdf5,
    ".hdf5": write_hdf5,
}
ENDINGS = (".mcap", *_FILES, ".rosbag2")
"""File extensions that determine the format in `write`."""


def write(
    table: Table,
    path: str | Path,
    robot: Robot | None = None,
    *,
    storage: str = "mcap",
    progress: Progress | None = None,
) -> Path:
    """Write a table to a file, and return its path; an existing file is replaced atomically or not at all.

    `read` restores the same table from every format, including its provenance. With MCAP and rosbag2, values are equal
    up to rounding, because stamps are whole nanoseconds and poses are quaternions. The extension determines the format:

    * ``.mcap``: a recording; needs `robot` for the names of topics and joints.
    * ``.csv``: ``t [s],q1 [rad],...``, with the fewest digits that read back exactly; missing values are empty. All
      other column attributes are in ``run.csv.toml``.
    * ``.mat``: MATLAB, version 5; one variable per column, units in a struct; columns up to 2 GB.
    * ``.parquet``: a flat column per component, units in the fields' metadata; needs pyarrow.
    * ``.h5``, ``.hdf5``: a dataset (N, ...) per column with attributes unit and kind; needs h5py.
    * ``.rosbag2``: a folder for ROS 2, standard messages only.

    Parameters
    ----------
    table : table to write; MCAP stores neither text columns nor user-defined counts above 2^53.
    path : path of the file, or the folder of a rosbag2.
    robot : the arm, required for MCAP; in a rosbag2, the joint names of its URDF replace the labels.
    storage : storage format of a rosbag2, mcap or sqlite3; releases before Iron read SQLite without a plugin.
    progress : called with (done, total, what).

    Raises
    ------
    ConfigError : the file extension is unknown, or no robot is given for MCAP output.
    LogError : the file cannot be written, or the format cannot hold the table.
    MissingExtra : pyarrow or h5py is not installed.
    RobotError : `robot` is not a Robot.
    ShapeError : the argument is not a table, or a column does not match the robot's joints.
    """
    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    path, tell = Path(path), progress or (lambda done, total, what: None)
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ConfigError(f"Expected a file name that ends in {', '.join(ENDINGS)}, got {path}. Change the extension.")
    _check_text(table)
    part = path.with_name(f".{path.name}.part")
    try:
        _remove(part)
        if ending in _FILES:
            _write_file(table, part, path, tell)
        elif ending == ".mcap":
            _write_mcap(table, part, path, robot, tell)
        else:
            _write_bag(table, part, path, storage, robot, tell)
    except OSError as error:
        what = (error.strerror or str(error)).rstrip(".")
        raise LogError(f"Expected to create the file {path}, got: {what}.") from None
    finally:
        for left in (part, sidecar_path(part)):
            with contextlib.suppress(OSError):
                _remove(left)
    return path


def _write_file(table: Table, part: Path, path: Path, tell: Progress) -> None:
    with part.open("wb") as file:
        _FILES[path.suffix.lower()](table, file, tell)
    if path.suffix.lower() == ".csv":
        beside = sidecar_path(part)
        beside.write_text(describe(table), encoding="utf-8")
        beside.replace(sidecar_path(path))
    part.replace(path)


def _write_bag(table: Table, part: Path, path: Path, storage: str, robot: Robot | None, tell: Progress) -> None:
    """Write to a subfolder of `part`, because rosbags names the message file after its folder."""
    if path.exists() and not (path / "metadata.yaml").is_file():
        raise LogError(f"Expected a new name or an existing rosbag2 to replace, but {path} is neither. Move it away.")
    if robot is not None:
        for name in (f"{kind}{ending}" for kind in ("q", "qd", "tau") for ending in ("", "_ref", "_sent")):
            if name in table.names and table[name].shape[1:] != (robot.n,):
                raise _misfit(name, table, (robot.n,), robot)
    part.mkdir()
    write_rosbag2(table, part / path.name, storage, tell, () if robot is None else robot.ros_joint_names)
    if path.exists():
        path.replace(part / "old")
    (part / path.name).replace(path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _check_text(table: Table) -> None:
    """Reject text that files cannot store: NUL terminates strings in HDF5 and ROS; lone surrogates are invalid
    Unicode."""
    for name in table.names:
        if table[name].dtype.kind != "U":
            continue
        for row, word in enumerate(table[name].reshape(len(table), -1).tolist() if len(table) else ()):
            text = "".join(word)
            if "\0" in text or text != text.encode(errors="ignore").decode():
                raise LogError(
                    f"Expected text without NUL or lone surrogates in the column {name!r}, got {word} in row {row}."
                )


def _misfit(name: str, table: Table, shape: tuple[int, ...], robot: Robot) -> ShapeError:
    return ShapeError(
        f"Expected {name} of shape ({len(table)}, {', '.join(map(str, shape))}) for robot {robot.name!r} with "
        f"{robot.n} joints, got {table[name].shape}. Pass the robot that was logged."
    )


def _write_mcap(table: Table, part: Path, path: Path, robot: Robot | None, tell: Progress) -> None:
    if robot is None:
        raise ConfigError(
            f"Expected a robot for the table in {path}, got none. Pass robot= (or --robot on the command "
            "line), or write a .csv file."
        )
    standard = RowLayout(robot).slots
    extra = {name: table.columns[name] for name in table.names if name not in standard}
    layout = RowLayout(robot, {**extra, "t": Column()})
    stamps = table.t0_ns + np.round(table.t * 1e9).astype(np.int64)
    values = {"tick": np.arange(len(table)), "session": np.ones(len(table)), "stamp_ns": stamps, "t": table.t}
    values |= {name: table[name] for name in table.names}
    block = np.tile(np.frombuffer(layout.pack_values({}), dtype=np.uint8), (len(table), 1))
    for name, array in values.items():
        slot = layout.slots[name]
        if array.shape != (len(table), *slot.column.shape):
            raise _misfit(name, table, slot.column.shape, robot)
        if slot.dtype == "<f8" and array.dtype.kind == "i" and ((array > _EXACT) | (array < -_EXACT)).any():
            raise LogError(
                f"Expected counts up to 2^53 in {name!r} for MCAP, which stores user-defined columns as real numbers, "
                "got larger counts. Write another format."
            )
        if slot.missing is not None:
            array = np.where(np.isfinite(array), array, slot.missing)
        raw = np.ascontiguousarray(array, dtype=slot.dtype).reshape(-1).view(np.uint8)
        block[:, slot.start : slot.stop] = raw.reshape(len(table), slot.stop - slot.start)
    file = RecordingFile(part, robot, layout, {}, "; ".join(table.source), (table.t0_ns, table.clock))
    try:
        for done in range(0, len(block), _TOLD):
            file.write([row.tobytes() for row in block[done : done + _TOLD]], done)  # indices are unique, ticks are not
            tell(done, len(block), "rows")
        file.finish({"rows": len(table), "source": list(table.source)})
    except BaseException:
        file.abandon()
        raise
    part.replace(path)
