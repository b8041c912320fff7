"""`read`: a file becomes a `Table`, finished or torn."""

from __future__ import annotations

import json
import mmap
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from armlab.errors import ArmlabError, ConfigError, LogError, UnknownName
from armlab.log.assemble import recording_table
from armlab.log.delimited import read_csv
from armlab.log.description import Progress
from armlab.log.formats import BAGS, check_readable, format_at
from armlab.log.hdf5_file import read_hdf5
from armlab.log.labcomm import read_labcomm
from armlab.log.mat_table import read_mat_table
from armlab.log.mcap_records import DAMAGE, Contents, contents
from armlab.log.parquet_file import read_parquet
from armlab.log.provenance import file_hash
from armlab.log.recording_columns import CLOCK_COLUMNS, clock_channel, clocks, columns_at, kept_clock, sources_of
from armlab.log.rosbag2_file import is_ours, read_rosbag2
from armlab.log.table import Table
from armlab.log.topic_table import Choice
from armlab.robots import Robot

__all__ = ["earlier", "opened", "read", "summary_of", "torn_sentence"]

_READERS: dict[str, Callable[[Path], Table]] = {
    "text": read_csv,
    "gzip": read_csv,
    "LabComm": read_labcomm,
    "MAT v5": read_mat_table,
    "MAT v7.3": read_mat_table,
    "rosbag2": read_rosbag2,
}
_COLUMN_READERS = {"HDF5": read_hdf5, "Parquet": read_parquet}  # which read single columns


def read(
    path: str | Path,
    columns: Sequence[str] | None = None,
    *,
    robot: Robot | str | None = None,
    clock: str | None = None,
    raw: bool = False,
    progress: Progress | None = None,
) -> Table:
    """Return the table that a file holds: a recording, or any format that `write` writes.

    Also LabComm streams (`read_labcomm`), and text, MAT, HDF5 and Parquet files of other programs, where numbered
    columns of a known name are put together and units converted (`read_csv`).

    MCAP files, rosbag2 and ROS 1 bags of other programs: the arm's JointState is q, qd and tau, with the names of its
    joints as labels; the only WrenchStamped is wrench_raw; everything else is named by its topic, "/ft/wrench" as
    ft.wrench (N, 6), a pose as matrices (N, 4, 4), a transform as tf.parent.child, other numbers as topic.field.
    Topics with stamps of their own are held from message to message, their age is in ``<name>_age``.

    An unfinished or damaged file is read as far as it goes, with one warning and a note. Rows whose time does not
    advance are dropped and counted in the notes.

    Parameters
    ----------
    path : file, or folder of a rosbag2; the format is told by the first bytes.
    columns : names of the columns wanted, all when None.
    robot : which, when the file holds several. Of a log of another program a robot or its name, whose joints are put
        into its order, or the first part of its topics.
    clock : of a log of another program, the topic whose stamps are the rows; needed where topics have several rates.
    raw : keep rows whose time does not advance.
    progress : called with (done, total, what) while a large file is read.

    Returns
    -------
    Table : t = 0 at the first row, on the robot's clock where it was recorded. Absent data have no column.

    Raises
    ------
    LogError : the file is missing, of another format or damaged beyond use. Of another program's log: topics have
        several rates, which are listed; several arms; joints that are not the robot's, listed on both sides.
    MissingExtra : pyarrow or h5py is not installed.
    UnknownName : a wanted column, topic or robot does not exist; lists those that do.
    ConfigError : clock= for a log that has one clock.
    """
    path = Path(path)
    kind = format_at(path)
    if kind in BAGS and not (kind == "rosbag2" and is_ours(path)):
        from armlab.log.topic_reading import read_foreign

        return read_foreign(path, Choice(columns, None, clock, raw), robot, progress)
    if kind in _READERS or kind in _COLUMN_READERS:
        _refuse_clock(path, clock)
        table = _READERS[kind](path) if kind in _READERS else _COLUMN_READERS[kind](path, columns)
        return table if columns is None else table.select(*columns)
    check_readable(path)
    with opened(path) as view, ThreadPoolExecutor(1) as background:
        hashed = background.submit(file_hash, path)
        try:
            found = contents(view)
            if found.channels and not clocks(found):
                from armlab.log.topic_reading import read_foreign

                return read_foreign(path, Choice(columns, None, clock, raw), robot, progress)
            _refuse_clock(path, clock)
            name = robot.name if isinstance(robot, Robot) else robot
            table, damage = _read_mcap(view, found, path, columns, name, raw, progress)
        except ArmlabError:
            raise
        except DAMAGE as error:
            raise LogError(f"Expected a whole recording in {path}, got a damaged one ({error}).") from None
        source = (f"{path.name} sha256 {hashed.result()}", *earlier(view, found))
    notes = [sentence for _, sentence in found.damaged] + damage
    if not found.finished:
        notes.insert(0, torn_sentence(path, found, table))
    if notes:
        warnings.warn("; ".join(notes[:3]), stacklevel=2)
    return replace(table, notes=(*notes, *_holes(view, found), *table.notes), source=(*source, *table.source))


