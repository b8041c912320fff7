"""A recording from which rows, events and all that belongs to them go into another."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armlab.errors import ArmlabError, LogError
from armlab.log.formats import check_readable, naming, opened
from armlab.log.mcap_records import DAMAGE, Contents, contents
from armlab.log.messages import COLUMN_KEY, topic_name
from armlab.log.provenance import file_hash
from armlab.log.recording_columns import clock_channel, clocks, earlier, rows_of, summary_of
from armlab.log.splice_arm import Arm

__all__ = ["Source", "attachments", "metadata", "opened_source", "summary"]

_PARAMETER = "armlab_msgs/msg/Parameter"
_SUMMARY = "summary.json"
Message = tuple[int, int, int, int, bytes]  # channel, sequence, log and publish time, data


@dataclass(slots=True)
class Source:
    """One recording.

    Attributes
    ----------
    path, view, found : the file, its bytes and its contents. arms : its robots. chain : where its rows come from.
    numbers : channel in the new file by channel here.
    """

    path: Path
    view: memoryview
    found: Contents
    arms: list[Arm]
    chain: tuple[str, ...]
    numbers: dict[int, int] = field(default_factory=dict)
    _routes: dict[int, tuple[int | None, Arm | None, bool, bool, bool]] = field(default_factory=dict)

    @property
    def start_ns(self) -> int:
        """Wall clock of the first row."""
        return min(arm.start_ns for arm in self.arms)

    @property
    def end_ns(self) -> int:
        """Wall clock of the last row."""
        return max(arm.end_ns for arm in self.arms)

    @property
    def summary(self) -> dict[str, Any]:
        """What was counted at its end, empty without."""
        return summary_of(self.view, self.found)

    def keep(self, robot: str) -> None:
        """Take the rows and events of one robot only; metadata and attachments are of the whole file, and stay.

        Parameters
        ----------
        robot : its name.

        Raises
        ------
        UnknownName : it is not in this file.
        """
        topic = self.found.channels[clock_channel(self.found, self.path, robot)].topic
        others = tuple(arm.prefix for arm in self.arms if not topic.startswith(arm.prefix))
        self.arms = [arm for arm in self.arms if arm.prefix not in others]
        channels = self.found.channels.items()
        self.found.channels = {number: one for number, one in channels if not one.topic.startswith(others)}

    def taken(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> tuple[Message, ...]:
        """Return what becomes of a message in the new file: nothing, it, or it and `t`.

        What lies between the first and the last row that are taken is taken; of parameters, what was set before, too.
        """
        route = self._routes.get(channel)
        if route is None:
            route = self._routes[channel] = self._route(channel)
        number, arm, is_clock, is_row, is_history = route
        if number is None:
            return ()
        if arm is None:
            inside = any(arm.inside for arm in self.arms)
            return ((number, sequence, log_ns, publish_ns, data),) if inside else ()
        seconds = arm.arrive(sequence, log_ns) if is_clock else None
        if not (arm.inside or (is_history and not arm.is_over)):
            return ()
        place = arm.number(sequence) if is_row else sequence
        message = (number, place, log_ns, publish_ns, data)
        return (message,) if seconds is None else (message, (arm.seconds_number, place, log_ns, publish_ns, seconds))

    def _route(self, channel: int) -> tuple[int | None, Arm | None, bool, bool, bool]:
        """Return channel in the new file, its arm, and whether its messages are rows, parts of rows, parameters."""
        about = self.found.channels.get(channel)
        if about is None:
            return None, None, False, False, False
        arm = next((arm for arm in self.arms if about.topic.startswith(arm.prefix)), None)
        is_clock = arm is not None and channel == arm.rows.channel
        is_row = any(key.startswith(COLUMN_KEY) for key in about.metadata)
        return self.numbers.get(channel), arm, is_clock, is_row, about.type == _PARAMETER


@contextmanager
def opened_source(path: Path) -> Iterator[Source]:
    """Open a recording, finished or torn.

    Raises
    ------
    LogError : the file is missing, of another format, no recording of armlab, or damaged beyond use.
    """
    check_readable(path)
    with opened(path) as view:
        try:
            with naming(path):
                found = contents(view)
            clock_channel(found, path, None) if not clocks(found) else None  # says that it is no recording
            arms = [_arm(path, view, found, topic) for topic in clocks(found).values()]
        except ArmlabError:
            raise
        except DAMAGE as error:
            raise LogError(f"Expected a whole recording in {path}, got a damaged one ({error}).") from None
        if not found.finished:
            warnings.warn(f"{path.name} was not finished: what can be read of it is taken", stacklevel=3)
        yield Source(path, view, found, arms, (f"{path.name} sha256 {file_hash(path)}", *earlier(view, found)))


def _arm(path: Path, view: memoryview, found: Contents, topic: str) -> Arm:
    prefix = topic.rpartition("/")[0] + "/"
    name = prefix.strip("/")
    own = {number: channel for number, channel in found.channels.items() if channel.topic.startswith(prefix)}
    seconds = next((number for number, channel in own.items() if f"{COLUMN_KEY}t" in channel.metadata), None)
    about = next((pairs for pairs in found.metadata.values() if topic_name(pairs.get("robot", "")) == name), {})
    return Arm(path, prefix, about.get("robot_hash", ""), rows_of(view, found, path, name), seconds)


def metadata(sources: list[Source]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the maps of all sources by name; one that has another content under a known name gets a number."""
    known: dict[str, dict[str, str]] = {}
    for source in sources:
        for name, pairs in source.found.metadata.items():
            own = _own_name(name, pairs, known)
            if own is not None:
                yield own, pairs


