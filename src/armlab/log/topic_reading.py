"""Logs of other programs: MCAP files, rosbag2 of every storage, ROS 1 bags."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from armlab import robots
from armlab.errors import ArmlabError, LogError, UnknownName
from armlab.log.description import Progress
from armlab.log.formats import bag_files, format_at
from armlab.log.mcap_records import Contents, contents
from armlab.log.provenance import origin
from armlab.log.reading import opened, torn_sentence
from armlab.log.table import Table
from armlab.log.topic_fields import JOINTS
from armlab.log.topic_messages import TopicMessages, read_mcap_topics, read_rosbags_topics
from armlab.log.topic_streams import stem, streams_of
from armlab.log.topic_table import WRENCH, Choice, table_of_streams
from armlab.robots import Robot

__all__ = ["read_bag", "read_mcap_files"]

Wanted = Callable[[str, str], bool]


def read_mcap_files(
    path: Path, files: Sequence[Path], choice: Choice, robot: Robot | str | None, progress: Progress | None = None
) -> Table:
    """Return the table of MCAP files of another program, one or the pieces of a split bag.

    Parameters
    ----------
    path : that errors name. files : in order. choice : columns, clock and raw of `read`. robot : of `read`.
    progress : is told the bytes.

    Raises
    ------
    LogError, UnknownName : as `table_of_streams`.
    """
    with ExitStack() as stack:
        held = [(file, view, contents(view)) for file in files for view in [stack.enter_context(opened(file))]]
        topics = {channel.topic: channel.type for _, _, found in held for channel in found.channels.values()}
        choice, wanted = _chosen(topics, choice, robot)
        into = TopicMessages()
        for _, view, found in held:
            read_mcap_topics(view, found, wanted, into, progress)
        into.damage[:0] = [sentence for _, _, found in held for _, sentence in found.damaged]
        return _table(path, files, into, choice, {file: found for file, _, found in held if not found.finished})


def read_bag(path: Path, choice: Choice, robot: Robot | str | None, progress: Progress | None = None) -> Table:
    """Return the table of a rosbag2 folder, of its file in sqlite3, or of a ROS 1 bag, of another program.

    Parameters
    ----------
    path : of it. choice, robot : as in `read_mcap_files`. progress : is told the messages.

    Raises
    ------
    LogError : a damaged bag; what `table_of_streams` refuses. UnknownName : a topic or column that does not exist.
    """
    pieces = bag_files(path) if path.is_dir() else []
    if pieces and not (path / "metadata.yaml").is_file() and all(one.suffix == ".mcap" for one in pieces):
        return read_mcap_files(path, pieces, choice, robot, progress)  # its recorder was killed
    try:
        with _reader(path, pieces) as bag:
            inner = _plain_mcap(bag)
            if inner:
                return read_mcap_files(path, inner, choice, robot, progress)
            choice, wanted = _chosen({one.topic: one.msgtype for one in bag.connections}, choice, robot)
            into = TopicMessages()
            read_rosbags_topics(bag, wanted, into, progress)
    except ArmlabError:
        raise
    except Exception as error:  # rosbags raises its own errors, those of SQLite, YAML, zstd, struct and assertions
        what = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise LogError(f"Expected a whole bag in {path}, got a damaged one: {what[:200]}.") from None
    return _table(path, [path], into, choice, {})


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


def _table(
    path: Path, files: Sequence[Path], into: TopicMessages, choice: Choice, torn: Mapping[Path, Contents]
) -> Table:
    streams, notes = [], into.damage
    for topic, fields, decoded in into.decoded():
        found, doubts = streams_of(topic, fields, decoded)
        streams += found
        notes += doubts
    reason = into.left_out.get(choice.clock or "")
    if reason:
        raise LogError(f"Expected a topic with numbers as clock= for {path}, got {choice.clock}: {reason}.")
    left = [f"left out: {', '.join(f'{topic} ({why})' for topic, why in into.left_out.items())}"]
    table = table_of_streams(path, streams, choice, notes + left if into.left_out else notes)
    whole = [torn_sentence(file, found, table) for file, found in torn.items()]
    if whole or notes:
        warnings.warn("; ".join([*whole, *notes][:3]), stacklevel=4)
    return replace(table, notes=(*whole, *table.notes), source=tuple(origin(one) for one in files))
