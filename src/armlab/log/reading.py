"""`read`: a file becomes a `Table`, finished or torn."""

from __future__ import annotations

import json
import mmap
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armlab.errors import ArmlabError, LogError, UnknownName
from armlab.lie import quaternion, se3
from armlab.log.assemble import recording_table
from armlab.log.column import Column
from armlab.log.delimited import read_csv
from armlab.log.formats import check_readable, format_at
from armlab.log.hdf5_file import read_hdf5
from armlab.log.labcomm import read_labcomm
from armlab.log.mat_table import read_mat_table
from armlab.log.mcap_decode import Decoded, decode
from armlab.log.mcap_records import DAMAGE, Contents, contents
from armlab.log.messages import CLOCK_KEY, COLUMN_KEY
from armlab.log.parquet_file import read_parquet
from armlab.log.provenance import file_hash
from armlab.log.rosbag2_file import read_rosbag2
from armlab.log.rows import with_holes
from armlab.log.table import Table

__all__ = ["Source", "opened", "read", "torn_sentence"]

_READERS: dict[str, Callable[[Path], Table]] = {
    "text": read_csv,
    "gzip": read_csv,
    "LabComm": read_labcomm,
    "MAT v5": read_mat_table,
    "MAT v7.3": read_mat_table,
    "rosbag2": read_rosbag2,
}
_COLUMN_READERS = {"HDF5": read_hdf5, "Parquet": read_parquet}  # which read single columns
_QUATERNION_LENGTH = 1e-3  # difference from one
_CLOCK_COLUMNS = ("t", "robot_ns", "session_t", "session")


@dataclass(frozen=True, slots=True)
class Source:
    """One column in a file: its channel, the fields of the message that hold it, its description."""

    channel: int
    fields: tuple[str, ...]
    column: Column
    missing: int | None
    encoding: str


def read(
    path: str | Path, columns: Sequence[str] | None = None, *, robot: str | None = None, raw: bool = False
) -> Table:
    """Return the table that a file holds: a recording, or any format that `write` writes.

    Also LabComm streams (`read_labcomm`), and text, MAT, HDF5 and Parquet files of other programs, where numbered
    columns of a known name are put together and units converted (`read_csv`).

    An unfinished or damaged file is read as far as it goes, with one warning and a note. Rows whose time does not
    advance are dropped and counted in the notes.

    Parameters
    ----------
    path : file, or folder of a rosbag2; the format is told by the first bytes.
    columns : names of the columns wanted, all when None.
    robot : name of the robot, when the file holds several.
    raw : keep rows whose time does not advance.

    Returns
    -------
    Table : t = 0 at the first row, on the robot's clock where it was recorded. Absent data have no column.

    Raises
    ------
    LogError : the file is missing, of another format, damaged beyond use, or an MCAP file of another program.
    MissingExtra : pyarrow or h5py is not installed.
    UnknownName : a wanted column does not exist; lists those that do.
    """
    path = Path(path)
    kind = format_at(path)
    if kind in _READERS or kind in _COLUMN_READERS:
        table = _READERS[kind](path) if kind in _READERS else _COLUMN_READERS[kind](path, columns)
        return table if columns is None else table.select(*columns)
    check_readable(path)
    with opened(path) as view, ThreadPoolExecutor(1) as background:
        hashed = background.submit(file_hash, path)
        try:
            found = contents(view)
            table, damage = _read_mcap(view, found, path, columns, robot, raw)
        except ArmlabError:
            raise
        except DAMAGE as error:
            raise LogError(f"Expected a whole recording in {path}, got a damaged one ({error}).") from None
        source = (f"{path.name} sha256 {hashed.result()}", *_earlier(view, found))
    notes = [sentence for _, sentence in found.damaged] + damage
    if not found.finished:
        notes.insert(0, torn_sentence(path, found, table))
    if notes:
        warnings.warn("; ".join(notes[:3]), stacklevel=2)
    return replace(table, notes=(*notes, *table.notes), source=(*source, *table.source))


def _earlier(view: memoryview, found: Contents) -> tuple[str, ...]:
    """Return where the table in a file of `write` had come from."""
    summary = next((bytes(view[slice(*one.data)]) for one in found.attachments if one.name == "summary.json"), b"{}")
    try:
        chain = json.loads(summary).get("source", [])
    except (ValueError, AttributeError):
        return ()
    return tuple(str(entry) for entry in chain) if isinstance(chain, list) else ()


def torn_sentence(path: Path, found: Contents, table: Table) -> str:
    """Return what was recovered from an unfinished file and how to repair it."""
    seconds = float(table.t[-1] - table.t[0]) if len(table) else 0.0
    return (
        f"{path.name} was not finished: recovered {len(table)} rows ({seconds:.3f} s), {found.torn} bytes torn; "
        f"`armlab log recover {path.name}` writes a whole file"
    )


@contextmanager
def opened(path: Path) -> Iterator[memoryview]:
    """Map a file into memory.

    Raises
    ------
    LogError : it cannot be opened.
    """
    try:
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise LogError(f"Expected a log at {path}, got: {error}.") from None
    yield memoryview(mapped)  # released with the last array that looks at it


