"""Full permitted speed into each limit of every arm of the library, simulated in lockstep."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge import Limits
from armlab.bridge.control.limits import axes_of
from armlab.state import Command, State

QUICK = ("irb1200", "irb120", "yumi_right")  # those whose simulated arms went through their limits once
LIMITED = [name for name in robots.names() if np.isfinite(robots.load(name).q_max).all()]  # not the DH test
ARMS = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in LIMITED]


@pytest.mark.parametrize("name", ARMS)
def test_full_speed_into_each_limit_stops_before_it(name: str) -> None:
    robot = robots.load(name)
    limits, axes = Limits.of(robot), axes_of(robot)
    longest = float(((robot.q_max - robot.q_min) / robot.qd_max).max())
    turn = longest + 2.0  # s in each direction

    def controller(state: State) -> Command:
        return Command(qd=robot.qd_max * (1.0 if state.t < turn else -1.0))

    with bridge.connect(f"sim://{name}?lockstep=true&seed=1", robot) as link:
        run = link.run(controller, seconds=2.0 * turn + 1.0, limits=limits)
    assert run.statistics["sessions"] == 1
    q, sent = np.array([axes(row) for row in run.table["q"]]), run.table["q_sent"]
    sent = np.array([axes(row) for row in sent[np.isfinite(sent).all(axis=1)]])
    assert ((sent >= limits.q_min - 1e-9) & (sent <= limits.q_max + 1e-9)).all(), "no reference outside the limits"
    assert ((q >= robot.q_min) & (q <= robot.q_max)).all(), "the arm stays within its range"
    if axes(robot.q_home) is robot.q_home:  # joints of a coupled robot hinder one another
        assert (sent.max(axis=0) > limits.q_max - 0.01).all()
        assert (sent.min(axis=0) < limits.q_min + 0.01).all()
