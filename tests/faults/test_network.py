"""Network failures, and implausible robot data or clocks; in virtual time.

The default tests cover only faults of a moving arm; the other states are slow tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab.log import Table
from armlab.wire.egm import armlab_egm_pb2 as pb

from .bench import PATIENCE, PERIOD, Bad, Bench, Motion, Outcome, Station, judge, met_in_motion, unlucky
from .matrix import Cell, shows

LASTS = 0.3  # s, of a fault
LASTS_RARE = 1.0  # s, of a rare fault, so that it occurs in both directions
BEGINS = {"waiting": 0.0, "holding": 0.3, "running": 0.3, "stopping": 0.3}
AFTER = 0.3  # s of motion when it is over
OTHER = ("127.0.0.1", 50002)


def begin(cell: Cell, lasts: float = LASTS) -> tuple[float, Motion]:
    """Return the time at which the fault begins, and a motion that is in the cell's state then."""
    at = BEGINS[cell.state]
    return at, {
        "waiting": Motion(),
        "holding": Motion(holds=(0.0, at + lasts)),
        "running": Motion(),
        "stopping": Motion.that_stops(at),
    }[cell.state]


def goes_on(bench: Bench, cell: Cell, outcome: Outcome, over: float) -> None:
    """The run ended as without the fault; if the arm was stopping, another run moves it again."""
    assert outcome.failure is None
    judge(bench, outcome)
    assert cell.is_told(outcome.told), outcome.told
    if cell.state == "stopping":
        met_in_motion(bench, BEGINS["stopping"])
        assert outcome.run.reason == "the controller ended the run"
        bench.move_again(0.3)
    else:
        assert outcome.run.reason == "the time is up"
    moved = [reply.q for reply, sent in zip(bench.heard(), bench.sent, strict=True) if sent.t > over]
    assert np.ptp(moved, axis=0).min() > 0.01, "it moves again"
    assert not bench.heard()[-1].qd.any(), "and comes to rest"
    assert bench.stations[0].controller.statistics.last_age == 1, "the active reference is one cycle old"


@shows
def test_a_bad_network(bench: Bench, cell: Cell) -> None:
    bad = Bad(**cell.given)
    rare = 0.0 < bad.loss <= 0.1 and cell.state != "stopping"
    lasts = LASTS_RARE if rare else LASTS
    at, motion = begin(cell, lasts)
    seed = unlucky(bad, PERIOD) if bad.loss else 7
    station = Station(bad=bad, begin=at, end=at + lasts, seed=seed)
    bench.stations = [station]
    outcome = bench.run(motion, seconds=at + lasts + AFTER)
    lost = station.out.lost, station.back.lost
    goes_on(bench, cell, outcome, at + lasts)
    assert (min(lost) > 0) == (bad.loss > 0.0)


@shows
def test_silence(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell, cell.given)
    bench.stations = [Station(bad=Bad(loss=1.0), begin=at, end=at + cell.given)]
    outcome = bench.run(motion, seconds=at + 1.0)
    goes_on(bench, cell, outcome, at + cell.given)
    events = [event.number for event in bench.stations[0].controller.statistics.events]
    assert events == ([41822] if cell.given > 1.0 else [])
    assert outcome.run.statistics["sessions"] == 1 + (cell.given > 0.5 and cell.state in ("holding", "running"))


@shows
def test_nothing_more_comes(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell, math.inf)
    robot = bench.stations[0]
    bench.at[at] = lambda: setattr(robot, "alive", False)
    outcome = bench.run(motion)
    assert type(outcome.failure).__name__ == cell.given
    assert cell.is_told(outcome.told), outcome.told
    assert bench.now < at + PATIENCE + 0.2
    if cell.state != "waiting":
        judge(bench, outcome)
    robot.alive = True
    bench.move_again()


@shows
def test_another_port(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell)
    at = at or 2.5 * PERIOD  # the very first packets
    old = bench.stations[0]

    def change() -> None:
        if cell.given:
            old.move(OTHER)
        else:
            old.alive = False
            bench.stations.append(Station(OTHER, begins_at=bench.now + 6 * PERIOD, q=old.motion[-1][0]))

    bench.at[at] = change
    outcome = bench.run(motion, seconds=at + 1.0)
    bench.stations.reverse()
    goes_on(bench, cell, outcome, at + 0.6)


@shows
def test_two_robots(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell)
    bench.stations.append(Station(OTHER, begins_at=at + 0.3 * PERIOD))
    outcome = bench.run(motion, seconds=at + LASTS + AFTER)
    goes_on(bench, cell, outcome, at + LASTS)
    answered = bench.sent[: outcome.run.statistics["replies"]]
    assert {sent.to for sent in answered} == {bench.stations[0].source}