def _read_mcap(
    view: memoryview, found: Contents, path: Path, columns: Sequence[str] | None, robot: str | None, raw: bool
) -> tuple[Table, list[str]]:
    clock = _clock_channel(found, path, robot)
    sources = _sources(found, clock)
    wanted = list(sources) if columns is None else list(columns)
    for name in wanted:
        if name not in sources:
            raise UnknownName.among("column", name, sources)
    needed = dict.fromkeys([*wanted, *(name for name in _CLOCK_COLUMNS if name in sources)])
    fields: dict[int, list[str]] = {clock: []}
    for name in needed:
        fields.setdefault(sources[name].channel, []).extend(sources[name].fields)
    decoded, damage = decode(view, found, fields)
    rows = decoded[clock]
    values: dict[str, np.ndarray] = {}
    for name in needed:
        array = _values(name, sources[name], decoded[sources[name].channel], rows, damage)
        if array is not None:
            values[name] = array
    described = {name: sources[name].column for name in values}
    try:
        table = recording_table(values, described, rows.log_ns, raw=raw)
    except ArmlabError as error:  # the file's descriptions contradict the glossary or each other
        raise LogError(f"Expected columns that armlab knows in {path}, got others: {error}") from None
    if columns is None:
        return table, damage
    empty = [name for name in wanted if name not in table]
    if empty:
        raise LogError(f"Expected values of {', '.join(empty)} in {path}, got none in {len(table)} rows.")
    return table.select(*wanted), damage


def _clock_channel(found: Contents, path: Path, robot: str | None) -> int:
    """Return the channel whose messages are the rows."""
    clocks = {number: channel.topic for number, channel in found.channels.items() if CLOCK_KEY in channel.metadata}
    if not clocks:
        topics = ", ".join(f"{c.topic} ({c.type})" for c in found.channels.values()) or "none"
        raise LogError(f"Expected a recording of armlab in {path}, got an MCAP file without columns; topics: {topics}.")
    names = {topic.strip("/").rpartition("/")[0]: number for number, topic in clocks.items()}
    if robot is not None:
        if robot not in names:
            raise UnknownName.among("robot in this file", robot, names)
        return names[robot]
    if len(names) > 1:
        raise LogError(f"Expected the name of one robot (robot=) for {path}, which holds {', '.join(sorted(names))}.")
    return next(iter(clocks))


def _sources(found: Contents, clock: int) -> dict[str, Source]:
    """Return where each column of the robot of this clock channel is."""
    prefix = found.channels[clock].topic.rpartition("/")[0] + "/"
    sources: dict[str, Source] = {}
    for number, channel in sorted(found.channels.items(), key=lambda item: item[0] == clock):  # its columns last
        if not channel.topic.startswith(prefix):
            continue
        for key, text in channel.metadata.items():
            if key.startswith(COLUMN_KEY):
                sources[key.removeprefix(COLUMN_KEY)] = _source(number, channel.topic, key, text)
    return sources


def _source(channel: int, topic: str, key: str, text: str) -> Source:
    try:
        about = json.loads(text)
        column = Column(
            shape=tuple(int(size) for size in about["shape"]),
            unit=about["unit"],
            frame=about["frame"],
            labels=tuple(about["labels"]),
            kind=about["kind"],
        )
        return Source(channel, tuple(about["fields"]), column, about.get("missing"), about.get("encoding", ""))
    except (ValueError, KeyError, TypeError) as error:
        raise LogError(f"Expected a description of a column in {key} of {topic}, got {text!r} ({error}).") from None


def _values(name: str, source: Source, decoded: Decoded, rows: Decoded, damage: list[str]) -> np.ndarray | None:
    """Return a column brought to the rows of the table; None when no message holds it. Adds to the damage."""
    parts = [decoded.fields.get(path) for path in source.fields]
    there = [part for part in parts if part is not None]
    if len(there) < len(parts) or not parts:
        return None
    array = there[0] if len(there) == 1 else np.concatenate(there, axis=1)
    array = with_holes(array, source.missing)
    if source.encoding:
        array, lost = _poses(array, name)
        if lost:
            damage.append(f"{lost} rows of {name} are missing: their quaternions are not of length 1")
    size = int(np.prod(source.column.shape))
    if array.shape[1] != size:
        raise LogError(f"Expected {size} values in a row of {name}, got {array.shape[1]}.")
    array = array.reshape(len(array), *source.column.shape)
    return _on_rows(array, decoded.sequence, rows.sequence)


def _poses(array: np.ndarray, name: str) -> tuple[np.ndarray, int]:
    """Return positions and quaternions xyzw (k, 7) as matrices (k, 16), and how many are no pose: they are NaN."""
    if array.shape[1] != 7:
        raise LogError(f"Expected 7 numbers per pose in {name}, got {array.shape[1]}.")
    no_pose = np.abs(np.linalg.norm(array[:, 3:], axis=1) - 1.0) > _QUATERNION_LENGTH  # false where missing
    array = np.where(no_pose[:, None], np.nan, array)
    matrices = se3.from_rp(quaternion.to_matrix(array[:, [6, 3, 4, 5]]), array[:, :3])
    return matrices.reshape(len(array), 16), int(no_pose.sum())


def _on_rows(array: np.ndarray, sequence: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Put values into the rows with the same sequence number; NaN in the others."""
    if np.array_equal(sequence, rows):
        return array
    order = np.argsort(rows, kind="stable")
    place = np.searchsorted(rows[order], sequence).clip(0, max(len(rows) - 1, 0))
    place = order[place] if len(rows) else place
    match = rows[place] == sequence if len(rows) else np.zeros(len(sequence), dtype=bool)
    result = np.full((len(rows), *array.shape[1:]), np.nan)
    result[place[match]] = array[match]
    return result
