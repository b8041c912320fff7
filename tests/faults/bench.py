"""A bridge and simulated controllers in one thread and in virtual time, with a bad network between them.

The bridge runs as on a real robot: real-time clock, time-outs, guard, recorder. Only `time` is ours, and the guard is
called where its thread would wake. So a minute passes in a second, and each run is the same as the last.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from armlab import robots
from armlab.bridge import Link, Run
from armlab.bridge.assembly import End
from armlab.bridge.control.supervision import Settings
from armlab.bridge.net.sockets import Arrival
from armlab.errors import LinkError
from armlab.log import Table
from armlab.sim.arm.arm import LaggingArm
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.settings import ControllerSettings as RobotSettings
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec
from armlab.wire.egm.robot_side import RobotSideCodec, SensorMessage

from .wire import GOOD, Bad, Way

__all__ = ["MIDDLE", "PERIOD", "ROBOT", "Bench", "Outcome", "Script", "Sent", "Station"]

ROBOT = robots.load("yumi_right")
MIDDLE = (ROBOT.q_min + ROBOT.q_max) / 2
PERIOD = 0.004032
COMPUTES = 3e-4  # s that a call of the controller takes
NAP = 2e-3  # s between two looks of the guard once it answers
BRIDGE = ("127.0.0.1", 6510)
WALL_NS = 1_700_000_000_000_000_000
PATIENCE = 5.0  # s of the bridge
MODULES = (
    "control.arm",
    "assembly",
    "control.loop",
    "control.recording",
    "control.supervision",
)  # of the bridge, that read a clock


class Sent(NamedTuple):
    """One reply as the bridge sent it, and where to."""

    t: float
    data: bytes
    to: tuple[str, int]


class Outcome(NamedTuple):
    """What a run left behind; `failure` is what it raised."""

    run: Run
    failure: BaseException | None

    @property
    def table(self) -> Table:
        return self.run.table

    @property
    def told(self) -> str:
        """Every word that the user could read: exception, report, events."""
        events = "\n".join(text for _, text in self.run.events)
        return f"{self.failure or ''}\n{self.run.report()}\n{events}"


class Station:
    """One robot's controller on the network.

    Parameters
    ----------
    source : where it sends from. bad, begin, end : of both directions, see `Way`. begins_at : its first cycle [s].
    q : (n,) where the arm is then. seed : of what goes wrong.

    Attributes
    ----------
    sources : all that it had. packets : (q measured, whether it guides, robot time) by the `tm` of each packet.
    motion : q and qd of the arm, cycle by cycle.
    alive : it takes part. change : what is done to each packet before it is sent.
    """

    def __init__(
        self,
        source: tuple[str, int] = ("127.0.0.1", 50001),
        bad: Bad = GOOD,
        begin: float = 0.0,
        end: float = math.inf,
        begins_at: float = 0.0,
        q: np.ndarray = MIDDLE,
        seed: int = 7,
    ) -> None:
        self.source, self.due, self.alive = source, begins_at, True
        self.sources = (source,)
        self.change: Callable[[bytes], bytes] = lambda data: data
        codec = RobotSideCodec(ROBOT, extension=True)
        self.controller = SimulatedController(LaggingArm(ROBOT, PERIOD, q), codec, RobotSettings(period=PERIOD))
        self.out, self.back = (Way(bad, begin, end, [seed, way], PERIOD) for way in (1, 2))
        self.packets: dict[int, tuple[np.ndarray, bool, float]] = {}
        self.motion: list[tuple[np.ndarray, np.ndarray]] = []

    def move(self, source: tuple[str, int]) -> None:
        """Go on from another port; what is under way to the old one is lost."""
        self.source, self.sources = source, (*self.sources, source)
        self.back.cut()

    def cycle(self) -> None:
        """Take what has arrived, send, move."""
        controller, now = self.controller, self.due
        self.due += PERIOD
        while (data := self.back.take(now)) is not None:
            controller.accept(data)
        if not self.alive:
            return
        tm = controller.packets.tm_ms(controller.cycle)
        guides = controller.phase == "guiding"
        packet = controller.packet()
        if packet is not None:
            self.packets[tm] = controller.arm.sample.q, guides, PERIOD * controller.cycle
            self.out.put(now, self.change(packet))
        controller.advance()
        self.motion.append((controller.arm.sample.q, controller.arm.sample.qd))


Script = Callable[[float, State], Command | None]
"""What a controller does: virtual time and state give a command."""


class Bench:
    """Virtual time, the network, and a bridge on it.

    Attributes
    ----------
    now : virtual time [s]. stations : on the network. sent : every reply, in order. script : what the controller does.
    wall_step : how far the wall clock was set since the beginning [s]. at : what happens at a time, by that time [s].
    takes : whether the system takes a reply.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        self.now = self.wall_step = 0.0
        self.stations = [Station()]
        self.sent: list[Sent] = []
        self.at: dict[float, Callable[[], None]] = {}
        self._eyes, self._heard = RobotSideCodec(ROBOT, extension=True), list[Any]()
        self.folder = folder
        self.takes: Callable[[], bool] = lambda: True
        self._loop: Any = None
        clock = SimpleNamespace(
            monotonic_ns=lambda: int(1e9 * self.now) + 10**9,
            monotonic=lambda: self.now + 1.0,
            time_ns=lambda: WALL_NS + int(1e9 * (self.now + self.wall_step)),
            sleep=lambda seconds: None,
        )
        waiting = SimpleNamespace(next=self._next)
        self._ours = {
            **{f"armlab.bridge.{module}.time": clock for module in MODULES},
            "armlab.bridge.link.Waiting": lambda *_: waiting,
            "armlab.bridge.link._enter_real_time": self._enter,
        }
        self._patch = monkeypatch.setattr
        port: Any = SimpleNamespace(
            host=BRIDGE[0], port=BRIDGE[1], errors=0, flush=self._flush, receive=self._receive, send=self._send,
            close=lambda: None,
        )  # fmt: skip
        settings = Settings(patience=PATIENCE)
        self.link = Link([End(ROBOT, port, EgmCodec(ROBOT, extension=True), ())], True, settings)

    def run(self, script: Script | None, **options: Any) -> Outcome:
        """Run the bridge; `script` is its controller."""
        for place, ours in self._ours.items():  # each time: there may be another bench
            self._patch(place, ours)
        controller = None if script is None else self._controller(script)
        failure = None
        record = self.folder / f"run{len(list(self.folder.iterdir()))}.mcap"
        try:
            self.link.run(controller, **{"record": record, "wait": "block", **options})
        except (LinkError, KeyboardInterrupt) as error:
            failure = error
        assert self.link.last is not None
        return Outcome(self.link.last, failure)

    def pass_time(self, seconds: float, guarded: bool = True) -> None:
        """Let time pass in the thread of the loop: the robots go on, and so does the guard, unless all stands still."""
        end = self.now + seconds
        while self.now < end:
            left = max(self._loop.overdue(), 0.0) if guarded and self._loop else math.inf
            self._advance(min(end, self.now + (left or NAP)))
            if guarded and self._loop and self._loop.overdue() <= 0.0:
                self._loop.answer_for_controller()

    def closing(self, patience: float) -> bool:
        """Wait, in another thread, until the run is over and its recording is to be closed."""
        recorder, end = self._loop._pace.recording._recorder, time.monotonic() + patience
        while not recorder._closed and time.monotonic() < end:
            time.sleep(0.001)
        return recorder._closed

    def written(self, patience: float) -> int:
        """Wait until all rows so far are in the file of the recording, and return how many they are."""
        recorder = self._loop._pace.recording._recorder
        end = time.monotonic() + patience
        while recorder._file.rows < recorder.rows:
            assert time.monotonic() < end
            time.sleep(0.001)
        return recorder.rows

    def _controller(self, script: Script) -> Callable[[State], Command | None]:
        def controller(state: State) -> Command | None:
            self.pass_time(COMPUTES)
            return script(self.now, state)

        return controller

    @contextmanager
    def _guarded(self, loop: Any) -> Iterator[None]:
        self._loop = loop
        yield
        self._loop = None

    def _enter(self, stack: Any, loop: Any, on_event: Any, wait: str) -> None:
        stack.enter_context(self._guarded(loop))

    def _advance(self, until: float) -> None:
        """Let one thing happen, not later than `until`."""
        robot = min(self.stations, key=lambda station: station.due)
        first = min([robot.due, until, *self.at])
        self.now = max(self.now, first)
        if first in self.at:
            self.at.pop(first)()
        elif robot.due <= first:
            robot.cycle()

    def _next(self, seconds: float) -> tuple[int, Arrival] | None:
        end = self.now + seconds
        while (arrival := self._receive()) is None and self.now < end:
            self._advance(min(end, *(station.out.due for station in self.stations)))
        return None if arrival is None else (0, arrival)

    def _receive(self) -> Arrival | None:
        station = min(self.stations, key=lambda station: station.out.due)
        due = station.out.due
        data = station.out.take(self.now)
        return None if data is None else Arrival(data, station.source, int(1e9 * due) + 10**9)

    def _flush(self) -> None:
        while self._receive() is not None:
            pass

    def _send(self, data: bytes, to: tuple[str, int]) -> bool:
        if not self.takes():
            return False
        self.sent.append(Sent(self.now, data, to))
        for station in self.stations:
            if station.source == to:
                station.back.put(self.now, data)
        return True

    def heard(self) -> list[Any]:
        """Return every reply sent, as a robot reads it."""
        for sent in self.sent[len(self._heard) :]:
            message = self._eyes.decode_sensor(sent.data)
            assert isinstance(message, SensorMessage)
            self._heard.append(message)
        return self._heard
