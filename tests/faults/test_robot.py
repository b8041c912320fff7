"""Feedback and clocks of a robot that cannot be right; in virtual time. States other than running are slow tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from armlab.wire.egm import armlab_egm_pb2 as pb

from .bench import Bench
from .judge import judge, met_in_motion
from .matrix import Cell, cells, shows
from .motion import Motion

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
