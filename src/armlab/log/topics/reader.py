"""Reader for logs from other programs: selects topics, and converts their streams to tables."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from armlab import glossary, robots
from armlab.errors import ArmlabError, LogError, UnknownName
from armlab.log.assembly import rows_in_order
from armlab.log.file_formats.description import Progress, distinct
from armlab.log.file_formats.opening import (
    BAGS,
    bag_files,
    check_readable,
    format_at,
    naming,
    opened,
    origin,
    undamaged,
)
from armlab.log.file_formats.rosbag2 import is_ours
from armlab.log.mcap.records import Contents, contents
from armlab.log.recording.columns import clocks, torn_sentence
from armlab.log.table import Table
from armlab.log.topics.messages import TopicMessages, read_mcap_topics, read_rosbags_topics
from armlab.log.topics.streams import JOINTS, Stream, rate_text, stem, streams_of
from armlab.robots import Robot

WRENCH = "geometry_msgs/msg/WrenchStamped"
_SAME_RATE = 0.01  # maximum relative difference between rates that count as equal
_ANOTHER_CLOCK = 1.0  # s, a larger difference in recording delay indicates header stamps from another clock


@dataclass(frozen=True, slots=True)
class Choice:
    """Options of `read`; `clock` is the topic whose stamps define the rows."""

    columns: Sequence[str] | None = None
    robot: Robot | None = None
    clock: str | None = None
    raw: bool = False


def table_of_streams(path: Path, streams: Sequence[Stream], choice: Choice, notes: Sequence[str]) -> Table:
    """Return the table of several streams; values are held between messages, with their age in extra columns."""
    streams = [one for one in streams if len(one.log_ns)]
    if not streams:
        raise LogError(
            f"Expected topics with numeric data in {path}, got no such topic{''.join(f'; {note}' for note in notes)}."
        )
    clock = None
    if choice.clock is not None:
        topics = {one.topic for one in streams}
        clock = next((name for name in (choice.clock, f"/{choice.clock}") if name in topics), None)
        if clock is None:
            raise UnknownName.among("topic with numeric data in this file", choice.clock, topics)
    arm, told = _arm(path, streams, choice.robot, clock)
    if choice.robot is not None:
        streams = [_in_order(one, choice.robot) for one in streams]
        arm = None if arm is None else _in_order(arm, choice.robot)
    named, more = _named(streams, arm)
    notes = [*notes, *told, *more]
    if choice.columns is not None:
        named = _wanted(named, choice.columns, clock)
    rows = _rows(path, named, clock)
    try:
        table = _table(rows, named, notes, choice.raw)
    except ArmlabError as error:
        raise LogError(f"Expected valid columns in {path}, got an error: {error}") from None
    return table if choice.columns is None else table.select(*choice.columns)


def tables_of_streams(path: Path, streams: Sequence[Stream], choice: Choice) -> dict[str, Table]:
    """Return one table per stream, keyed by topic; if a topic has several streams, the keys include the name of the
    first column."""
    tables: dict[str, Table] = {}
    counts = Counter(one.topic for one in streams)
    for one in streams:
        ordered = one if choice.robot is None else _in_order(one, choice.robot)
        name = one.topic if counts[one.topic] == 1 else f"{one.topic} {next(iter(one.values))}"
        own, notes = _named([ordered], ordered)
        try:
            tables[name] = _table(own[0], own, notes, choice.raw)
        except ArmlabError as error:
            raise LogError(f"Expected valid columns in {path}, got an error: {error}") from None
    return tables


def _arm(
    path: Path, streams: Sequence[Stream], robot: Robot | None, clock: str | None
) -> tuple[Stream | None, list[str]]:
    """Return the JointState with the arm's q, qd and tau, and notes on its joints."""
    states = [one for one in streams if one.type == JOINTS]
    if robot is not None:
        if not states:
            raise LogError(
                f"Expected a topic of type {JOINTS} with the joints of {robot.name} in {path}, got "
                f"{rate_text(streams) or 'none'}."
            )
        fitting = [one for one in states if joints_among(robot, one.joints)]
        if not fitting:
            nearest = max(states, key=lambda one: len({*one.joints} & {*robot.ros_joint_names}))
            raise LogError(_mismatch(path, robot, nearest))
        states = fitting
    if len(states) > 1 and any(one.topic == clock for one in states):
        states = [one for one in states if one.topic == clock]
    most = max((len(one.joints) for one in states), default=0)
    states = [one for one in states if len(one.joints) == most]
    best = [one for one in states if stem(one.topic).split(".")[-1] == "joint_states"] or states
    best = [one for one in best if one.topic == "/joint_states"] or best
    if len(best) > 1:
        arms = "; ".join(f"{one.topic} ({', '.join(one.joints)})" for one in best)
        raise LogError(
            f"Expected one arm in {path}, got several: {arms}. Select one with robot= (a robot or the first part of "
            "its topic names) or clock= (its topic)."
        )
    if not best:
        return None, []
    others = [name for name in best[0].joints if robot is not None and name not in joints_among(robot, best[0].joints)]
    note = f"skipped in {best[0].topic}, not joints of {robot.name if robot else ''}: {', '.join(others)}"
    return best[0], [note] if others else []