@shows
def test_sending_fails(bench: Bench, cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    at, motion = begin(cell, 0.15)
    taken = bench.takes
    bench.takes = lambda: taken() and not at <= bench.now < at + 0.15
    outcome = bench.run(motion, seconds=at + 0.15 + AFTER)
    goes_on(bench, cell, outcome, at + 0.15)


AT = 0.3


class Change:
    """Changes the packets of a robot from now on: all of them, or only some."""

    def __init__(self, what: Callable[[Any, Any], None], packets: int) -> None:
        self._what, self._left = what, packets
        self._first: bytes | None = None

    def __call__(self, data: bytes) -> bytes:
        if self._left == 0:
            return data
        message = pb.EgmRobot.FromString(data)
        self._first = self._first or data
        self._left -= 1
        self._what(message, pb.EgmRobot.FromString(self._first))
        return message.SerializeToString()


def change(bench: Bench, what: Callable[[Any, Any], None], packets: int = 10**9) -> None:
    bench.stations[0].change = Change(what, packets)


def far(message: Any, _: Any) -> None:
    message.feedBack.joints.joints[0] += np.degrees(100.0)


def frozen(message: Any, first: Any) -> None:
    message.feedBack.joints.CopyFrom(first.feedBack.joints)
    message.feedBack.externalJoints.CopyFrom(first.feedBack.externalJoints)


def noisy(message: Any, _: Any) -> None:
    message.feedBack.joints.joints[0] += np.degrees(0.3)


def without_states(message: Any, _: Any) -> None:
    message.ClearField("motorState")


def hurried(message: Any, first: Any) -> None:
    """Make the robot clock run six times too fast."""
    now, begun = message.feedBack.time, first.feedBack.time
    ns = 6 * (now.sec * 10**6 + now.usec) - 5 * (begun.sec * 10**6 + begun.usec)
    now.sec, now.usec = divmod(ns, 10**6)


def still(message: Any, first: Any) -> None:
    message.feedBack.time.CopyFrom(first.feedBack.time)


CHANGES = {change.__name__: change for change in (far, frozen, noisy, without_states, hurried, still)}


@shows
def test_a_robot_that_cannot_be_right(bench: Bench, cell: Cell) -> None:
    name, count = cell.given
    does = CHANGES[name]
    if cell.state == "holding":
        change(bench, does, count)
    else:
        bench.at[AT] = lambda: change(bench, does, count)
    outcome = bench.run(Motion(), seconds=1.0)
    assert outcome.failure is None
    assert cell.is_told(outcome.told), outcome.told
    judge(bench, outcome, ahead=1e-3 if does is hurried else 0.0)
    if cell.state == "running":
        met_in_motion(bench, AT)
    assert outcome.run.statistics["sessions"] == 1


@shows
def test_feedback_that_stays_false(bench: Bench, cell: Cell) -> None:
    bench.at[AT] = lambda: change(bench, CHANGES[cell.given])
    outcome = bench.run(Motion(amplitude=0.3), seconds=3.0)
    assert outcome.failure is not None
    assert cell.is_told(outcome.told), outcome.told
    judge(bench, outcome)
    assert not bench.heard()[-1].qd.any()


HOUR = 3600


def motion_until(cell: Cell) -> Motion:
    if cell.state == "stopping":
        return Motion.that_stops(AT)
    return Motion(holds=(0.0, 0.6 if cell.state == "holding" else 0.0))


def set_by(bench: Bench, hours: int) -> Callable[[], None]:
    """Set the computer's clock."""
    return lambda: setattr(bench, "wall_step", bench.wall_step + HOUR * hours)


def robot_set_by(bench: Bench, hours: int) -> Callable[[], None]:
    """Set the robot's clock."""

    def change(data: bytes) -> bytes:
        message = pb.EgmRobot.FromString(data)
        message.feedBack.time.sec += HOUR * hours
        return message.SerializeToString()

    return lambda: setattr(bench.stations[0], "change", change)


UNDISTURBED: dict[str, tuple[Table, list[bytes]]] = {}
"""By state: table and replies of a run in which no clock is set."""


def run_for_clock(bench: Bench, cell: Cell) -> tuple[Table, list[bytes]]:
    outcome = bench.run(motion_until(cell), seconds=0.8)
    judge(bench, outcome)
    assert outcome.failure is None
    if cell.state == "stopping":
        met_in_motion(bench, AT)
    return outcome.table, [sent.data for sent in bench.sent]


@shows
def test_a_clock_that_is_set(bench: Bench, make_bench: Callable[[], Bench], cell: Cell) -> None:
    whose, hours = cell.given
    if cell.state not in UNDISTURBED:
        UNDISTURBED[cell.state] = run_for_clock(make_bench(), cell)
    undisturbed, replies = UNDISTURBED[cell.state]
    bench.at[BEGINS[cell.state]] = (set_by if whose == "computer" else robot_set_by)(bench, hours)
    disturbed, answered = run_for_clock(bench, cell)
    assert len(undisturbed) == len(disturbed)
    np.testing.assert_allclose(np.diff(disturbed.t), PERIOD, atol=1e-4)
    if whose == "computer":
        assert answered == replies
        np.testing.assert_array_equal(disturbed["dt"], undisturbed["dt"])
    else:
        np.testing.assert_allclose(disturbed["q_sent"], undisturbed["q_sent"], atol=1e-4)


@shows
def test_a_bridge_that_stands_still(bench: Bench, cell: Cell) -> None:
    """As after SIGSTOP, after a suspension of the computer, or while memory is swapped in from disk."""
    bench.at[BEGINS[cell.state]] = lambda: bench.pass_time(cell.given, guarded=False)
    outcome = bench.run(motion_until(cell), seconds=1.0)
    assert outcome.failure is None
    assert cell.is_told(outcome.told), outcome.told
    judge(bench, outcome)
    if cell.state == "stopping":
        met_in_motion(bench, AT)
    robot = bench.stations[0].controller.statistics
    assert [event.number for event in robot.events] == ([41822] if cell.given > 1.0 else [])
    assert robot.last_age == 1
