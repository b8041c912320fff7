"""A bridge and simulated controllers in one thread and in virtual time, with a bad network between them.

The bridge runs as on a real robot: real-time clock, time-outs, guard, recorder. Only `time` is replaced, and the guard
is called when its thread would wake. A minute therefore passes in a second, and every run is repeatable. `judge` checks
what must hold in every run. Below: real processes in real time, and checks of their logs.
"""

from __future__ import annotations

import contextlib
import heapq
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, NamedTuple

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge import Link, Run
from armlab.bridge.control.feedback import READY_AFTER
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.run import End
from armlab.bridge.control.supervision import Settings
from armlab.bridge.net.sockets import Arrival
from armlab.errors import LinkError
from armlab.log import Table
from armlab.sim.arm.arm import LaggingArm
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.settings import ControllerSettings as RobotSettings
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec, Reference
from armlab.wire.egm.robot_side import RobotSideCodec, SensorMessage

WIRE = 1e-4  # s, minimum latency of a datagram
NEVER_VALID = 0x07  # a first byte that no protobuf message has


@dataclass(frozen=True)
class Bad:
    """Shares of datagrams lost (`burst` in a row), duplicated, reordered, corrupted; mean and SD of the delay [s]."""

    loss: float = 0.0
    burst: int = 1
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0


GOOD = Bad()
FIRST = 6  # datagrams, one of which is lost, see `unlucky`: a stopping arm is not yet at rest


class Way:
    """One direction between a robot and the bridge, bad from `begin` to `end` [s] of virtual time."""

    def __init__(self, bad: Bad, begin: float, end: float, seed: list[int], period: float) -> None:
        self._bad, self._begin, self._end, self._period = bad, begin, end, period
        self._random = np.random.default_rng(seed)
        self._under_way: list[tuple[float, int, bytes]] = []
        self._count = self._losing = self.lost = 0

    @property
    def due(self) -> float:
        return self._under_way[0][0] if self._under_way else math.inf

    def put(self, now: float, data: bytes) -> None:
        if not self._begin <= now < self._end:  # no random draws: a seed determines what happens from `begin` on
            self._deliver(now + WIRE, data)
            return
        bad = self._bad
        begins = bad.loss / (bad.burst - bad.loss * (bad.burst - 1))  # burst rate for which `loss` is the share lost
        lost, twice, behind, damaged = self._random.random(4) < (begins, bad.duplicate, bad.reorder, bad.corrupt)
        late = WIRE + max(0.0, bad.delay + bad.jitter * self._random.standard_normal())
        if self._losing or lost:
            self._losing = (self._losing or bad.burst) - 1
            self.lost += 1
            return
        for _ in range(1 + int(twice)):
            spoiled = bytes([NEVER_VALID]) + data[1 : int(self._random.integers(1, len(data)))] if damaged else data
            self._deliver(now + late + 1.5 * self._period * behind, spoiled)

    def _deliver(self, due: float, data: bytes) -> None:
        self._count += 1
        heapq.heappush(self._under_way, (due, self._count, data))

    def take(self, now: float) -> bytes | None:
        """Return the next datagram that has arrived, or None."""
        return heapq.heappop(self._under_way)[2] if self.due <= now else None

    def cut(self) -> None:
        """Drop all datagrams in transit."""
        self._under_way.clear()


def unlucky(bad: Bad, period: float) -> int:
    """Return the first seed with which both directions lose one of their first datagrams."""
    for seed in range(10_000):
        ways = [Way(bad, 0.0, math.inf, [seed, way], period) for way in (1, 2)]
        for way in ways:
            for k in range(FIRST):
                way.put(k * period, b"..")
        if all(way.lost for way in ways):
            return seed
    raise AssertionError(bad)


ROBOT = robots.load("yumi_right")
MIDDLE = (ROBOT.q_min + ROBOT.q_max) / 2
PERIOD = 0.004032
COMPUTES = 3e-4  # s per controller call
NAP = 2e-3  # s between checks of the guard once it replies
BRIDGE = ("127.0.0.1", 6510)
WALL_NS = 1_700_000_000_000_000_000
PATIENCE = 5.0  # s of the bridge
MODULES = (
    "control.arm",
    "control.run",
    "control.loop",
    "control.recording",
    "control.supervision",
)  # modules of the bridge that read a clock


