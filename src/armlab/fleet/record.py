"""`FleetRecorder`: the rows of many robots over Zenoh, in a file per robot."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

from armlab.bridge.servers.zenoh import EVERY, Asking, Place, close_session, key, robot_of, undamaged
from armlab.bridge.servers.zenoh.rows import Inbox
from armlab.bridge.servers.zenoh.session import zenoh
from armlab.fleet.robot_record import RobotRecord
from armlab.log.recorder import FLUSH_PERIOD, WRITE_PERIOD

__all__ = ["FleetRecorder"]

_INBOX = 50_000  # messages: 20 s of ten robots; what does not fit is a hole in the ticks
_ROBOTS = 1000
_ROOM = 2**28  # bytes of rows that wait for descriptions, of all robots: ten seconds of fifty
_NAME = re.compile(r"[\w+-][\w.+-]{0,99}")  # what can be the name of a file
_NAMES = 220  # bytes of lab and robot together: a letter may take four, and systems allow 255 with number and ending


class FleetRecorder:
    """Records every robot whose rows come, from now until it is closed; a context manager.

    A robot may come, go, and come again with other rows. One MCAP file per run of its bridge: ``lab1-yumi_left.mcap``,
    then ``-2``. Rows that did not come show as holes in the robot's ticks: an event and the summary of the file name
    them. A file that cannot be written is given up, with a sentence, and the recording of a robot in which something
    else goes wrong has ended; the other robots go on.

    Parameters
    ----------
    place : of the router; its `lab` may be `EVERY`. folder : for the files. tell : told what a person should know, in
        a thread of the recorder's.

    Attributes
    ----------
    robots : by "lab/robot": rows, lost, damaged, refused, late, paths, failed.
    strangers : messages under keys of no robot.

    Raises
    ------
    LinkError : no router. MissingExtra : no Zenoh.
    """

    def __init__(self, place: Place, folder: str | Path, tell: Callable[[str], None] = lambda text: None) -> None:
        self._folder, self._tell = Path(folder), tell
        self._robots: dict[str, RobotRecord] = {}
        self._ended: set[str] = set()  # robots of whom nothing more is recorded
        self.strangers = 0
        self._inbox: Inbox[tuple[Callable[[RobotRecord], None], str]] = Inbox(_INBOX)
        self._room = _ROOM
        self._wake, self._closed = threading.Event(), False
        self._session = place.open_behind()
        self._asking = Asking(self._session, self._answered)
        declare, liveliness = self._session.declare_subscriber, self._session.liveliness()
        self._thread = threading.Thread(target=self._run, name="fleet recorder", daemon=True)
        self._thread.start()
        self._rows = declare(key(place.lab, EVERY, "state"), self._take)
        self._alive = liveliness.declare_subscriber(key(place.lab, EVERY, "alive"), self._take_life, history=True)

    def __enter__(self) -> FleetRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def robots(self) -> Mapping[str, RobotRecord]:
        """What is known of each robot."""
        return dict(self._robots)

    def close(self) -> None:
        """Write what has come, and finish all files."""
        if self._closed:
            return
        close_session(self._session)
        self._closed = True
        self._wake.set()
        self._thread.join()

    def _take(self, sample: Any) -> None:
        data = undamaged(sample)
        self._inbox.put((partial(self._row, data=data), str(sample.key_expr)), len(data or b""))

    def _take_life(self, sample: Any) -> None:
        has_come = sample.kind == zenoh().SampleKind.PUT
        self._inbox.put((partial(self._live, has_come=has_come), str(sample.key_expr)))

    def _row(self, robot: RobotRecord, data: bytes | None) -> None:
        """Take a row; one that finds no room is lost, as its tick will show."""
        size = len(data or b"")
        if size <= self._room:
            self._room -= size
            robot.take(data)

    def _live(self, robot: RobotRecord, has_come: bool) -> None:
        text = "its bridge is there" if has_come else "its bridge has gone, or the way to it"
        if not has_come:
            robot.doubt()
        robot.event(text)
        self._tell(f"{robot.name}: {text}")

    def _run(self) -> None:
        due, is_last = time.monotonic() + FLUSH_PERIOD, False
        while not is_last:
            self._wake.wait(WRITE_PERIOD)
            is_last = self._closed  # looked at before the inbox is emptied: what came until then is in it
            for _ in range(len(self._inbox)):
                message = self._inbox.get()
                if message is None:
                    break
                work, where = message
                robot = self._robot(where)
                if robot is None:
                    self.strangers += 1
                else:
                    self._do(robot, work)
            for robot in self._robots.values():
                self._do(robot, RobotRecord.write)
                if robot.wants and not is_last:
                    lab, _, name = robot.name.partition("/")
                    self._asking.ask(lab, name)
            self._room = _ROOM - sum(robot.waiting for robot in self._robots.values())
            if time.monotonic() >= due:
                for robot in self._robots.values():
                    self._do(robot, RobotRecord.flush)
                due = time.monotonic() + FLUSH_PERIOD
        for robot in self._robots.values():
            self._do(robot, RobotRecord.close)

    def _do(self, robot: RobotRecord, work: Callable[[RobotRecord], None]) -> None:
        """Do something for a robot; what goes wrong there ends its recording, and not the others'."""
        if robot.name in self._ended:
            return
        try:
            work(robot)
        except Exception as error:
            self._ended.add(robot.name)
            with contextlib.suppress(OSError):  # of the file that is given up
                robot.end(f"{type(error).__name__}: {error}")

    def _robot(self, where: str) -> RobotRecord | None:
        lab, name = robot_of(where)
        full = f"{lab}/{name}"
        if full not in self._robots:
            is_name = _NAME.fullmatch(lab) and _NAME.fullmatch(name) and len(full.encode()) <= _NAMES
            if len(self._robots) >= _ROBOTS or not is_name:
                return None
            self._robots[full] = RobotRecord(full, self._folder / f"{lab}-{name}.mcap", self._tell)
        return self._robots[full]

    def _answered(self, lab: str, name: str, about: bytes) -> None:
        self._inbox.put((partial(RobotRecord.describe, about=about), key(lab, name, "about")), len(about))