def joints_among(robot: Robot, names: Sequence[str]) -> list[str]:
    """Return the names that are joints of the robot, in the robot's joint order; empty if any joint is missing.

    Both the ROS names and the names in the robot description are accepted. A common prefix, as used by drivers for two
    arms, is ignored.
    """
    for wanted in (robot.ros_joint_names, robot.joint_names):
        prefixes = ["", *dict.fromkeys(name.removesuffix(wanted[0]) for name in names if name.endswith(wanted[0]))]
        for prefix in prefixes:
            if all(prefix + name in names for name in wanted):
                return [prefix + name for name in wanted]
    return []


def _mismatch(path: Path, robot: Robot, stream: Stream) -> str:
    here, there = set(robot.ros_joint_names), set(stream.joints)
    only_here = ", ".join(name for name in robot.ros_joint_names if name not in there)
    only_there = ", ".join(name for name in stream.joints if name not in here) or "none"
    return (
        f"Expected the joints of {robot.name} on {stream.topic} of {path}, got other joints. Only in the robot: "
        f"{only_here}; only in the log: {only_there}. Pass the robot that was recorded, or omit robot=."
    )


def _in_order(stream: Stream, robot: Robot) -> Stream:
    names = joints_among(robot, stream.joints) if stream.type == JOINTS else []
    return stream.ordered(names) if names else stream


def _named(streams: Sequence[Stream], arm: Stream | None) -> tuple[list[Stream], list[str]]:
    """Return the streams with the column names of the table, and notes on them."""
    wrenches = [one for one in streams if one.type == WRENCH]
    names: dict[tuple[int, str], str] = {}
    notes = []
    for number, one in enumerate(streams):
        for name in one.values:
            own = name
            if one.type == JOINTS and not _is(one, arm):
                own = f"{stem(one.topic)}.{name}"
            elif len(wrenches) == 1 and one is wrenches[0]:
                own = "wrench_raw"
                notes.append(f"wrench_raw is {one.topic}, in axes of {one.columns[name].frame or 'an unnamed frame'}")
            elif name in glossary.columns() or name == "t" or not name:
                own = name if _is(one, arm) else f"topic.{name}"
            names[number, name] = own
    names = distinct(names)
    result = []
    for number, one in enumerate(streams):
        values = {names[number, name]: array for name, array in one.values.items()}
        columns = {names[number, name]: column for name, column in one.columns.items()}
        columns = {name: replace(c, frame=None) if name == "wrench_raw" else c for name, c in columns.items()}
        result.append(replace(one, values=values, columns=columns))
    return result, notes


def _is(one: Stream, arm: Stream | None) -> bool:
    return arm is not None and one.topic == arm.topic and one.joints == arm.joints