class Sent(NamedTuple):
    """One reply as sent by the bridge, and its destination."""

    t: float
    data: bytes
    to: tuple[str, int]


class Outcome(NamedTuple):
    """Results of a run; `failure` is the exception it raised."""

    run: Run
    failure: BaseException | None

    @property
    def table(self) -> Table:
        return self.run.table

    @property
    def told(self) -> str:
        """All text shown to the user: exception, report, events."""
        events = "\n".join(text for _, text in self.run.events)
        return f"{self.failure or ''}\n{self.run.report()}\n{events}"


class Station:
    """One robot's controller on the network, from its first cycle at `begins_at` [s] on.

    `packets`: measured q, whether guidance is active, and robot time, by the `tm` of each packet. `motion`: q and qd of
    the arm, cycle by cycle. `change`: modification of each packet before it is sent.
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
        """Continue from another port; datagrams in transit to the old one are lost."""
        self.source, self.sources = source, (*self.sources, source)
        self.back.cut()

    def cycle(self) -> None:
        """Read the received datagrams, send, move."""
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


Script = Callable[[float, State], Command | None]  # virtual time and state give a command


class Bench:
    """Virtual time, the network, and a bridge on it.

    `wall_step`: how far the wall clock was set since the beginning [s]. `at`: events by virtual time [s].
    `takes`: whether the operating system accepts a reply.
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
        self.link = Link([End(ROBOT, port, EgmCodec(ROBOT, extension=True))], True, settings)

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
        return Outcome(self.link.last, failure)

    def move_again(self, seconds: float = 0.1) -> None:
        """Move the arm in another run on the same link."""
        count = len(self.sent)
        again = self.run(Motion(), seconds=seconds)
        judge(self, again, count)
        assert again.run.reason == "the time is up"

    def pass_time(self, seconds: float, guarded: bool = True) -> None:
        """Let time pass in the loop thread: the robots continue, and so does the guard unless everything stalls."""
        end = self.now + seconds
        while self.now < end:
            left = max(self._loop.overdue(), 0.0) if guarded and self._loop else math.inf
            self._advance(min(end, self.now + (left or NAP)))
            if guarded and self._loop and self._loop.overdue() <= 0.0:
                self._loop.answer_for_controller()

    def closing(self, patience: float) -> bool:
        """Wait, in another thread, until the run is over and its recording is about to close."""
        recorder, end = self._loop._pace.recording._recorder, time.monotonic() + patience
        while not recorder._closed and time.monotonic() < end:
            time.sleep(0.001)
        return recorder._closed

    def written(self, patience: float) -> int:
        """Wait until all rows so far are in the recording file, and return their number."""
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

    def _enter(self, stack: Any, loop: Any, on_event: Any, waiting: Any) -> None:
        stack.enter_context(self._guarded(loop))

    def _advance(self, until: float) -> None:
        """Process one event, no later than `until`."""
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


@dataclass
class Motion:
    """Sways from the last reference; commands positions, so that lost time would cause a jump."""

    holds: tuple[float, float] = (0.0, 0.0)
    stops: float = math.inf
    amplitude: float = 0.1
    rate: float = 4.0
    _from: tuple[int, float, np.ndarray] | None = None

    @classmethod
    def that_stops(cls, at: float) -> Motion:
        """Return a fast motion that stops half a cycle before a time; the arm needs eight more cycles to rest."""
        return cls(stops=at - 0.002, amplitude=0.18, rate=6.0)

    def begin_anew(self) -> None:
        """Restart the sway from the current arm position, after another controller was in control."""
        self._from = None

    def __call__(self, t: float, state: State) -> Command | None:
        if t >= self.stops:
            return Command.stop()
        if self.holds[0] <= t < self.holds[1]:
            self.begin_anew()
            return None
        if self._from is None or self._from[0] != state.session:
            self._from = state.session, state.t, state.q_sent
        _, since, q = self._from
        return Command(q + self.amplitude * (1.0 - math.cos(self.rate * (state.t - since))))


LIMITS = Limits.of(ROBOT)
GAP = 3 * PERIOD  # s of full-speed motion allowed for a reference, however long nothing was sent
SLACK = 1e-9  # rounding of the degrees sent


