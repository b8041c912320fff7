"""Ends that come from outside the controller."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

from armlab.bridge.control.limits import Limits
from armlab.bridge.control.state_machine import Mode, StateMachine
from armlab.bridge.control.supervision import Settings, Supervisor, check_list
from armlab.bridge.net.sockets import Port
from armlab.errors import LinkError, NoRobot, SessionEnded
from armlab.robots import Robot


class Bench:
    """A supervisor over a session that can be given packets."""

    def __init__(self, feed: Any, robot: Robot, **settings: Any) -> None:
        self.port = Port("127.0.0.1", 0)
        self.machine = StateMachine(robot, Limits.of(robot))
        self.told: list[tuple[str, bool]] = []
        self.feed, feed.now = feed, time.monotonic_ns()
        self.supervisor = Supervisor(self.port, feed.session, self.machine, Settings(**settings), self.tell)

    def tell(self, text: str, warn: bool = False, each: bool = False) -> None:
        self.told.append((text, warn))

    def packet(self) -> None:
        self.machine.observe(self.feed.sample(after=0))

    def check_silence(self, silent_for: float) -> None:
        """Look as if the last packet had come so many seconds ago."""
        heard = time.monotonic_ns() - int(1e9 * silent_for)
        if self.feed.session._last is not None:
            self.feed.session._last = self.feed.session._last._replace(arrival_ns=heard)
        self.supervisor.check_silence(heard)
        self.port.close()


def test_patience_ends_with_no_robot_and_a_check_list(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot, patience=7.0)
    feed.raw(b"noise", after=0)
    bench.check_silence(7.1)
    assert bench.machine.mode is Mode.ENDED
    failure = bench.machine.failure
    assert isinstance(failure, NoRobot)
    for words in ("within 7 s", "1 unparsable", f"127.0.0.1:{bench.port.port}", "this computer only", "firewall"):
        assert words in str(failure)


def test_exactly_the_patience_is_not_too_long(feed: Any, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(feed, robot, patience=8.0)
    bench.port.close()
    now = iter([5_000_000_000, 5_000_000_001, 8_000_000_000, 8_000_000_100])
    monkeypatch.setattr("armlab.bridge.control.supervision.time", SimpleNamespace(monotonic_ns=lambda: next(now)))
    told, ended = [], []
    for _ in range(4):
        bench.supervisor.check_silence(0)
        told.append(len(bench.told))
        ended.append(bench.machine.mode is Mode.ENDED)
    assert told == [0, 1, 1, 1]
    assert ended == [False, False, False, True]


def test_the_check_list_is_told_before(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot, patience=30.0)
    bench.check_silence(5.5)
    bench.check_silence(5.6)
    assert bench.told == [(f"No packet yet. {check_list(bench.port)}", True)]
    assert bench.machine.mode is Mode.WAITING


def test_silence_ends_the_session_and_waits(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot)
    bench.packet()
    bench.check_silence(0.4)
    assert feed.session.active
    bench.check_silence(0.6)
    assert not feed.session.active
    assert bench.machine.mode is Mode.WAITING


def test_silence_ends_the_run_when_asked(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot, resume=False)
    bench.packet()
    bench.check_silence(0.6)
    assert (bench.machine.mode, bench.machine.reason) == (Mode.ENDED, "the controller stopped sending")


def test_no_other_session_is_an_error(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot, patience=3.0)
    bench.packet()
    bench.check_silence(3.5)
    assert isinstance(bench.machine.failure, SessionEnded)
    assert "the controller stopped sending" in str(bench.machine.failure)


def test_a_robot_that_ended_ends_the_run(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot, alive=lambda: "the simulated robot ended")
    bench.packet()
    bench.check_silence(0.0)
    assert (bench.machine.mode, bench.machine.reason) == (Mode.ENDED, "the simulated robot ended")
    assert bench.machine.failure is None
    assert not feed.session.active


def test_a_robot_that_died_is_an_error(feed: Any, robot: Robot) -> None:
    def alive() -> str:
        raise LinkError("Expected the simulator to go on, but it ended with status 2.")

    bench = Bench(feed, robot, alive=alive)
    bench.check_silence(0.0)
    assert "status 2" in str(bench.machine.failure)
    assert bench.machine.mode is Mode.ENDED


def sessions(bench: Bench, count: int, packets: int, **fields: Any) -> None:
    """Sessions of so many packets each, one right after another."""
    for _ in range(count):
        bench.feed.packets.seq = 0
        for k in range(packets):
            sample = bench.feed.sample(**fields)
            if k == 0 and sample.session > 1:
                bench.supervisor.judge()
            bench.machine.observe(sample)
    bench.port.close()


@pytest.mark.parametrize(
    ("packets", "fields", "settings", "ends"),
    [
        (2, {}, {}, True),
        (25, {}, {}, True),  # 24 periods: 0.096 s
        (27, {}, {}, False),
        (1, {"mci": 1}, {}, True),
        (1, {"mci": 2}, {}, False),  # the robot waits for its operator
        (1, {"mci": 2}, {"clock": "robot"}, True),
    ],
)
def test_ten_sessions_in_a_row_that_end_at_once_end_the_run(
    feed: Any, robot: Robot, packets: int, fields: dict[str, Any], settings: dict[str, Any], ends: bool
) -> None:
    bench = Bench(feed, robot, **settings)
    sessions(bench, 10, packets, **fields)
    assert bench.machine.failure is None
    sessions(bench, 1, 1)
    assert ("a session with guidance for" in str(bench.machine.failure)) == ends


def test_a_session_that_moves_on_starts_the_count_again(feed: Any, robot: Robot) -> None:
    bench = Bench(feed, robot)
    for _ in range(3):
        sessions(bench, 9, 2)
        sessions(bench, 1, 30)
    assert bench.machine.failure is None
    sessions(bench, 11, 2)
    assert bench.machine.reason == "sessions ended at once"