def _wanted(named: Sequence[Stream], columns: Sequence[str], clock: str | None) -> list[Stream]:
    known = {name for one in named for name in one.values}
    for name in columns:
        if name.removesuffix("_age") not in known and name not in known:
            raise UnknownName.among("column", name, known)
    wanted = {name for column in columns for name in (column, column.removesuffix("_age"))}
    kept = []
    for one in named:
        values = {name: array for name, array in one.values.items() if name in wanted}
        if values or one.topic == clock:
            kept.append(replace(one, values=values, columns={name: one.columns[name] for name in values}))
    return kept


def _rows(path: Path, streams: Sequence[Stream], clock: str | None) -> Stream:
    several = [one for one in streams if len(one.log_ns) > 1]
    order = [*sorted(several, key=lambda one: "q" not in one.values), *streams]
    if clock is not None:
        order = sorted((one for one in order if one.topic == clock), key=lambda one: -len(one.log_ns))
        return next((one for one in order if "q" in one.values), order[0])
    if any(abs(one.rate - order[0].rate) > _SAME_RATE * order[0].rate for one in several):
        raise LogError(
            f"Expected topics with the same rate in {path}, got several rates: {rate_text(streams)}. Select the topic "
            f"whose stamps define the rows, for example clock={order[0].topic!r}, or read columns of one topic, "
            f"columns={list(order[0].values)}."
        )
    return order[0]


def _table(rows: Stream, streams: Sequence[Stream], notes: Sequence[str], raw: bool) -> Table:
    stamps = _on_clock(rows, rows)
    t = (stamps - stamps[0]) / 1e9
    t, keep, dropped = rows_in_order(t, raw, of=f" of {rows.topic}")
    kept = rows.rows(keep) if dropped else rows
    start, columns = int(stamps[0]), {name: replace(one, shape=()) for name, one in rows.columns.items()}
    table = Table(t[keep], kept.values, columns, t0_ns=start, notes=(*notes, *dropped))
    for other in streams:
        if other is not rows:
            table = _joined(table, other, _on_clock(other, rows), stamps)
    return replace(table, source=())


def _on_clock(stream: Stream, rows: Stream) -> np.ndarray:
    """Return creation times [ns] on the clock of the rows: header stamps, or recording times minus the delay."""
    if rows.stamp_ns is None:
        return stream.log_ns
    delay = np.median(rows.log_ns - rows.stamp_ns)
    if stream.stamp_ns is not None and abs(np.median(stream.log_ns - stream.stamp_ns) - delay) < _ANOTHER_CLOCK * 1e9:
        return stream.stamp_ns
    return stream.log_ns - int(delay)


def _joined(table: Table, other: Stream, stamps: np.ndarray, rows: np.ndarray) -> Table:
    """Return the table joined with the columns of another stream, held between messages."""
    columns = {name: replace(one, shape=()) for name, one in other.columns.items()}
    if len(stamps) == len(table) and len(rows) == len(table) and np.array_equal(stamps, rows):
        return replace(table, values={**table.values, **other.values}, columns={**table.columns, **columns})
    if other.topic.endswith("/tf_static"):  # valid at all times
        stamps = np.minimum(stamps, table.t0_ns)
    order = np.argsort(stamps, kind="stable")
    order = order[np.append(np.diff(stamps[order]) > 0, True)]  # among messages with equal stamps, the last is kept
    values: Mapping[str, np.ndarray] = {name: array[order] for name, array in other.values.items()}
    t = (stamps[order] - table.t0_ns) / 1e9
    return table.join(Table(t, values, columns, t0_ns=table.t0_ns))


Wanted = Callable[[str, str], bool]


def is_foreign(path: Path) -> bool:
    """Return whether a path is a log from another program: a bag, or an MCAP file not written by armlab."""
    kind = format_at(path)
    if kind == "MCAP":
        with opened(path) as view, naming(path):
            return not clocks(contents(view))
    return kind in BAGS and names_robots(path)


@dataclass(frozen=True, slots=True)
class _Held:
    """Content of a log: its topics and unfinished files, and the options, including the robot."""

    files: Sequence[Path]
    choice: Choice
    topics: TopicMessages
    torn: Mapping[Path, Contents] = field(default_factory=dict)


