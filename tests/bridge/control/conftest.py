"""Loop fed manually, on a clock that only the test advances: no sockets, threads or waiting."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge import Limits
from armlab.bridge.control.arm import ArmSession, End
from armlab.bridge.control.loop import Loop
from armlab.bridge.control.run import assemble
from armlab.bridge.control.supervision import Settings
from armlab.bridge.net.sockets import Arrival
from armlab.log import Tick
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec
from armlab.wire.egm.robot_side import RobotSideCodec, SensorMessage

from ..conftest import PERIOD_NS, Packets

MODULES = ("arm", "run", "loop", "recording", "supervision")  # modules of bridge.control that read a clock
CONTROLLER = ("127.0.0.1", 5000)
MS = 1_000_000
LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def drift(state: State) -> Command:
    return Command(qd=np.full(len(state.q), 0.1))


class Clock:
    """Replacement for `time`; `now` is the current time [ns]."""

    def __init__(self) -> None:
        self.now = 50_000_000_000
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        return self.now

    def time_ns(self) -> int:
        return self.now + 1_700_000_000_000_000_000

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += int(1e9 * seconds)


class HandPort:
    """Port with its waiting and sent datagrams."""

    host, port, errors = "127.0.0.1", 6510, 0

    def __init__(self) -> None:
        self.waiting: deque[Arrival] = deque()
        self.sent: list[bytes] = []
        self.works = True

    def receive(self) -> Arrival | None:
        return self.waiting.popleft() if self.waiting else None

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        assert to == CONTROLLER
        self.sent += [data] * self.works
        return self.works


class Hands:
    """Loop with a robot controller for each arm."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, robots: Sequence[Robot], controller: Any, **options: Any
    ) -> None:
        self.clock = Clock()
        monkeypatch.setattr("armlab.bridge.control.state_machine.READY_AFTER", 1)  # three packets: see test_feedback.py
        for name in MODULES:
            monkeypatch.setattr(f"armlab.bridge.control.{name}.time", self.clock)
        self.ports = [HandPort() for _ in robots]
        self.robots = [Packets(robot, options.get("extension", False)) for robot in robots]
        self.step = options.pop("period_ns", PERIOD_NS)
        self.warned: list[str] = []
        self.rows: list[tuple[State, Command | None, Tick]] = []
        pace, sources = options.pop("pace", ()), options.pop("sources", ())
        extension, answer_stream = options.pop("extension", False), options.pop("answer_stream", True)
        self.settings = Settings(**options)
        ends: Any = [
            End(robot, port, EgmCodec(robot, extension))  # type: ignore[arg-type]
            for robot, port in zip(robots, self.ports, strict=True)
        ]
        self.arms: list[ArmSession] = assemble(
            ends,
            [Limits.of(robot) for robot in robots],
            self.settings,
            commands=controller is not None,
            answer_stream=answer_stream,
            record=None,
            extra=None,
            attachments={},
            feeds=[self],
            sources=sources,
        )
        self.waits: list[float] = []
        self.loop = Loop(self.arms, self, controller, self.settings, *pace)

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Act as a feed, together with `event`."""
        self.rows.append((state, command, tick))

    def event(self, text: str, warn: bool = False) -> None:
        self.warned += [text] * warn

    def next(self, seconds: float) -> tuple[int, Arrival] | None:
        """Act as `Waiting`: nothing arrives while the loop waits."""
        self.waits.append(seconds)
        for index, port in enumerate(self.ports):
            if port.waiting:
                return index, port.waiting.popleft()
        self.clock.now += int(1e9 * seconds)
        return None

    def put(self, index: int = 0, after: int | None = None, **fields: Any) -> None:
        """Advance the clock, by default by one period, and let a packet arrive."""
        self.clock.now += self.step if after is None else after
        packets = self.robots[index]
        tm = 10_000 + packets.cycle * self.step // 1_000_000
        stamp = {"tm_ms": tm, "robot_ns": 1_700_000_000_000_000_000 + packets.cycle * self.step}
        data = packets(**{**stamp, **fields})
        self.ports[index].waiting.append(Arrival(data, CONTROLLER, self.clock.now))

    def garbage(self) -> Arrival:
        """Return an invalid datagram from the robot's own address."""
        return Arrival(b"garbage", CONTROLLER, self.clock.now)

    def cycle(self, *indices: int, after: int | None = None, **fields: Any) -> SensorMessage | None:
        """Let a packet arrive at each arm (default: the first) and run a cycle for each; return the last reply."""
        for index in indices or (0,):
            self.put(index, after, **fields)
            self.loop.cycle()
            after = 0
        return self.reply((indices or (0,))[-1])

    def run(self, *indices: int) -> None:
        coming = iter([index for _ in range(1000) for index in indices or (0,)])

        def following(seconds: float) -> tuple[int, Arrival]:
            index = next(coming)
            self.put(index, None if index == (indices or (0,))[0] else 0)
            return index, self.ports[index].waiting.popleft()

        self.next = following  # type: ignore[method-assign]
        self.loop.run()

    def reply(self, index: int = 0) -> SensorMessage | None:
        sent = self.ports[index].sent
        found = RobotSideCodec(self.robots[index].robot).decode_sensor(sent[-1]) if sent else None
        assert found is None or isinstance(found, SensorMessage)
        return found

    def table(self, index: int = 0) -> Any:
        return self.arms[index].recording.table()

    def speed(self, index: int = 0) -> float:
        reply = self.reply(index)
        assert reply.qd is not None
        return float(np.abs(reply.qd).max())


Make = Callable[..., Hands]


@pytest.fixture
def one(monkeypatch: pytest.MonkeyPatch) -> Make:
    return lambda controller=drift, **options: Hands(monkeypatch, [RIGHT], controller, **options)


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Make:
    return lambda controller, **options: Hands(monkeypatch, [LEFT, RIGHT], controller, **options)