def judge(bench: Bench, outcome: Outcome, since: int = 0, ahead: float = 0.0) -> None:
    """Judge a run whose replies start at number `since`; `ahead` as in `within_limits`."""
    within_limits(bench, since, ahead)
    log_is_what_was_sent(bench, outcome.table, since)
    for station in bench.stations:
        q, qd = (np.array(values) for values in zip(*station.motion))
        assert ((q >= ROBOT.q_min) & (q <= ROBOT.q_max)).all(), "the arm left its limits"
        assert (np.abs(qd) <= ROBOT.qd_max).all(), "the arm was too fast"


def met_in_motion(bench: Bench, at: float) -> None:
    """Check that the last reply before a time had a nonzero speed."""
    before = [reply.qd for reply, sent in zip(bench.heard(), bench.sent, strict=True) if sent.t <= at]
    assert before[-1].any(), "the arm was at rest before anything failed"


def within_limits(bench: Bench, since: int = 0, ahead: float = 0.0) -> None:
    """Every reply is within the limits for the robot time since the previous one, and a gap allows no larger step.

    `ahead`: time by which the robot clock may be trusted beyond arrivals [s].
    """
    answered: set[tuple[int, int]] = set()
    before: tuple[np.ndarray, np.ndarray, float] | None = None
    echoes = READY_AFTER
    stations = {source: station for station in bench.stations for source in station.sources}
    for reply, sent in zip(bench.heard()[since:], bench.sent[since:], strict=True):
        assert np.isfinite([reply.q, reply.qd]).all()
        assert ((reply.q >= LIMITS.q_min - SLACK) & (reply.q <= LIMITS.q_max + SLACK)).all()
        feedback, guides, now = stations[sent.to].packets[reply.tm_ms]
        assert (sent.to[1], reply.tm_ms) not in answered, "two replies to one packet"
        answered.add((sent.to[1], reply.tm_ms))
        if not guides:
            assert np.abs(reply.q - feedback).max() < SLACK, "before guidance, replies repeat the feedback"
            assert not reply.qd.any()
            before = None
            continue
        if before is None or reply.seqno == 0:
            before, echoes = (feedback, np.zeros_like(feedback), now - PERIOD), READY_AFTER
        if echoes and np.abs(reply.q - feedback).max() < SLACK and not reply.qd.any():
            before, echoes = (feedback, np.zeros_like(feedback), now), echoes - 1  # not ready yet
            continue
        echoes = 0
        q, qd, then = before
        longest = 1.01 * (now - then) + ahead
        moved, step = reply.q - q, longest
        if reply.qd.any():  # the time this speed needs for this step
            step = float(moved @ reply.qd / (reply.qd @ reply.qd))
            assert 0.0 < step <= longest, f"a speed that does not match the step at {sent.t:.3f} s"
        assert np.abs(moved - reply.qd * step).max() <= SLACK, f"not as fast as stated at {sent.t:.3f} s"
        braked = np.maximum(np.abs(qd) - LIMITS.qdd_max * step, 0.0) * step
        furthest = np.maximum(LIMITS.qd_max * min(step, 1.01 * GAP), braked)
        assert (np.abs(moved) <= furthest + SLACK).all(), f"a jump at {sent.t:.3f} s"
        assert (np.abs(reply.qd) <= LIMITS.qd_max + SLACK).all(), f"too fast at {sent.t:.3f} s"
        assert (np.abs(reply.qd - qd) <= LIMITS.qdd_max * step + SLACK / PERIOD).all(), f"too sudden at {sent.t:.3f} s"
        before = reply.q, reply.qd, now


def log_is_what_was_sent(bench: Bench, table: Table, since: int = 0, end: int | None = None) -> None:
    """Every reply has a row, and encoding the row gives the same bytes."""
    codec = EgmCodec(ROBOT, extension=True)
    heard, sent = bench.heard()[since:end], bench.sent[since:end]
    if not sent:
        assert "seq_sent" not in table or not np.isfinite(np.asarray(table["seq_sent"], dtype=float)).any()
        return
    rows = np.flatnonzero(np.isfinite(np.asarray(table["seq_sent"], dtype=float)))
    assert len(rows) == len(sent), "every reply has its row"
    q, qd, seqs = table["q_sent"][rows], table["qd_sent"][rows], np.asarray(table["seq_sent"], dtype=float)[rows]
    for k, reply in enumerate(heard):
        reference = Reference(
            q[k], qd[k], None, int(seqs[k]), reply.tm_ms or 0, reply.echo_seq or 0, reply.echo_mono_ns or 0
        )
        assert codec.encode(reference) == sent[k].data, f"row {rows[k]} differs from the reply sent"