def read_foreign(path: Path, choice: Choice, robot: Robot | str | None, progress: Progress | None = None) -> Table:
    """Return the table of a log from another program: an MCAP file, a rosbag2 folder or a ROS 1 bag."""
    held = _held(path, choice, robot, progress)
    streams, notes = _streams(held.topics)
    reason = held.topics.left_out.get(choice.clock or "")
    if reason:
        raise LogError(f"Expected a topic with numeric data as clock= for {path}, got {choice.clock}: {reason}.")
    table = table_of_streams(path, streams, held.choice, [*notes, *_left_out(held.topics)])
    whole = [torn_sentence(file, found, table) for file, found in held.torn.items()]
    if whole or notes:
        warnings.warn("; ".join([*whole, *notes][:3]), stacklevel=3)
    return replace(table, notes=(*whole, *table.notes), source=tuple(origin(one) for one in held.files))


def read_joints(path: Path, robot: Robot, progress: Progress | None = None) -> Table:
    """Return an arm's q (and qd and tau if available) from another program's log, in the joint order of the arm."""
    for columns in (["q", "qd", "tau"], ["q", "tau"], ["q", "qd"]):
        with suppress(UnknownName):
            return read_foreign(path, Choice(columns), robot, progress)
    return read_foreign(path, Choice(["q"]), robot, progress)


def read_topics(
    path: str | Path, *, robot: Robot | str | None = None, progress: Progress | None = None
) -> dict[str, Table]:
    """Return the individual topics of another program's log, each on its own clock with t = 0 at the first message.

    Columns are named as in `read`, except that the columns of every JointState are q, qd and tau. Transforms or joints
    that share a topic but are not published together become separate tables. The notes of each table list damage in the
    file and skipped topics.

    Parameters
    ----------
    path : an MCAP file, a rosbag2 folder or a ROS 1 bag.
    robot : as in `read`.
    progress : called with (done, total, what).

    Raises
    ------
    LogError : the file is in another format, or too corrupt to read.
    UnknownName : the robot is unknown.
    """
    path = Path(path)
    if format_at(path) not in ("MCAP", *BAGS):
        check_readable(path)
    held = _held(path, Choice(), robot, progress)
    streams, notes = _streams(held.topics)
    notes += [f"{file.name} was not finished: {found.torn} bytes lost" for file, found in held.torn.items()]
    source, of_file = tuple(origin(one) for one in held.files), (*notes, *_left_out(held.topics))
    if notes or not streams:
        warnings.warn("; ".join(of_file[:3]) or f"{path.name} has no topics with numeric data", stacklevel=2)
    tables = tables_of_streams(path, streams, held.choice)
    return {name: replace(one, notes=(*of_file, *one.notes), source=source) for name, one in tables.items()}


def _held(path: Path, choice: Choice, robot: Robot | str | None, progress: Progress | None) -> _Held:
    if path.is_file() and format_at(path) == "MCAP":
        return _held_in_mcap([path], choice, robot, progress)
    pieces = bag_files(path) if path.is_dir() else []
    if pieces and not (path / "metadata.yaml").is_file() and all(one.suffix == ".mcap" for one in pieces):
        return _held_in_mcap(pieces, choice, robot, progress)  # the recorder was killed
    with undamaged(f"bag in {path}"), _reader(path, pieces) as bag:
        inner = _plain_mcap(bag)
        if inner:
            return replace(_held_in_mcap(inner, choice, robot, progress), files=[path])
        choice, wanted = _chosen({one.topic: one.msgtype for one in bag.connections}, choice, robot)
        into = TopicMessages()
        read_rosbags_topics(bag, wanted, into, progress)
    return _Held([path], choice, into)


def _held_in_mcap(files: Sequence[Path], choice: Choice, robot: Robot | str | None, progress: Progress | None) -> _Held:
    with ExitStack() as stack:
        held = []
        for file in files:
            view = stack.enter_context(opened(file))
            with naming(file):
                held.append((file, view, contents(view)))
        topics = {channel.topic: channel.type for _, _, found in held for channel in found.channels.values()}
        choice, wanted = _chosen(topics, choice, robot)
        into = TopicMessages()
        into.damage += [sentence for _, _, found in held for _, sentence in found.damaged]
        for file, view, found in held:
            with naming(file):
                read_mcap_topics(view, found, wanted, into, progress)
    return _Held(files, choice, into, {file: found for file, _, found in held if not found.finished})


