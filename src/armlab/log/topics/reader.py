"""Logs of other programs: MCAP files, rosbag2 of every storage, ROS 1 bags."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from armlab import robots
from armlab.errors import ArmlabError, LogError, UnknownName
from armlab.log.file_formats.description import Progress
from armlab.log.file_formats.opening import BAGS, bag_files, check_readable, format_at, naming, opened, origin
from armlab.log.file_formats.rosbag2 import is_ours
from armlab.log.mcap.records import Contents, contents
from armlab.log.recording.columns import clocks, torn_sentence
from armlab.log.table import Table
from armlab.log.topics.messages import TopicMessages, read_mcap_topics, read_rosbags_topics
from armlab.log.topics.streams import JOINTS, Stream, stem, streams_of
from armlab.log.topics.tables import WRENCH, Choice, table_of_streams, tables_of_streams
from armlab.robots import Robot

Wanted = Callable[[str, str], bool]


def is_foreign(path: Path) -> bool:
    """Return whether a path is a log of another program: a bag, or an MCAP file that armlab has not written."""
    kind = format_at(path)
    if kind == "MCAP":
        with opened(path) as view, naming(path):
            return not clocks(contents(view))
    return kind in BAGS and names_robots(path)


@dataclass(frozen=True, slots=True)
class _Held:
    """What the files of a log hold: the choice with its robot, the topics, and files that were not finished."""

    files: Sequence[Path]
    choice: Choice
    topics: TopicMessages
    torn: Mapping[Path, Contents] = field(default_factory=dict)


def read_foreign(path: Path, choice: Choice, robot: Robot | str | None, progress: Progress | None = None) -> Table:
    """Return the table of another program's log: an MCAP file, a rosbag2, a ROS 1 bag."""
    held = _held(path, choice, robot, progress)
    streams, notes = _streams(held.topics)
    reason = held.topics.left_out.get(choice.clock or "")
    if reason:
        raise LogError(f"Expected a topic with numbers as clock= for {path}, got {choice.clock}: {reason}.")
    table = table_of_streams(path, streams, held.choice, [*notes, *_left_out(held.topics)])
    whole = [torn_sentence(file, found, table) for file, found in held.torn.items()]
    if whole or notes:
        warnings.warn("; ".join([*whole, *notes][:3]), stacklevel=3)
    return replace(table, notes=(*whole, *table.notes), source=tuple(origin(one) for one in held.files))


def read_joints(path: Path, robot: Robot, progress: Progress | None = None) -> Table:
    """Return q, and qd and tau as far as they are there, of an arm in another program's log, in its own order.

    Drivers name joints in an order of theirs, and log other things at other rates: both are no matter here.
    """
    for columns in (["q", "qd", "tau"], ["q", "tau"], ["q", "qd"]):
        with suppress(UnknownName):
            return read_foreign(path, Choice(columns), robot, progress)
    return read_foreign(path, Choice(["q"]), robot, progress)


def read_topics(
    path: str | Path, *, robot: Robot | str | None = None, progress: Progress | None = None
) -> dict[str, Table]:
    """Return the topics of another program's log one by one, each on its own clock, t = 0 at its first message.

    Columns have the names that `read` gives them, but those of every JointState are q, qd and tau. Transforms of one
    topic that do not come together, and joints that never do, are tables of their own. The notes of each tell what is
    damaged in the file, and the topics that are left out.

    Parameters
    ----------
    path : an MCAP file, a rosbag2, a ROS 1 bag. robot : of `read`. progress : called with (done, total, what).

    Raises
    ------
    LogError : it is no such log, or damaged beyond use. UnknownName : no such robot.
    """
    path = Path(path)
    if format_at(path) not in ("MCAP", *BAGS):
        check_readable(path)
    held = _held(path, Choice(), robot, progress)
    streams, notes = _streams(held.topics)
    notes += [f"{file.name} was not finished: {found.torn} bytes torn" for file, found in held.torn.items()]
    source, of_file = tuple(origin(one) for one in held.files), (*notes, *_left_out(held.topics))
    if notes or not streams:
        warnings.warn("; ".join(of_file[:3]) or f"{path.name} has no topic with numbers", stacklevel=2)
    tables = tables_of_streams(path, streams, held.choice)
    return {name: replace(one, notes=(*of_file, *one.notes), source=source) for name, one in tables.items()}


