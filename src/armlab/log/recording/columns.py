"""Columns of a recording in its MCAP file, and the messages that define its rows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armlab.errors import LogError, UnknownName
from armlab.lie import quaternion, se3
from armlab.log.assembly import in_time_order, recording_clock, wall_at_zero
from armlab.log.column import Column
from armlab.log.file_formats.description import Progress
from armlab.log.mcap.decode import Decoded, decode
from armlab.log.mcap.records import Contents
from armlab.log.recording.ros_messages import CLOCK_KEY, CLOCK_NAME_KEY, COLUMN_KEY, T0_KEY, topic_name
from armlab.log.recording.rows import with_holes
from armlab.log.table import Table

CLOCK_COLUMNS = ("t", "robot_ns", "session_t", "session")
"""Columns that define the clock of a recording."""

_QUATERNION_LENGTH = 1e-3  # tolerance on the norm of a quaternion


@dataclass(frozen=True, slots=True)
class Source:
    """Location of one column in a file: its channel and message fields, with its description."""

    channel: int
    fields: tuple[str, ...]
    column: Column
    missing: int | None
    encoding: str


@dataclass(frozen=True, slots=True)
class Rows:
    """All rows (N,) of one robot in a recording; `kept` is the mask of the rows in its table."""

    channel: int
    sequence: np.ndarray
    t: np.ndarray
    kept: np.ndarray
    stamp_ns: np.ndarray
    t0_ns: int
    clock: str


def clocks(found: Contents) -> dict[int, str]:
    """Return the channels whose messages are rows, one per robot, with their topics."""
    return {number: channel.topic for number, channel in found.channels.items() if CLOCK_KEY in channel.metadata}


def clock_channel(found: Contents, path: Path, robot: str | None) -> int:
    """Return the channel whose messages are the rows of a robot (default: the only robot)."""
    robots = clocks(found)
    if not robots:
        topics = ", ".join(f"{c.topic} ({c.type})" for c in found.channels.values()) or "none"
        raise LogError(f"Expected an armlab recording in {path}, got an MCAP file without columns; topics: {topics}.")
    names = {topic.strip("/").rpartition("/")[0]: number for number, topic in robots.items()}
    if robot is not None:
        if topic_name(robot) not in names:
            raise UnknownName.among("robot in this file", robot, names)
        return names[topic_name(robot)]
    if len(names) > 1:
        raise LogError(
            f"Expected the name of one robot (robot=, or --robot or --arm on the command line) for {path}, which holds "
            f"{', '.join(sorted(names))}."
        )
    return next(iter(robots))


def sources_of(found: Contents, clock: int) -> dict[str, Source]:
    """Return the location of each column of the robot that the clock channel belongs to."""
    prefix = found.channels[clock].topic.rpartition("/")[0] + "/"
    sources: dict[str, Source] = {}
    for number, channel in sorted(found.channels.items(), key=lambda item: item[0] == clock):  # clock last
        if not channel.topic.startswith(prefix):
            continue
        for key, text in channel.metadata.items():
            if key.startswith(COLUMN_KEY):
                sources[key.removeprefix(COLUMN_KEY)] = _source(number, channel.topic, key, text)
    return sources


def _source(channel: int, topic: str, key: str, text: str) -> Source:
    try:
        about = json.loads(text)
        shape, labels = tuple(int(size) for size in about["shape"]), tuple(about["labels"])
        column = Column(shape, about["unit"], about["frame"], labels, about["kind"])
        fields = tuple(about["fields"])
        if not all(isinstance(one, str) for one in fields):
            raise TypeError("fields that are not strings")
        return Source(channel, fields, column, about.get("missing"), about.get("encoding", ""))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise LogError(f"Expected a description of a column in {key} of {topic}, got {text!r} ({error}).") from None


def _values(name: str, source: Source, decoded: Decoded, rows: Decoded, damage: list[str]) -> np.ndarray | None:
    """Return a column aligned with the rows of the table, or None if no message contains it; add faults to `damage`."""
    parts = [decoded.fields.get(path) for path in source.fields]
    there = [part for part in parts if part is not None]
    if len(there) < len(parts) or not parts:
        return None
    array = there[0] if len(there) == 1 else np.concatenate(there, axis=1)
    array = with_holes(array, source.missing)
    if source.encoding:
        array, lost = _poses(array, name)
        if lost:
            damage.append(f"{lost} rows of {name} are missing: their quaternions do not have unit norm")
    size = int(np.prod(source.column.shape))
    if array.shape[1] != size:
        raise LogError(f"Expected {size} values in a row of {name}, got {array.shape[1]}.")
    array = array.reshape(len(array), *source.column.shape)
    return _on_rows(array, decoded.sequence, rows.sequence)


def _poses(array: np.ndarray, name: str) -> tuple[np.ndarray, int]:
    """Convert positions and quaternions xyzw (k, 7) to matrices (k, 16), NaN if invalid; count the invalid rows."""
    if array.shape[1] != 7:
        raise LogError(f"Expected 7 numbers per pose in {name}, got {array.shape[1]}.")
    no_pose = np.abs(np.linalg.norm(array[:, 3:], axis=1) - 1.0) > _QUATERNION_LENGTH  # False where values are missing
    array = np.where(no_pose[:, None], np.nan, array)
    matrices = se3.from_rp(quaternion.to_matrix(array[:, [6, 3, 4, 5]]), array[:, :3])
    return matrices.reshape(len(array), 16), int(no_pose.sum())


def _on_rows(array: np.ndarray, sequence: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Assign values to the rows with matching sequence numbers; other rows are NaN."""
    if np.array_equal(sequence, rows):
        return array
    order = np.argsort(rows, kind="stable")
    place = np.searchsorted(rows[order], sequence).clip(0, max(len(rows) - 1, 0))
    place = order[place] if len(rows) else place
    match = rows[place] == sequence if len(rows) else np.zeros(len(sequence), dtype=bool)
    result = np.full((len(rows), *array.shape[1:]), np.nan)
    result[place[match]] = array[match]
    return result