LONGEST = 30.0  # s; only a test that fails waits so long
NO_DATA = "41822 No data from the UdpUc device"
REST = 0.01  # rad/s, of the true arm while its reference is constant


def sway(state: State) -> Command:
    return Command(state.q_start + 0.1 * (1.0 - np.cos(4.0 * state.t)))


def is_whole(table: Table, lost: tuple[int, ...] = ()) -> None:
    """No missing rows except for the ticks in `lost`; no jumps in the references.

    A packet that was overtaken has no reference.
    """
    if not len(table):
        return
    ticks = [tick for tick in range(len(table) + len(lost)) if tick not in lost]
    np.testing.assert_array_equal(table["tick"], ticks)
    step = 1.5 * max(PERIOD, table["dt"].max())  # on a busy machine the simulated robot skips cycles
    for session in np.unique(table["session"]):
        sent = table["q_sent"][table["session"] == session]
        sent = sent[np.isfinite(sent).all(axis=1)]
        assert (np.abs(np.diff(sent, axis=0)) <= LIMITS.qd_max * step).all()
        assert ((sent >= LIMITS.q_min) & (sent <= LIMITS.q_max)).all()


@contextlib.contextmanager
def program(*words: str, errors: IO[str] | int = subprocess.PIPE) -> Iterator[subprocess.Popen[str]]:
    """A Python process that ends with the test."""
    process = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, stderr=errors, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=LONGEST)


def line(file: IO[str] | None) -> str:
    return file.readline()


def free_port() -> int:
    port = bridge.connect("egm://127.0.0.1:0", ROBOT)
    port.close()
    return port.port


class SimulatedRobot:
    """`armlab sim` as a process: its output while it runs, and its statistics and true motion after it has ended."""

    def __init__(self, folder: Path, port: int) -> None:
        self._said, self._stats, self._truth = (folder / name for name in ("said.txt", "stats.json", "truth.csv"))
        files = ("--stats", str(self._stats), "--truth", str(self._truth))
        self._words = ("sim", "yumi_right", "--to", f"127.0.0.1:{port}", "--extension", "--comm-timeout", "0.2", *files)
        self._process: Any = None

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        with self._said.open("w") as said, program("-m", "armlab", *self._words, errors=said) as self._process:
            yield
            self._process.terminate()
            self._process.wait(LONGEST)

    def timeouts(self) -> int:
        """Return the number of time-outs reported so far; output is in the file before the next packet."""
        return self._said.read_text().count(NO_DATA)

    def wait_for_timeout(self, before: int) -> None:
        """Wait until one more time-out is reported."""
        end = time.monotonic() + LONGEST
        while self.timeouts() == before:
            assert time.monotonic() < end, self._said.read_text()
            time.sleep(0.01)

    def judge(self) -> list[str]:
        """Check that the arm stayed within its limits and was at rest when each session began. Return its events."""
        [counted] = json.loads(self._stats.read_text()).values()
        events = [f"{event['number']} {event['text']}" for event in counted["events"]]
        assert not any("out of bounds" in event for event in events), events
        head, *rows = self._truth.read_text().splitlines()
        names, truth = head.split(","), np.loadtxt(rows, delimiter=",")
        q, qd = (truth[:, [names.index(f"{name}{i + 1} [{unit}]") for i in range(ROBOT.n)]] for name, unit in _COLUMNS)
        assert ((q >= ROBOT.q_min) & (q <= ROBOT.q_max)).all(), "the arm left its limits"
        assert (np.abs(qd) <= ROBOT.qd_max).all(), "the arm was too fast"
        begins = np.flatnonzero(np.diff(truth[:, names.index("session")])) + 1
        assert np.abs(qd[begins]).max(initial=0.0) < REST, "the arm did not stop"
        return events


_COLUMNS = (("q", "rad"), ("qd", "rad/s"))