def _refuse_clock(path: Path, clock: str | None) -> None:
    """Refuse a clock where there is nothing to choose: the caller would think that it is in force."""
    if clock is not None:
        raise ConfigError(
            f"Expected clock={clock!r} with a log of another program, which has topics, got {path}, whose rows have "
            "one clock. Leave it out."
        )


def earlier(view: memoryview, found: Contents) -> tuple[str, ...]:
    """Return where the rows of a file had come from that `write`, `cut` or `merge` made."""
    chain = summary_of(view, found).get("source", [])
    return tuple(str(entry) for entry in chain) if isinstance(chain, list) else ()


def summary_of(view: memoryview, found: Contents) -> dict[str, Any]:
    """Return what was counted at the end of a recording, empty without."""
    for one in found.attachments:
        if one.name == "summary.json":
            try:
                told = json.loads(bytes(view[slice(*one.data)]))
            except ValueError:
                return {}
            return told if isinstance(told, dict) else {}
    return {}


def _holes(view: memoryview, found: Contents) -> tuple[str, ...]:
    """Return what the recorder dropped, in a sentence."""
    told = summary_of(view, found)
    holes, dropped = told.get("holes"), told.get("dropped")
    if not dropped or not isinstance(holes, list):
        return ()
    ticks = [f"{hole[0]} to {hole[1]}" for hole in holes if isinstance(hole, list) and len(hole) > 1]
    more = f" and {len(ticks) - 5} more" if len(ticks) > 5 else ""
    return (f"{dropped} rows were dropped while recording: ticks {', '.join(ticks[:5])}{more}",)


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
    view: memoryview,
    found: Contents,
    path: Path,
    columns: Sequence[str] | None,
    robot: str | None,
    raw: bool,
    progress: Progress | None,
) -> tuple[Table, list[str]]:
    clock = clock_channel(found, path, robot)
    sources = sources_of(found, clock)
    wanted = list(sources) if columns is None else list(columns)
    for name in wanted:
        if name not in sources:
            raise UnknownName.among("column", name, sources)
    needed = dict.fromkeys([*wanted, *(name for name in CLOCK_COLUMNS if name in sources)])
    values, rows, damage = columns_at(view, found, clock, {name: sources[name] for name in needed}, progress)
    described = {name: sources[name].column for name in values}
    try:
        table = recording_table(values, described, rows.log_ns, raw=raw)
    except ArmlabError as error:  # the file's descriptions contradict the glossary or each other
        raise LogError(f"Expected columns that armlab knows in {path}, got others: {error}") from None
    t0_ns, clock_name = kept_clock(found, sources, table.t0_ns, table.clock)
    table = replace(table, t0_ns=t0_ns, clock=clock_name)
    if columns is None:
        return table, damage
    empty = [name for name in wanted if name not in table]
    if empty:
        raise LogError(f"Expected values of {', '.join(empty)} in {path}, got none in {len(table)} rows.")
    return table.select(*wanted), damage