def kept_clock(found: Contents, sources: Mapping[str, Source], t0_ns: int, clock: str) -> tuple[int, str]:
    """Return the wall-clock time at t = 0 [ns] and the clock name of a column `t`; values that are not stored default
    to those given."""
    about = found.channels[sources["t"].channel].metadata if "t" in sources else {}
    return int(about.get(T0_KEY, t0_ns)), about.get(CLOCK_NAME_KEY, clock)


def columns_at(
    view: memoryview, found: Contents, clock: int, sources: Mapping[str, Source], progress: Progress | None = None
) -> tuple[dict[str, np.ndarray], Decoded, list[str]]:
    """Return the columns, the clock messages, and notes on damage."""
    fields: dict[int, list[str]] = {clock: []}
    for source in sources.values():
        fields.setdefault(source.channel, []).extend(source.fields)
    decoded, damage = decode(view, found, fields, progress)
    rows = decoded[clock]
    values = {name: _values(name, one, decoded[one.channel], rows, damage) for name, one in sources.items()}
    return {name: array for name, array in values.items() if array is not None}, rows, damage


def rows_of(view: memoryview, found: Contents, path: Path, robot: str | None = None) -> Rows:
    """Return the rows of a robot in a recording, without their columns."""
    clock = clock_channel(found, path, robot)
    sources = sources_of(found, clock)
    needed = {name: sources[name] for name in CLOCK_COLUMNS if name in sources}
    values, rows, _ = columns_at(view, found, clock, needed)
    t, name = recording_clock(values, rows.log_ns)
    kept, _ = in_time_order(t)
    first = np.flatnonzero(kept)[:1]
    t0_ns, name = kept_clock(found, sources, wall_at_zero(t[first], rows.log_ns[first]), name)
    return Rows(clock, rows.sequence, t, kept, rows.log_ns, t0_ns, name)


def earlier(view: memoryview, found: Contents) -> tuple[str, ...]:
    """Return the provenance of the rows in a file written by `write`, `cut` or `merge`."""
    chain = summary_of(view, found).get("source", [])
    return tuple(str(entry) for entry in chain) if isinstance(chain, list) else ()


def summary_of(view: memoryview, found: Contents) -> dict[str, Any]:
    """Return the summary at the end of a recording, or an empty summary."""
    for one in found.attachments:
        if one.name == "summary.json":
            try:
                summary = json.loads(bytes(view[slice(*one.data)]))
            except (ValueError, RecursionError):
                return {}
            return summary if isinstance(summary, dict) else {}
    return {}


def torn_sentence(path: Path, found: Contents, table: Table) -> str:
    """Return a note on the data recovered from an unfinished file, and on how to repair the file."""
    seconds = float(table.t[-1] - table.t[0]) if len(table) else 0.0
    return (
        f"{path.name} was not finished: recovered {len(table)} rows ({seconds:.3f} s), {found.torn} bytes truncated; "
        f"`armlab log recover {path.name}` writes a complete file"
    )
