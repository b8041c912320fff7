"""`Topics`: what goes out under which name, made from rows; a topic that nobody reads costs nothing."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from struct import Struct
from typing import Any

from armlab.bridge.servers.ros.mapping import FORMS, Arm, Kind, diagnostics
from armlab.bridge.servers.ros.message_template import Encode, plan
from armlab.bridge.servers.ros.types import store
from armlab.bridge.servers.row import MONO, WALL, RowSchema, beginning, places, read_head, read_row
from armlab.bridge.servers.status import Status
from armlab.errors import ShapeError
from armlab.kernels import RowMessages
from armlab.robots import Robot

__all__ = ["Encoded", "Published", "Topics"]

_SELDOM = 1_000_000_000  # ns between two messages of the topics that change seldom
_MONO = Struct("<q")


@dataclass(frozen=True)
class Published:
    """A topic that goes out: its full name and its ROS 2 type, for example "sensor_msgs/msg/JointState"."""

    name: str
    type: str


class Topics:
    """The topics of a cell.

    Parameters
    ----------
    robots : the arms by name. schema : of the rows.

    Attributes
    ----------
    published : by full name. often : names of those that come with every row. schema : as given.
    answer : to a client that has no other way to learn why it was refused; it goes with the diagnostics.
    """

    def __init__(self, robots: Mapping[str, Robot], schema: RowSchema) -> None:
        self.answer = ""
        self.schema, self._robots, self._status = schema, dict(robots), Status(schema)
        self._due, self._last = 0, b""
        self._silence: tuple[bytes, int] | None = None  # the last row, and since when none came
        self._places = {name: places(schema, name) for name in robots}
        self._forms = {f"/{robot}/{name}": (robot, form) for robot in robots for name, form in FORMS.items()}
        self.often = frozenset(self._forms)
        seldom = {f"/{robot}/{name}": type_ for robot in robots for name, type_ in _SELDOM_TYPES.items()}
        found = {name: form.type for name, (_, form) in self._forms.items()} | seldom
        self.published = {name: Published(name, type_) for name, type_ in found.items()}

    def of_row(self, data: bytes, wanted: Collection[str]) -> Iterator[tuple[Published, Any]]:
        """Yield the messages of a row: of the arm that it is the row of, and of those topics only.

        Parameters
        ----------
        data : one row, of the schema. wanted : full names.

        Yields
        ------
        The topic and a message object of `ros.store`. A topic the row has no number for has no message.

        Raises
        ------
        LinkError : no row of this schema.
        """
        yield from self.often_of_row(data, wanted)
        yield from self.seldom_of_row(data, wanted)

    def often_of_row(self, data: bytes, wanted: Collection[str]) -> Iterator[tuple[Published, Any]]:
        """Yield the messages that come with every row.

        Parameters
        ----------
        data, wanted : as of `of_row`.

        Yields
        ------
        As `of_row`.

        Raises
        ------
        LinkError : no row of this schema.
        """
        _, _, wall_ns = read_head(self.schema, data)
        arms: dict[str, Arm] = {}
        for name, robot in self._robots.items():
            arm = Arm(robot, self._places[name], data, wall_ns)
            if arm["fresh"][0]:
                arms[name] = arm
        for name in wanted:
            robot, form = self._forms.get(name, ("", None))
            if form is not None and robot in arms:
                columns = form.columns(arms[robot])
                if columns is not None:
                    yield self.published[name], form.message(arms[robot].robot, wall_ns, columns)

    def maker(self, encode: Encode) -> tuple[dict[str, int], RowMessages]:
        """Return what makes bytes of rows without message objects, and its number of each topic that it makes.

        Parameters
        ----------
        encode : what the bytes are like.
        """
        made = {name: about for name, about in self._forms.items() if about[1].kind is not Kind.OTHER}
        plans = [plan(form, self._robots[robot], self._places[robot], encode) for robot, form in made.values()]
        maker = RowMessages(beginning(self.schema), self.schema.size, WALL, plans)
        return {name: number for number, name in enumerate(made)}, maker

    def seldom_of_row(self, data: bytes, wanted: Collection[str]) -> Iterable[tuple[Published, Any]]:
        """Count a row, and return the messages that are due once a second.

        Parameters
        ----------
        data : one row, of the schema. wanted : full names.

        Returns
        -------
        As `of_row` yields them; nearly always none.
        """
        self._status.add(data)
        self._last = data
        (mono_ns,) = _MONO.unpack_from(data, MONO)
        return self._seldom(mono_ns, 0, wanted)

    def of_silence(self, now_ns: int, wanted: Collection[str]) -> Iterable[tuple[Published, Any]]:
        """Return what is due once a second while no row comes; to be called about as often.

        Parameters
        ----------
        now_ns : any clock that goes on. wanted : full names.

        Returns
        -------
        As `of_row` yields them; nothing when a row came since the call before.
        """
        if self._silence is None or self._silence[0] is not self._last:
            self._silence = self._last, now_ns
            return ()
        silent_ns = now_ns - self._silence[1]
        mono_ns = _MONO.unpack_from(self._last, MONO)[0] if self._last else 0
        return self._seldom(mono_ns + silent_ns, silent_ns, wanted)

    def _seldom(self, mono_ns: int, silent_ns: int, wanted: Collection[str]) -> Iterable[tuple[Published, Any]]:
        if mono_ns < self._due:
            return ()
        self._due = mono_ns + _SELDOM
        names = [robot for robot in self._robots if f"/{robot}/diagnostics" in wanted]
        return self._diagnostics(names, mono_ns, silent_ns) if names else ()

    def _diagnostics(self, names: list[str], mono_ns: int, silent_ns: int) -> Iterator[tuple[Published, Any]]:
        row, arms = read_row(self.schema, self._last) if self._last else None, self._status.summary()["arms"]
        wall_ns = time.time_ns() if row is None else row.wall_ns + silent_ns
        for robot in names:
            commander = "" if row is None or silent_ns > _SELDOM else row.values[f"{robot}.commander"]
            last_ns = arms[robot]["last_ns"]
            silent = math.inf if last_ns is None else 1e-9 * (mono_ns - last_ns)
            message = diagnostics(robot, wall_ns, arms[robot], commander, self.answer, silent)
            yield self.published[f"/{robot}/diagnostics"], message

    def of_parameters(
        self, parameters: Mapping[str, Mapping[str, Any]], wanted: Collection[str]
    ) -> Iterator[tuple[Published, Any]]:
        """Yield the values of all parameters in force as JSON text, for each robot's "parameters".

        Parameters
        ----------
        parameters : see `LoopEnd.parameters`. wanted : full names.
        """
        text = json.dumps({name: about["value"] for name, about in parameters.items()})
        message = store().types["std_msgs/msg/String"](text)
        for name in (f"/{robot}/parameters" for robot in self._robots):
            if name in wanted:
                yield self.published[name], message


class Encoded:
    """The messages of topics as bytes. Those that people read at the rate of the rows are made without their objects.

    Parameters
    ----------
    topics : see `Topics`. encode : see `mould.Encode`.
    """

    def __init__(self, topics: Topics, encode: Encode) -> None:
        self._topics, self._encode = topics, encode
        self._numbers, self._maker = topics.maker(encode)
        self._choose(frozenset())

    def of_row(self, data: bytes, wanted: Collection[str]) -> Iterator[tuple[Published, bytes]]:
        """Yield the bytes of what `Topics.of_row` yields.

        Parameters
        ----------
        data, wanted : see there.
        """
        if wanted != self._wanted:
            self._choose(frozenset(wanted))
        try:
            made = self._maker.of_row(data, self._asked)
        except ShapeError:
            read_head(self._topics.schema, data)
            raise
        for topic, message in zip(self._often, made):
            if message is not None:
                yield topic, message
        if self._others:
            for topic, message in self._topics.often_of_row(data, self._others):
                yield topic, self._encode(message, topic.type)
        for topic, message in self._topics.seldom_of_row(data, wanted):
            yield topic, self._encode(message, topic.type)

    def of_silence(self, now_ns: int, wanted: Collection[str]) -> Iterator[tuple[Published, bytes]]:
        """Yield the bytes of what `Topics.of_silence` returns.

        Parameters
        ----------
        now_ns, wanted : see there.
        """
        for topic, message in self._topics.of_silence(now_ns, wanted):
            yield topic, self._encode(message, topic.type)

    def _choose(self, wanted: frozenset[str]) -> None:
        self._wanted = wanted
        names = [name for name in wanted if name in self._numbers]
        self._often = [self._topics.published[name] for name in names]
        self._asked = [self._numbers[name] for name in names]
        self._others = wanted & self._topics.often - self._numbers.keys()

    def of_parameters(
        self, parameters: Mapping[str, Mapping[str, Any]], wanted: Collection[str]
    ) -> Iterator[tuple[Published, bytes]]:
        """Yield the bytes of what `Topics.of_parameters` yields.

        Parameters
        ----------
        parameters, wanted : see there.
        """
        for topic, message in self._topics.of_parameters(parameters, wanted):
            yield topic, self._encode(message, topic.type)


_SELDOM_TYPES = {"diagnostics": "diagnostic_msgs/msg/DiagnosticArray", "parameters": "std_msgs/msg/String"}