def attachments(sources: list[Source]) -> Iterator[tuple[int, str, str, bytes]]:
    """Yield (time, name, kind, data) of the attachments of all sources, without their summaries."""
    known: dict[str, bytes] = {}
    for source in sources:
        for one in source.found.attachments:
            data = bytes(source.view[slice(*one.data)])
            own = None if one.name == _SUMMARY else _own_name(one.name, data, known)
            if own is not None:
                yield one.log_ns, own, one.media_type, data


def _own_name(name: str, content: Any, known: dict[str, Any]) -> str | None:
    """Return the name, with a number where it stands for something else; None for what is there already."""
    stem, dot, ending = name.partition(".")
    number, own = 1, name
    while own in known:
        if known[own] == content:
            return None
        number += 1
        own = f"{stem}-{number}{dot}{ending}"
    known[own] = content
    return own


def summary(sources: list[Source], operation: str) -> dict[str, Any]:
    """Return what is counted of the new file: rows, what was dropped between them, and where they come from."""
    holes = [hole for source in sources for hole in _holes(source)]
    originals: dict[str, Any] = {}
    for source in sources:
        originals |= source.summary.get("originals") or {source.path.name: source.summary}
    return {
        "rows": sum(arm.rows_left for source in sources for arm in source.arms),
        "dropped": sum(hole[2] for hole in holes),
        "holes": holes,
        "source": [*(entry for source in sources for entry in source.chain), operation],
        "originals": originals,
    }


def _holes(source: Source) -> list[list[Any]]:
    """Return the holes that the recorder left between the rows that are taken.

    Each is first tick, last tick, rows, the number of the first tick among the rows of the new file (of recordings that
    are put together, rows are numbered on, and ticks come again), and whose rows they are.
    """
    found = []
    for first, last, rows, *more in source.summary.get("holes", []):
        begin, robot = (more[0] if more else first), (more[1] if len(more) > 1 else None)
        for arm in source.arms:
            own = robot in (None, arm.name) and arm.rows_left
            if own and arm.ticks[0] < begin and begin + last - first < arm.ticks[1]:
                found.append([first, last, rows, arm.number(begin), arm.name])
                break
    return found