def _streams(topics: TopicMessages) -> tuple[list[Stream], list[str]]:
    """Return the streams of all topics, and notes on faults."""
    streams: list[Stream] = []
    notes: list[str] = []
    for topic, fields, decoded in topics.decoded():
        found, doubts = streams_of(topic, fields, decoded)
        streams += found
        notes += doubts
    return streams, [*topics.damage, *notes]


def _left_out(topics: TopicMessages) -> list[str]:
    listed = ", ".join(f"{topic} ({why})" for topic, why in topics.left_out.items())
    return [f"skipped: {listed}"] if listed else []


def _reader(path: Path, pieces: Sequence[Path]) -> Any:
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        path = pieces[0]  # sqlite3
    kind = format_at(path)
    if kind == "ROS 1 bag":
        from rosbags.rosbag1 import Reader as Ros1Reader

        return Ros1Reader(path)
    if kind != "rosbag2" and path.suffix != ".db3":
        raise LogError(f"Expected the folder of a rosbag2 or a .db3 file in it, got {path}. Rename it.")
    from rosbags.rosbag2 import Reader

    return Reader(path)


def _plain_mcap(bag: Any) -> list[Path]:
    """Return the MCAP files of an open rosbag2 without per-message compression."""
    inner = getattr(bag, "storage", None)
    if getattr(getattr(inner, "metadata", None), "compression_mode", None) == "message":
        return []
    paths = [Path(one.path) for one in getattr(inner, "storages", ()) if hasattr(one, "path")]
    return paths if all(path.suffix == ".mcap" for path in paths) else []


def _chosen(topics: dict[str, str], choice: Choice, robot: Robot | str | None) -> tuple[Choice, Wanted]:
    """Return the options with the robot (from the library or the first part of its topics) and the topic filter."""
    inside = set(topics)
    if isinstance(robot, str):
        prefix = f"/{robot.strip('/')}/"
        namespace = {topic for topic in topics if topic.startswith(prefix)}
        known = robot in robots.names() or robot.endswith((".toml", ".urdf"))
        if not namespace and not known:
            names = {topic.split("/")[1] for topic in topics if topic.count("/") > 1} | set(robots.names())
            raise UnknownName.among("library robot or the first part of a topic name in this file", robot, names)
        inside = namespace or inside
        choice = replace(choice, robot=robots.load(robot) if known else None)
    elif robot is not None:
        choice = replace(choice, robot=robot)
    needed = _needed({topic: kind for topic, kind in topics.items() if topic in inside}, choice.columns)
    clock = {choice.clock, f"/{choice.clock}"}
    return choice, lambda topic, _: topic in needed or topic in clock


def _needed(topics: dict[str, str], columns: Sequence[str] | None) -> set[str]:
    """Return the topics that may contain the columns; if a column is unknown, return all topics for use in the error
    message."""
    if columns is None:
        return set(topics)
    needed: set[str] = set()
    for name in {column.removesuffix("_age").removeprefix("topic.") for column in columns}:
        kinds = {JOINTS} if name in ("q", "qd", "tau") else {WRENCH} if name == "wrench_raw" else set()
        held = {one for one in topics if topics[one] in kinds or f"{name}.".startswith(f"{stem(one)}.")}
        if not held:
            return set(topics)
        needed |= held
    together = {topics[one] for one in needed} & {JOINTS, WRENCH}  # types whose column names depend on each other
    return needed | {one for one, kind in topics.items() if kind in together}


def names_robots(path: Path) -> bool:
    """Return whether the topics of a log identify robots, in which case `read` accepts robot=."""
    kind = format_at(path)
    return kind == "MCAP" or (kind in BAGS and not (kind == "rosbag2" and is_ours(path)))
