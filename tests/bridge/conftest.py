"""Simulated robot controllers for tests: single packets, or a UDP peer that plays a script in lockstep."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge import Link, Run
from armlab.bridge.control.session import Sample, Session
from armlab.bridge.net.sockets import Arrival
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec, SensorMessage

PERIOD_NS = 4_000_000
START_NS = 1_700_000_000_000_000_000
PATIENCE = 10.0  # s; reached only if a test fails


@pytest.fixture(scope="session")
def robot() -> Robot:
    return robots.load("yumi_right")


@pytest.fixture
def cell_text() -> str:
    """Return the text of a cell file: one arm in lockstep, two parameters and a LabComm server."""
    return """
name = "yumi"
commands = ["local"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left?lockstep=true"
speed = 0.5
[parameters.gain]
default = 2.0
unit = "N/m"
minimum = 0.0
maximum = 10.0
text = "Stiffness."
[parameters.gentle]
default = true
type = "bool"
rights = "anyone"
[servers.labcomm]
ports = {yumi_left = 0}
parameters = 0
rows = 0
"""


class Packets:
    """Robot side: messages with their own sequence numbers, one period apart."""

    def __init__(self, robot: Robot, extension: bool = False) -> None:
        self.robot, self.codec = robot, RobotSideCodec(robot, extension=extension)
        self.q, self.seq, self.cycle = np.array(robot.q_home), 0, 0

    def message(self, **fields: Any) -> RobotMessage:
        q = fields.pop("q", self.q)
        values = {
            "seqno": self.seq,
            "tm_ms": 10_000 + 4 * self.cycle,
            "q": q,
            "q_planned": q,
            "robot_ns": START_NS + self.cycle * PERIOD_NS,
        }
        message = RobotMessage(**{**values, **fields})
        self.seq, self.cycle = message.seqno + 1, self.cycle + 1
        return message

    def __call__(self, **fields: Any) -> bytes:
        return self.codec.encode_robot(self.message(**fields))


@pytest.fixture
def packets(robot: Robot) -> Packets:
    return Packets(robot)


class Feed:
    """Session fed without sockets; the arrival clock follows the robot's clock."""

    def __init__(self, robot: Robot, **options: Any) -> None:
        self.packets = Packets(robot)
        self.events: list[str] = []
        self.warnings: list[str] = []  # the events that are warnings
        self.session = Session(EgmCodec(robot), on_event=self.tell, **options)
        self.now = 1_000_000_000

    def tell(self, text: str, warn: bool = False) -> None:
        self.events.append(text)
        if warn:
            self.warnings.append(text)

    def raw(self, data: bytes, port: int = 5000, host: str = "127.0.0.1", after: int = PERIOD_NS) -> Sample | None:
        self.now += after
        return self.session.accept(Arrival(data, (host, port), self.now))

    def __call__(self, port: int = 5000, after: int = PERIOD_NS, **fields: Any) -> Sample | None:
        return self.raw(self.packets(**fields), port, after=after)

    def sample(self, **fields: Any) -> Sample:
        sample = self(**fields)
        assert sample is not None
        return sample


@pytest.fixture
def feed(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> Feed:
    for module in ("control.state_machine", "control.external_axes"):  # three-packet rule: see test_feedback.py
        monkeypatch.setattr(f"armlab.bridge.{module}.READY_AFTER", 1)
    return Feed(robot)


class Peer:
    """Robot controller on a UDP socket. It sends packets, waits for each reply, and can check for surplus replies."""

    def __init__(self, robot: Robot, port: int, extension: bool = False) -> None:
        self.packets = Packets(robot, extension)
        self.to = ("127.0.0.1", port)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.replies: list[SensorMessage] = []
        self.over = threading.Event()

    def send(self, data: bytes | None = None, **fields: Any) -> None:
        self.socket.sendto(self.packets(**fields) if data is None else data, self.to)

    def answer(self, patience: float = PATIENCE) -> SensorMessage:
        self.socket.settimeout(patience)
        found = self.packets.codec.decode_sensor(self.socket.recv(65535))
        assert isinstance(found, SensorMessage), found
        self.replies.append(found)
        return found

    def cycle(self, **fields: Any) -> SensorMessage:
        self.send(**fields)
        return self.answer()

    def cycles(self, count: int, **fields: Any) -> list[SensorMessage]:
        return [self.cycle(**fields) for _ in range(count)]

    def begin(self) -> None:
        """Send until the bridge listens (it discards earlier packets) or has ended."""
        while not self.over.is_set():
            self.send()
            with contextlib.suppress(TimeoutError):
                self.answer(0.05)
                return

    def rest(self, pause: float = 0.0) -> None:
        """Continue until the run has ended; the last packet gets no reply."""
        while not self.over.is_set():
            self.send()
            self.answer_or_end(self.over)
            if self.replies:
                self.packets.q = self.replies[-1].q  # the arm follows at once
            time.sleep(pause)

    def answer_or_end(self, over: threading.Event) -> None:
        """Wait for a reply until the run is over; a reply sent before the end is still accepted."""
        was_over = False
        while not was_over:
            was_over = over.is_set()
            with contextlib.suppress(TimeoutError):
                self.answer(0.02)
                return

    def surplus(self) -> int:
        """Return the number of datagrams still waiting after every packet was answered."""
        self.socket.setblocking(False)
        for count in range(1000):
            try:
                self.socket.recv(65535)
            except BlockingIOError:
                return count
        return 1000


class Play:
    """Runs a link in the main thread while a script plays the robot in another thread."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.links: list[Link] = []
        self.peers: list[Peer] = []

    @property
    def peer(self) -> Peer:
        return self.peers[-1]

    def link(self, clock: Any = "robot", **options: Any) -> Link:
        link = bridge.connect("egm://127.0.0.1:0", self.robot, clock=clock, patience=PATIENCE, **options)
        self.links.append(link)
        return link

    def __call__(
        self, script: Callable[[Peer], None], controller: Any, link: Link | None = None, **options: Any
    ) -> Run:
        link = link or self.link()
        self.peers.append(Peer(link.robots[-1], link.ports[-1]))
        failures: list[BaseException] = []

        def play() -> None:
            try:
                script(self.peer)
            except BaseException as error:
                failures.append(error)

        thread = threading.Thread(target=play, daemon=True)
        thread.start()
        try:
            return link.run(controller, **options)
        finally:
            self.peer.over.set()
            thread.join(PATIENCE)
            assert not thread.is_alive()
            if failures:
                raise failures[0]


@pytest.fixture
def play(robot: Robot) -> Iterator[Play]:
    made = Play(robot)
    yield made
    for link in made.links:
        link.close()
    for peer in made.peers:
        peer.socket.close()


@pytest.fixture
def make_peer() -> Iterator[Callable[[Robot, int], Peer]]:
    """Return a factory for peers that are closed after the test."""
    made: list[Peer] = []

    def make(robot: Robot, port: int) -> Peer:
        made.append(Peer(robot, port))
        return made[-1]

    yield make
    for peer in made:
        peer.socket.close()
