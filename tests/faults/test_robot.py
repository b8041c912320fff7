"""Feedback and clocks that cannot be right, clocks that are set, and a bridge that stands still; in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from armlab.wire.egm import armlab_egm_pb2 as pb

from .bench import PERIOD, Bench, Motion, Outcome
from .judge import judge, met_in_motion
from .matrix import Cell, cells, shows

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


@shows(
    cells(
        "robot",
        "the feedback is 100 rad off in two packets",
        "holding, running",
        "hold; the false position is never a reference",
        "Expected joint 1 (…) of yumi_right between … but the robot reports …",
        "with the third plausible packet, or at once in motion",
        (far, 2),
    ),
    cells(
        "robot",
        "the feedback is 0.3 rad off in one packet",
        "running",
        "hold for that packet",
        "to move no faster than the arm can",
        "at once",
        (noisy, 1),
    ),
    cells(
        "robot",
        "two packets have no state of the motors",
        "running",
        "the last state holds",
        "–",
        "nothing to recover",
        (without_states, 2),
    ),
    cells(
        "robot",
        "the robot's clock runs six times too fast",
        "running",
        "steps are limited to the time between arrivals",
        "The robot's clock runs ahead of ours",
        "nothing to recover",
        (hurried, 10**9),
    ),
    cells(
        "robot",
        "the robot's clock stands still",
        "running",
        "steps are measured by the header's tm",
        "The robot's clock stands still",
        "nothing to recover",
        (still, 10**9),
    ),
)
def test_a_robot_that_cannot_be_right(bench: Bench, cell: Cell) -> None:
    does, count = cell.given
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


@shows(
    cells(
        "robot",
        "the feedback is frozen",
        "running",
        "the arm comes to rest, and the run ends with `LinkError`",
        "a following error of … it is frozen.",
        "the next run",
        frozen,
    ),
    cells(
        "robot",
        "the feedback stays 0.3 rad off",
        "running",
        "the arm comes to rest, and the run ends with `LinkError`",
        "to move no faster than the arm can",
        "the next run",
        noisy,
    ),
)
def test_feedback_that_stays_false(bench: Bench, cell: Cell) -> None:
    bench.at[AT] = lambda: change(bench, cell.given)
    outcome = bench.run(Motion(amplitude=0.3), seconds=3.0)
    assert outcome.failure is not None
    assert cell.is_told(outcome.told), outcome.told
    judge(bench, outcome)
    assert not bench.heard()[-1].qd.any()


ALL = "waiting, holding, running, stopping"
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


SAME = "what is sent is the same, bit for bit, and the rows go on in time"
SHORT = "one step is taken from the milliseconds of the packet's header"
CLOCKS = (
    ("computer", "on", SAME, set_by, 1),
    ("computer", "back", SAME, set_by, -1),
    ("robot", "on", SHORT, robot_set_by, 1),
    ("robot", "back", SHORT, robot_set_by, -1),
)


@shows(
    *(
        cells(
            "clock",
            f"the {whose}'s clock is set {how} by an hour",
            ALL,
            happens,
            "–",
            "nothing to recover",
            (does, hours),
        )
        for whose, how, happens, does, hours in CLOCKS
    )
)
def test_a_clock_that_is_set(bench: Bench, make_bench: Callable[[], Bench], cell: Cell) -> None:
    does, hours = cell.given
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


@shows(
    cells(
        "process",
        "the bridge stands still for 0.2 s",
        "holding, running, stopping",
        "of the packets that wait the newest is answered, in a step no larger than others",
        "overtaken 4",
        "at once",
        0.2,
    ),
    cells(
        "process",
        "the bridge stands still for 2 s",
        "holding, running",
        "the robot's time-out stops the arm; its next session is answered where the arm is",
        "Session 1 ended: …",
        "at once",
        2.0,
    ),
    cells(
        "process",
        "the bridge stands still for 2 s",
        "stopping",
        "the robot's time-out stops the arm; the bridge goes on to the end of the run",
        "Session 1 ended: …",
        "the next run",
        2.0,
    ),
)
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
