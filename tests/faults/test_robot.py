"""Feedback and clocks that cannot be right, clocks that are set, and a bridge that stands still; in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from armlab.wire.egm import armlab_egm_pb2 as pb

from .bench import PERIOD, Bench, Motion, Outcome, judge, met_in_motion
from .matrix import Cell, shows

AT = 0.3
BEGINS = {"waiting": 0.0, "holding": AT, "running": AT, "stopping": AT}


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
    """Six times as fast as time."""
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


def motion_of(cell: Cell) -> Motion:
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


@shows
def test_a_clock_that_is_set(bench: Bench, make_bench: Callable[[], Bench], cell: Cell) -> None:
    whose, hours = cell.given
    does = set_by if whose == "computer" else robot_set_by
    outcomes: list[Outcome] = []
    other = make_bench()
    for one in (other, bench):
        if one is bench:
            one.at[BEGINS[cell.state]] = does(one, hours)
        outcomes.append(one.run(motion_of(cell), seconds=1.0))
        judge(one, outcomes[-1])
        assert outcomes[-1].failure is None
        if cell.state == "stopping":
            met_in_motion(one, AT)
    undisturbed, disturbed = (outcome.table for outcome in outcomes)
    assert len(undisturbed) == len(disturbed)
    np.testing.assert_allclose(np.diff(disturbed.t), PERIOD, atol=1e-4)
    if does is set_by:
        assert [sent.data for sent in bench.sent] == [sent.data for sent in other.sent]
        np.testing.assert_array_equal(disturbed["dt"], undisturbed["dt"])
    else:
        np.testing.assert_allclose(disturbed["q_sent"], undisturbed["q_sent"], atol=1e-4)


@shows
def test_a_bridge_that_stands_still(bench: Bench, cell: Cell) -> None:
    """As by SIGSTOP, a computer that was suspended, or a disk from which memory comes back."""
    bench.at[BEGINS[cell.state]] = lambda: bench.pass_time(cell.given, guarded=False)
    outcome = bench.run(motion_of(cell), seconds=1.0)
    assert outcome.failure is None
    assert cell.is_told(outcome.told), outcome.told
    judge(bench, outcome)
    if cell.state == "stopping":
        met_in_motion(bench, AT)
    robot = bench.stations[0].controller.statistics
    assert [event.number for event in robot.events] == ([41822] if cell.given > 1.0 else [])
    assert robot.last_age == 1