def _held(path: Path, choice: Choice, robot: Robot | str | None, progress: Progress | None) -> _Held:
    if path.is_file() and format_at(path) == "MCAP":
        return _held_in_mcap([path], choice, robot, progress)
    pieces = bag_files(path) if path.is_dir() else []
    if pieces and not (path / "metadata.yaml").is_file() and all(one.suffix == ".mcap" for one in pieces):
        return _held_in_mcap(pieces, choice, robot, progress)  # its recorder was killed
    try:
        with _reader(path, pieces) as bag:
            inner = _plain_mcap(bag)
            if inner:
                return replace(_held_in_mcap(inner, choice, robot, progress), files=[path])
            choice, wanted = _chosen({one.topic: one.msgtype for one in bag.connections}, choice, robot)
            into = TopicMessages()
            read_rosbags_topics(bag, wanted, into, progress)
    except ArmlabError:
        raise
    except Exception as error:  # rosbags raises its own errors, those of SQLite, YAML, zstd, struct and assertions
        what = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise LogError(f"Expected a whole bag in {path}, got a damaged one: {what[:200]}.") from None
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
    """Return the streams of all topics, and what was wrong with some."""
    streams: list[Stream] = []
    notes: list[str] = []
    for topic, fields, decoded in topics.decoded():
        found, doubts = streams_of(topic, fields, decoded)
        streams += found
        notes += doubts
    return streams, [*topics.damage, *notes]


def _left_out(topics: TopicMessages) -> list[str]:
    listed = ", ".join(f"{topic} ({why})" for topic, why in topics.left_out.items())
    return [f"left out: {listed}"] if listed else []


def _reader(path: Path, pieces: Sequence[Path]) -> Any:
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        path = pieces[0]  # in sqlite3
    kind = format_at(path)
    if kind == "ROS 1 bag":
        from rosbags.rosbag1 import Reader as Ros1Reader

        return Ros1Reader(path)
    if kind != "rosbag2" and path.suffix != ".db3":
        raise LogError(f"Expected the folder of a rosbag2 or a file in it that ends in .db3, got {path}. Rename it.")
    from rosbags.rosbag2 import Reader

    return Reader(path)


def _plain_mcap(bag: Any) -> list[Path]:
    """Return the MCAP files of an open rosbag2 whose messages are not packed one by one."""
    inner = getattr(bag, "storage", None)
    if getattr(getattr(inner, "metadata", None), "compression_mode", None) == "message":
        return []
    paths = [Path(one.path) for one in getattr(inner, "storages", ()) if hasattr(one, "path")]
    return paths if all(path.suffix == ".mcap" for path in paths) else []


def _chosen(topics: dict[str, str], choice: Choice, robot: Robot | str | None) -> tuple[Choice, Wanted]:
    """Return the choice with its robot, and which topics are read.

    The name of a robot is one of the library, or the first part of its topics, or both.
    """
    inside = set(topics)
    if isinstance(robot, str):
        prefix = f"/{robot.strip('/')}/"
        namespace = {topic for topic in topics if topic.startswith(prefix)}
        known = robot in robots.names() or robot.endswith((".toml", ".urdf"))
        if not namespace and not known:
            names = {topic.split("/")[1] for topic in topics if topic.count("/") > 1} | set(robots.names())
            raise UnknownName.among("robot of the library, or first part of topics in this file", robot, names)
        inside = namespace or inside
        choice = replace(choice, robot=robots.load(robot) if known else None)
    elif robot is not None:
        choice = replace(choice, robot=robot)
    needed = _needed({topic: kind for topic, kind in topics.items() if topic in inside}, choice.columns)
    clock = {choice.clock, f"/{choice.clock}"}
    return choice, lambda topic, _: topic in needed or topic in clock


def _needed(topics: dict[str, str], columns: Sequence[str] | None) -> set[str]:
    """Return the topics that may hold the columns; all, where one is held by none, so that the error can list them."""
    if columns is None:
        return set(topics)
    needed: set[str] = set()
    for name in {column.removesuffix("_age").removeprefix("topic.") for column in columns}:
        kinds = {JOINTS} if name in ("q", "qd", "tau") else {WRENCH} if name == "wrench_raw" else set()
        held = {one for one in topics if topics[one] in kinds or f"{name}.".startswith(f"{stem(one)}.")}
        if not held:
            return set(topics)
        needed |= held
    together = {topics[one] for one in needed} & {JOINTS, WRENCH}  # each is named by what the others are
    return needed | {one for one, kind in topics.items() if kind in together}


def names_robots(path: Path) -> bool:
    """Tell whether a log tells by its topics whose rows it has, so that `read` takes robot=; a table alone does not."""
    kind = format_at(path)
    return kind == "MCAP" or (kind in BAGS and not (kind == "rosbag2" and is_ours(path)))
