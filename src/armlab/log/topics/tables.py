"""Streams of another program's log become one `Table`: whose joints, whose clock, which columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armlab import glossary
from armlab.errors import ArmlabError, LogError, UnknownName
from armlab.log.assembly import rows_in_order
from armlab.log.file_formats.description import distinct
from armlab.log.table import Table
from armlab.log.topics.streams import JOINTS, Stream, rate_text, stem
from armlab.robots import Robot

WRENCH = "geometry_msgs/msg/WrenchStamped"
_SAME_RATE = 0.01  # relative
_ANOTHER_CLOCK = 1.0  # s between when a message was made and when it was recorded, beside that of the rows


@dataclass(frozen=True, slots=True)
class Choice:
    """What the caller of `read` asked for: columns, robot, topic whose stamps are the rows, rows in any order."""

    columns: Sequence[str] | None = None
    robot: Robot | None = None
    clock: str | None = None
    raw: bool = False


def table_of_streams(path: Path, streams: Sequence[Stream], choice: Choice, notes: Sequence[str]) -> Table:
    """Return the table of the streams of a log.

    The arm's JointState is q, qd and tau, the only WrenchStamped wrench_raw; other columns have the name of their
    topic. Each value is the last at or before its row, and its age is in ``<name>_age`` where it has stamps of its own.
    """
    streams = [one for one in streams if len(one.log_ns)]
    if not streams:
        raise LogError(f"Expected topics with numbers in {path}, got none{''.join(f'; {note}' for note in notes)}.")
    clock = None if choice.clock is None else _topic(choice.clock, streams)
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
        raise LogError(f"Expected columns that armlab can hold in {path}, got others: {error}") from None
    return table if choice.columns is None else table.select(*choice.columns)


def tables_of_streams(path: Path, streams: Sequence[Stream], choice: Choice) -> dict[str, Table]:
    """Return each stream as a table of its own, by topic; of several of one topic the first column is named too."""
    tables: dict[str, Table] = {}
    for one in streams:
        ordered = one if choice.robot is None else _in_order(one, choice.robot)
        name = (
            one.topic
            if [other.topic for other in streams].count(one.topic) == 1
            else f"{one.topic} {next(iter(one.values))}"
        )
        own, notes = _named([ordered], ordered)
        try:
            tables[name] = _table(own[0], own, notes, choice.raw)
        except ArmlabError as error:
            raise LogError(f"Expected columns that armlab can hold in {path}, got others: {error}") from None
    return tables


def _topic(clock: str, streams: Sequence[Stream]) -> str:
    topics = {one.topic for one in streams}
    for name in (clock, f"/{clock}"):
        if name in topics:
            return name
    raise UnknownName.among("topic with numbers in this file", clock, topics)


def _arm(
    path: Path, streams: Sequence[Stream], robot: Robot | None, clock: str | None
) -> tuple[Stream | None, list[str]]:
    """Return the JointState that is the arm's q, qd and tau, and notes about its joints."""
    states = [one for one in streams if one.type == JOINTS]
    if robot is not None:
        if not states:
            raise LogError(
                f"Expected a topic of type {JOINTS} with the joints of {robot.name} in {path}, got "
                f"{rate_text(streams) or 'none'}."
            )
        fitting = [one for one in states if _places(robot, one)]
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
            f"Expected one arm in {path}, got several: {arms}. Say which by robot=, a robot or the first part of its "
            "topics, or by clock=, its topic."
        )
    if not best:
        return None, []
    others = [name for name in best[0].joints if robot is not None and name not in _places(robot, best[0])]
    note = f"left out of {best[0].topic}, no joints of {robot.name if robot else ''}: {', '.join(others)}"
    return best[0], [note] if others else []


def _places(robot: Robot, stream: Stream) -> list[str]:
    """Return the joints of a stream that are the robot's, in its order; empty where one is missing.

    The names are those of ROS or of the description. A prefix that all of them have in front, as drivers of two arms
    give, does not count.
    """
    names = stream.joints
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
        f"Expected the joints of {robot.name} on {stream.topic} of {path}, got others. Only in the robot: {only_here}; "
        f"only in the log: {only_there}. Name the robot that was recorded, or leave robot= out."
    )


def _in_order(stream: Stream, robot: Robot) -> Stream:
    names = _places(robot, stream) if stream.type == JOINTS else []
    return stream.ordered(names) if names else stream


def _named(streams: Sequence[Stream], arm: Stream | None) -> tuple[list[Stream], list[str]]:
    """Return the streams with the names that columns have in the table, and notes about them."""
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
    """Return what is needed of the streams: the wanted columns, and the clock."""
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
    """Return the stream whose stamps are the rows."""
    several = [one for one in streams if len(one.log_ns) > 1]
    order = [*sorted(several, key=lambda one: "q" not in one.values), *streams]
    if clock is not None:
        order = sorted((one for one in order if one.topic == clock), key=lambda one: -len(one.log_ns))
        return next((one for one in order if "q" in one.values), order[0])
    if any(abs(one.rate - order[0].rate) > _SAME_RATE * order[0].rate for one in several):
        raise LogError(
            f"Expected topics of one rate in {path}, got several: {rate_text(streams)}. Name the topic whose stamps "
            f"are the rows, for example clock={order[0].topic!r}, or read columns of one, "
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
    """Return when each message was made [ns], by the clock that stamps the rows.

    Without a header, or by a header of another clock, that is when it was recorded, less the usual delay of the rows.
    """
    if rows.stamp_ns is None:
        return stream.log_ns
    delay = np.median(rows.log_ns - rows.stamp_ns)
    if stream.stamp_ns is not None and abs(np.median(stream.log_ns - stream.stamp_ns) - delay) < _ANOTHER_CLOCK * 1e9:
        return stream.stamp_ns
    return stream.log_ns - int(delay)


def _joined(table: Table, other: Stream, stamps: np.ndarray, rows: np.ndarray) -> Table:
    """Return the table with the columns of another stream, held from message to message."""
    columns = {name: replace(one, shape=()) for name, one in other.columns.items()}
    if len(stamps) == len(table) and len(rows) == len(table) and np.array_equal(stamps, rows):
        return replace(table, values={**table.values, **other.values}, columns={**table.columns, **columns})
    if other.topic.endswith("/tf_static"):  # never changes, whenever it was told
        stamps = np.minimum(stamps, table.t0_ns)
    order = np.argsort(stamps, kind="stable")
    order = order[np.append(np.diff(stamps[order]) > 0, True)]  # of equal stamps the last
    values: Mapping[str, np.ndarray] = {name: array[order] for name, array in other.values.items()}
    t = (stamps[order] - table.t0_ns) / 1e9
    return table.join(Table(t, values, columns, t0_ns=table.t0_ns))
