"""Clocks that are set, and a bridge that stands still; in virtual time. States other than running are slow tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from armlab.wire.egm import armlab_egm_pb2 as pb

from .bench import PERIOD, Bench, Outcome
from .judge import judge, met_in_motion
from .matrix import Cell, cells, shows
from .motion import Motion

ALL = "waiting, holding, running, stopping"
HOUR = 3600
AT = {"waiting": 0.0, "holding": 0.3, "running": 0.3, "stopping": 0.3}


def motion(cell: Cell) -> Motion:
    if cell.state == "stopping":
        return Motion.that_stops(AT["stopping"])
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
            one.at[AT[cell.state]] = does(one, hours)
        outcomes.append(one.run(motion(cell), seconds=1.0))
        judge(one, outcomes[-1])
        assert outcomes[-1].failure is None
        if cell.state == "stopping":
            met_in_motion(one, AT["stopping"])
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
    bench.at[AT[cell.state]] = lambda: bench.pass_time(cell.given, guarded=False)
    outcome = bench.run(motion(cell), seconds=1.0)
    assert outcome.failure is None
    assert cell.is_told(outcome.told), outcome.told
    judge(bench, outcome)
    if cell.state == "stopping":
        met_in_motion(bench, AT["stopping"])
    robot = bench.stations[0].controller.statistics
    assert [event.number for event in robot.events] == ([41822] if cell.given > 1.0 else [])
    assert robot.last_age == 1
