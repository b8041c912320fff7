"""`read`: a file becomes a `Table`, finished or torn; `read_arm`: the log of one arm."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from armlab.errors import ArmlabError, ConfigError, LogError, ModelMismatchError, UnknownName
from armlab.log.assembly import recording_table
from armlab.log.file_formats.delimited import read_csv
from armlab.log.file_formats.description import Progress
from armlab.log.file_formats.hdf5_parquet import read_hdf5, read_parquet
from armlab.log.file_formats.labcomm import read_labcomm
from armlab.log.file_formats.mat import read_mat_table
from armlab.log.file_formats.opening import BAGS, check_readable, format_at, naming, opened, undamaged
from armlab.log.file_formats.rosbag2 import read_rosbag2
from armlab.log.mcap.records import DAMAGE, Contents, contents
from armlab.log.recording import columns as recorded
from armlab.log.recording.metadata import inspect
from armlab.log.recording.ros_messages import topic_name
from armlab.log.table import Table
from armlab.log.topics.reader import Choice, is_foreign, names_robots, read_foreign, read_joints
from armlab.robots import Robot

_READERS: dict[str, Callable[..., Table]] = {
    "text": read_csv,
    "gzip": read_csv,
    "LabComm": read_labcomm,
    "MAT v5": read_mat_table,
    "MAT v7.3": read_mat_table,
    "rosbag2": lambda path, raw: read_rosbag2(path),  # which `write` wrote, in order
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
    advance are dropped, counted in the notes, and warned of with the first of them.

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
    ConfigError : clock= for a log that has one clock, robot= for a file that names no robot.
    """
    path, choice = Path(path), Choice(columns, None, clock, raw)
    kind = format_at(path)
    with naming(path):
        if kind in BAGS and names_robots(path):
            return read_foreign(path, choice, robot, progress)
        if kind in _READERS or kind in _COLUMN_READERS:
            _refuse_clock(path, clock)
            _refuse_robot(path, robot)
            table = _READERS[kind](path, raw=raw) if kind in _READERS else _COLUMN_READERS[kind](path, columns, raw=raw)
            return table if columns is None else table.select(*columns)
        return _read_mcap(path, choice, robot, progress)


def _read_mcap(path: Path, choice: Choice, robot: Robot | str | None, progress: Progress | None) -> Table:
    check_readable(path)
    with opened(path) as view, ThreadPoolExecutor(1) as background:
        hashed = background.submit(lambda: hashlib.sha256(view).hexdigest())
        with undamaged(f"recording in {path}", DAMAGE):
            found = contents(view)
            if found.channels and not recorded.clocks(found):
                return read_foreign(path, choice, robot, progress)
            _refuse_clock(path, choice.clock)
            own = recorded.clock_channel(found, path, robot.name if isinstance(robot, Robot) else robot)
            table, damage = _recording(view, found, path, own, choice, progress)
        source = (f"{path.name} sha256 {hashed.result()}", *recorded.earlier(view, found))
    notes = [sentence for _, sentence in found.damaged] + damage
    if not found.finished:
        notes.insert(0, recorded.torn_sentence(path, found, table))
    if notes:
        warnings.warn("; ".join(notes[:3]), stacklevel=3)
    return replace(table, notes=(*notes, *_holes(view, found, own), *table.notes), source=(*source, *table.source))


def _refuse_clock(path: Path, clock: str | None) -> None:
    """Refuse a clock where there is nothing to choose: the caller would think that it is in force."""
    if clock is not None:
        raise ConfigError(
            f"Expected clock={clock!r} with a log of another program, which has topics, got {path}, whose rows have "
            "one clock. Leave it out."
        )


def _refuse_robot(path: Path, robot: Robot | str | None) -> None:
    """Refuse a robot where none is named: the caller would think that the rows are its own."""
    if robot is not None:
        name = robot.name if isinstance(robot, Robot) else robot
        raise ConfigError(
            f"Expected robot={name!r} with a recording or a log of another program, whose topics or joints tell the "
            f"robot, got {path}, which names none. Leave it out."
        )


