"""`write`: a `Table` becomes a file that `read`, a spreadsheet or another program opens."""

from __future__ import annotations

import contextlib
import csv
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armlab.errors import ConfigError, LogError, ShapeError
from armlab.log.column import Column
from armlab.log.recording_file import RecordingFile
from armlab.log.rows import RowLayout
from armlab.log.sidecar import describe, headings, sidecar_path
from armlab.log.table import Table

if TYPE_CHECKING:
    from armlab.robots import Robot

__all__ = ["write"]


def write(table: Table, path: str | Path, robot: Robot | None = None) -> Path:
    """Write a table to a file and return its path; an existing file is replaced in one step or not at all.

    MCAP keeps everything: units, kinds, frames, labels; `read` gives the same table back. CSV has one column per
    component and the unit in the header, ``t [s],q1 [rad],...``; the shortest digits that read back equal; nothing
    between the commas where a value is missing. Kinds, frames and labels go to a file beside it, ``run.csv.toml``, with
    which `read` gives the same table back; without it, all that a header can say.

    Parameters
    ----------
    table : to write; no columns of text in MCAP.
    path : ends in ``.mcap`` or ``.csv``.
    robot : the arm, for MCAP: its name and its joints are in the topics.

    Raises
    ------
    ConfigError : another ending, or no robot for MCAP. LogError : the file cannot be created. RobotError : something
    else than a robot. ShapeError : something else than a table, or a column that does not fit the robot's joints.
    """
    if not isinstance(table, Table):
        raise ShapeError.no_table(table)
    path = Path(path)
    if path.suffix.lower() not in (".mcap", ".csv"):
        raise ConfigError(f"Expected a file name that ends in .mcap or .csv, got {path}. Change the ending.")
    temporary = path.with_name(f".{path.name}.part")
    beside = sidecar_path(temporary)
    try:
        if path.suffix.lower() == ".csv":
            _write_csv(table, temporary)
            beside.write_text(describe(table), encoding="utf-8")
            beside.replace(sidecar_path(path))
        elif robot is None:
            raise ConfigError(f"Expected the robot of the table for {path}, got none. Give robot=, or write a .csv.")
        else:
            _write_mcap(table, temporary, robot)
        temporary.replace(path)
    except OSError as error:
        raise LogError(f"Expected to create the file {path}, got: {error.strerror}.") from None
    finally:
        for part in (temporary, beside):
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
    return path


def _write_csv(table: Table, path: Path) -> None:
    header, columns = ["t [s]"], [table.t]
    for name in table.names:
        values = table[name]
        header += headings(name, replace(table.columns[name], shape=values.shape[1:]))
        columns += [values[(slice(None), *place)] for place in np.ndindex(values.shape[1:])]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(zip(*(_words(column) for column in columns), strict=True))


def _words(values: np.ndarray) -> list[str]:
    if values.dtype.kind != "f":
        return [str(value) for value in (values.astype(int) if values.dtype.kind == "b" else values).tolist()]
    return ["" if value != value else repr(value) for value in values.tolist()]  # only NaN differs from itself


def _write_mcap(table: Table, path: Path, robot: Robot) -> None:
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
            raise ShapeError(
                f"Expected {name} of shape ({len(table)}, {', '.join(map(str, slot.column.shape))}) for robot "
                f"{robot.name!r} of {robot.n} joints, got {array.shape}. Name the robot that was logged."
            )
        if slot.missing is not None:
            array = np.where(np.isfinite(array), array, slot.missing)
        raw = np.ascontiguousarray(array.reshape(len(table), -1), dtype=slot.dtype)
        block[:, slot.start : slot.stop] = raw.view(np.uint8).reshape(len(table), -1)
    path.unlink(missing_ok=True)
    file = RecordingFile(path, robot, layout, {}, "; ".join(table.source))
    for row in block:
        file.write(row.tobytes())
    file.finish({"rows": len(table), "source": list(table.source)})
