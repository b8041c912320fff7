"""`read` reads a finished or unfinished log file as a `Table`; `read_arm` reads the log of one arm."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

from armlab.errors import ArmlabError, ConfigError, LogError, ModelMismatchError, UnknownName
from armlab.log.assembly import recording_table
from armlab.log.file_formats.column_names import ColumnNames, fitting_presets, listed
from armlab.log.file_formats.delimited import read_csv
from armlab.log.file_formats.description import Progress, renamed
from armlab.log.file_formats.hdf5_parquet import read_hdf5, read_parquet
from armlab.log.file_formats.labcomm import read_labcomm
from armlab.log.file_formats.mat import read_mat_table
from armlab.log.file_formats.opening import BAGS, check_readable, format_at, naming, opened, undamaged
from armlab.log.file_formats.rosbag2 import read_rosbag2
from armlab.log.mcap.records import DAMAGE, Contents, contents
from armlab.log.recording import columns as recorded
from armlab.log.recording.metadata import check_recorded, inspect
from armlab.log.recording.ros_messages import topic_name
from armlab.log.table import Table
from armlab.log.topics.reader import Choice, is_foreign, joints_among, names_robots, read_foreign, read_joints
from armlab.robots import Robot

_READERS: dict[str, Callable[..., Table]] = {
    "text": lambda path, raw, names: read_csv(path, raw=raw, columns=names),
    "gzip": lambda path, raw, names: read_csv(path, raw=raw, columns=names),
    "LabComm": lambda path, raw, names: renamed(path, read_labcomm(path, raw=raw), names),
    "MAT v5": read_mat_table,
    "MAT v7.3": read_mat_table,
    "rosbag2": lambda path, raw, names: renamed(path, read_rosbag2(path), names),  # written by `write`, so in order
}
_COLUMN_READERS = {"HDF5": read_hdf5, "Parquet": read_parquet}  # can read individual columns


def read(
    path: str | Path,
    columns: Sequence[str] | str | Mapping[str, str | Sequence[str]] | None = None,
    *,
    robot: Robot | str | None = None,
    clock: str | None = None,
    raw: bool = False,
    progress: Progress | None = None,
) -> Table:
    """Read a log as a `Table`: a recording, or any format supported by `write`.

    LabComm streams (`read_labcomm`) and text, MAT, HDF5 and Parquet files from other programs are also supported. In
    these files, numbered columns with a known name are joined, and units are converted (`read_csv`).

    In MCAP files and rosbag2 or ROS 1 bags from other programs, the arm's JointState becomes q, qd and tau, with the
    joint names as labels. A single WrenchStamped becomes wrench_raw. Everything else is named after its topic:
    "/ft/wrench" becomes ft.wrench (N, 6), a pose becomes matrices (N, 4, 4), a transform is tf.parent.child, and other
    numbers are topic.field. Values of topics with their own timestamps are held until the next message, with their age
    in ``<name>_age``.

    An unfinished or damaged file is read as far as possible, with one warning and a note. Rows with non-increasing time
    are dropped; a note and a warning list the first dropped rows.

    Parameters
    ----------
    path : file, or folder of a rosbag2; the format is detected from the first bytes.
    columns : list of columns to read; default: all. A string or a mapping gives the column names in a file from another
        program: ``"q=joint_{1..6}_pos [deg],tau=current_{1..6}*12.5"`` or ``{"q": ["shoulder", "elbow"]}``, with unit
        and factor if needed, or a preset: ``"ur"`` (RTDE), ``"franka"`` (libfranka, franka_ros), ``"ros"`` (JointState
        as CSV), ``"abb"`` and, for seven joints, ``"abb7"`` (abb_libegm). Without a header, columns are given by
        position: ``"t=1,q={2..7}"``. Other columns keep their names.
    robot : robot to select if the file contains several robots. For a log from another program: a robot or its name,
        which sets the joint order of the table, or the first part of its topic names.
    clock : for a log from another program, the topic whose timestamps define the rows; required if topics have
        different rates.
    raw : keep rows with non-increasing time.
    progress : called with (done, total, what) while a large file is read.

    Returns
    -------
    Table : t = 0 at the first row, on the robot's clock if recorded. Data that were not recorded have no column.

    Raises
    ------
    LogError : the file is missing, unreadable or in an unknown format. Also raised if a log from another program has
        topics with different rates, several arms, or joints that do not match those of the robot; the message lists
        them.
    MissingExtra : pyarrow or h5py is not installed.
    UnknownName : a column, topic, preset or robot does not exist; the message lists the available names.
    ConfigError : clock= is given for a log with one clock, robot= for a file without robot names, or columns= is
        invalid.
    """
    names = ColumnNames.of(columns) if isinstance(columns, str | Mapping) else None
    wanted = None if columns is None or isinstance(columns, str | Mapping) else columns
    path, choice = Path(path), Choice(wanted, None, clock, raw)
    kind = format_at(path)
    with naming(path):
        if kind in BAGS and names_robots(path):
            return renamed(path, read_foreign(path, choice, robot, progress), names)
        if kind in _READERS or kind in _COLUMN_READERS:
            _refuse_clock(path, clock)
            if robot is not None:
                name = robot.name if isinstance(robot, Robot) else robot
                raise ConfigError(
                    f"Expected a recording, or a log whose topics or joints name the robot, for robot={name!r}, got "
                    f"{path}, which does not name a robot. Omit robot=."
                )
            reader = _READERS[kind] if kind in _READERS else partial(_COLUMN_READERS[kind], columns=wanted)
            table = reader(path, raw=raw, names=names)
            return table if wanted is None else table.select(*wanted)
        return renamed(path, _read_mcap(path, choice, robot, progress), names)


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
    if clock is not None:
        raise ConfigError(
            f"Expected a log with topics from another program for clock={clock!r}, got {path}, whose rows have a "
            "single clock. Omit clock=."
        )


def _holes(view: memoryview, found: Contents, clock: int) -> tuple[str, ...]:
    """Return a note on any rows that the recorder dropped for the robot with this clock channel."""
    stored = recorded.summary_of(view, found).get("holes")
    robot = found.channels[clock].topic.strip("/").rpartition("/")[0]
    holes = [hole for hole in stored if isinstance(hole, list) and len(hole) > 2] if isinstance(stored, list) else []
    holes = [hole for hole in holes if len(hole) < 5 or hole[4] == robot]
    if not holes:
        return ()
    dropped = sum(hole[2] for hole in holes if isinstance(hole[2], int))
    ticks = [f"{hole[0]} to {hole[1]}" for hole in holes]
    more = f" and {len(ticks) - 5} more" if len(ticks) > 5 else ""
    return (f"{dropped} rows were dropped while recording: ticks {', '.join(ticks[:5])}{more}",)


def _recording(
    view: memoryview, found: Contents, path: Path, clock: int, choice: Choice, progress: Progress | None
) -> tuple[Table, list[str]]:
    """Return the table of the robot whose clock is this channel, and the damage found in the file."""
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
        raise LogError(f"Expected valid columns in {path}, got an error: {error}") from None
    t0_ns, clock_name = recorded.kept_clock(found, sources, table.t0_ns, table.clock)
    table = replace(table, t0_ns=t0_ns, clock=clock_name)
    if columns is None:
        return table, damage
    empty = [name for name in wanted if name not in table]
    if empty:
        raise LogError(f"Expected values of {', '.join(empty)} in {path}, got no values in {len(table)} rows.")
    return table.select(*wanted), damage


def read_arm(
    path: str | Path,
    robot: Robot,
    progress: Progress | None = None,
    *,
    force: bool = False,
    columns: str | Mapping[str, str | Sequence[str]] | None = None,
    needed: Sequence[str] = ("q", "tau"),
) -> Table:
    """Read the log of an arm: q and tau (N, n) in the arm's joint order, and qd if recorded.

    Parameters
    ----------
    path : log; see `read`.
    robot : the recorded arm.
    progress : called with (done, total, what); see `read`.
    force : accept a recording made with another description of the arm (tool, mount, limits), with a warning.
    columns : column names in the file, as a string or a mapping; see `read`.
    needed : required columns.

    Raises
    ------
    LogError : the log cannot be read, lacks positions or torques, or has joint names other than the robot's.
    ModelMismatchError : the log is a recording of another robot (the message lists the differences), or has a different
        number of joints.
    """
    path = Path(path)
    several = _is_of_several(path, robot, force)
    if is_foreign(path):
        table = renamed(path, read_joints(path, robot, progress), None if columns is None else ColumnNames.of(columns))
    else:
        table = read(path, columns=columns, robot=robot.name if several else None, progress=progress)
        table = table if columns is None else in_order_of(robot, table, path)
    missing = [name for name in needed if name not in table]
    if missing:
        raise LogError(
            f"Expected positions and torques (columns q and tau) in {path}, got no {' and '.join(missing)} among the "
            f"columns {listed(table.names)}. {_source_of(missing, table, robot, columns is not None)}"
        )
    if table["q"].shape[1:] != (robot.n,):
        raise ModelMismatchError(
            f"Expected a log of {robot.name!r} with {robot.n} joints, got q of shape {table['q'].shape} in {path}. "
            "Pass the robot that was logged."
        )
    return table


def _source_of(missing: Sequence[str], table: Table, robot: Robot, mapped: bool) -> str:
    """Return a hint on how to obtain the missing positions or torques."""
    if mapped:
        return f"Pass the column names: --columns '{','.join(f'{name}=NAME_{{1..{robot.n}}}' for name in missing)}'."
    if fitting := fitting_presets(dict.fromkeys(["time", *table.names], (table.t, ""))):
        return fitting
    if missing == ["tau"]:
        way = "Record with the research extension, which sends torques"
    else:
        way = "Pass a log of the joints; armlab log show lists its columns"
    return (
        f"{way}; for a log from another program, pass the column "
        f"names: --columns q=NAME_{{1..6}},tau=NAME_{{1..6}}, or a "
        "preset, --columns ur, franka or ros."
    )


def in_order_of(robot: Robot, table: Table, path: Path) -> Table:
    """Return the table with labelled joint columns in the robot's order."""
    values, columns = dict(table.values), dict(table.columns)
    for name, column in table.columns.items():
        if name not in ("q", "qd", "tau") or not column.labels:
            continue
        order = joints_among(robot, column.labels)
        if not order:
            raise LogError(
                f"Expected the joints of {robot.name} ({', '.join(robot.ros_joint_names)}) in {name} of {path}, got "
                f"{', '.join(column.labels)}. Pass the robot that was recorded, or the columns in its order: "
                f"--columns {name}=NAME_{{1..{robot.n}}}."
            )
        places = [column.labels.index(one) for one in order]
        values[name] = table[name][:, places]
        columns[name] = replace(column, labels=tuple(order), shape=(len(places),))
    return replace(table, values=values, columns=columns)


def _is_of_several(path: Path, robot: Robot, force: bool) -> bool:
    """Return whether a recording contains several robots; raise an error if the given robot is missing."""
    if not path.is_file() or format_at(path) != "MCAP":
        return False
    held = inspect(path)
    several = len(held.robots) > 1
    try:
        check_recorded(held, robot)
    except ModelMismatchError as error:
        if not force or (several and topic_name(robot.name) not in held.robots):
            raise
        warnings.warn(str(error), stacklevel=3)
    return several