def _holes(view: memoryview, found: Contents, clock: int) -> tuple[str, ...]:
    """Return in a sentence what the recorder dropped of the robot with this clock channel."""
    told = recorded.summary_of(view, found).get("holes")
    robot = found.channels[clock].topic.strip("/").rpartition("/")[0]
    listed = [hole for hole in told if isinstance(hole, list) and len(hole) > 2] if isinstance(told, list) else []
    holes = [hole for hole in listed if len(hole) < 5 or hole[4] == robot]
    if not holes:
        return ()
    dropped = sum(hole[2] for hole in holes if isinstance(hole[2], int))
    ticks = [f"{hole[0]} to {hole[1]}" for hole in holes]
    more = f" and {len(ticks) - 5} more" if len(ticks) > 5 else ""
    return (f"{dropped} rows were dropped while recording: ticks {', '.join(ticks[:5])}{more}",)


def _recording(
    view: memoryview, found: Contents, path: Path, clock: int, choice: Choice, progress: Progress | None
) -> tuple[Table, list[str]]:
    """Return the table of the robot with this clock channel, and what is damaged."""
    columns = choice.columns
    sources = recorded.sources_of(found, clock)
    wanted = list(sources) if columns is None else list(columns)
    for name in wanted:
        if name not in sources:
            raise UnknownName.among("column", name, sources)
    needed = dict.fromkeys([*wanted, *(name for name in recorded.CLOCK_COLUMNS if name in sources)])
    values, rows, damage = recorded.columns_at(view, found, clock, {name: sources[name] for name in needed}, progress)
    described = {name: sources[name].column for name in values}
    try:
        table = recording_table(values, described, rows.log_ns, raw=choice.raw)
    except ArmlabError as error:  # the file's descriptions contradict the glossary or each other
        raise LogError(f"Expected columns that armlab knows in {path}, got others: {error}") from None
    t0_ns, clock_name = recorded.kept_clock(found, sources, table.t0_ns, table.clock)
    table = replace(table, t0_ns=t0_ns, clock=clock_name)
    if columns is None:
        return table, damage
    empty = [name for name in wanted if name not in table]
    if empty:
        raise LogError(f"Expected values of {', '.join(empty)} in {path}, got none in {len(table)} rows.")
    return table.select(*wanted), damage


def read_arm(path: str | Path, robot: Robot, progress: Progress | None = None) -> Table:
    """Return the log of an arm with q and tau (N, n), in its order of joints; qd where it was recorded.

    Parameters
    ----------
    path : of the log, see `read`. robot : that was logged. progress : as there.

    Raises
    ------
    LogError : it cannot be read, or has no positions or torques.
    ModelMismatchError : a recording of another robot, or another number of joints.
    """
    path = Path(path)
    several = _is_of_several(path, robot)
    if is_foreign(path):
        table = read_joints(path, robot, progress)
    else:
        table = read(path, robot=robot.name if several else None, progress=progress)
    missing = [name for name in ("q", "tau") if name not in table]
    if missing:
        raise LogError(
            f"Expected positions and torques, columns q and tau, in {path}, got none for {' and '.join(missing)} among "
            f"{', '.join(table.names)}. "
            + (
                "Record with the research extension, which sends torques."
                if missing == ["tau"]
                else "Name a log of the joints: armlab log show tells what one holds."
            )
        )
    if table["q"].shape[1:] != (robot.n,):
        raise ModelMismatchError(
            f"Expected a log of {robot.name!r} with {robot.n} joints, got q of shape {table['q'].shape} in {path}. "
            "Name the robot that was logged."
        )
    return table


def _is_of_several(path: Path, robot: Robot) -> bool:
    """Refuse a recording without rows of a robot of this name; True when it holds several. Text knows none."""
    if path.suffix != ".mcap" or not path.is_file():
        return False
    told = inspect(path)
    several = len(told.robots) > 1  # named by their topics, in which some letters cannot stand
    names = told.robots if several else (told.metadata.get("armlab", {}).get("robot", robot.name),)
    if (topic_name(robot.name) if several else robot.name) not in names:
        raise ModelMismatchError(
            f"Expected a recording of {robot.name!r}, got one of {' and '.join(map(repr, names))} in {path}. Name the "
            "robot that was recorded."
        )
    return several
