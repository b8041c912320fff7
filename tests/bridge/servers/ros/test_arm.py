"""One arm in one row: absent numbers are absent, and wrenches turn with the tool."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.bridge.servers.ros.topics import Arm, header
from armlab.bridge.servers.row import RowSchema, RowWriter, places
from armlab.log import Tick
from armlab.state import State

ROBOT = robots.load("irb120")
Q = np.linspace(0.1, 0.6, 6)


def arm(**values: np.ndarray) -> Arm:
    schema = RowSchema.of([ROBOT])
    state = State(1.0, 0.004, **{"q": Q, "qd": Q, "tau": Q, **values}, robot=ROBOT.name, motors=1)
    data = RowWriter(schema).row(state, None, Tick(7, 7, 3, 1_000, 2_000, 3), 2)
    return Arm(ROBOT, places(schema, ROBOT.name), data, 3)


def test_a_column_with_a_hole_is_not_there() -> None:
    endless = np.array([np.inf, -np.inf, 1.0, 1.0, 1.0, 1.0])
    one = arm(tau=np.array([1.0, np.nan, 1.0, 1.0, 1.0, 1.0]), qd=endless)
    assert one.numbers("tau") == ()
    assert one.numbers("qd") == tuple(endless)
    assert one["q"] == tuple(Q)
    assert one["motors"] == (1,)
    assert one.wall_ns == 3


def test_a_wrench_turns_with_the_tool() -> None:
    one, rng = arm(), np.random.default_rng(0)
    wrench, factor = rng.normal(size=6), rng.normal(size=(6, 6))
    R = kinematics.forward(ROBOT, Q)[:3, :3]
    turned = np.array(one.in_tool_axes(wrench.tolist()))
    np.testing.assert_allclose(R @ turned[:3], wrench[:3], atol=1e-14)
    np.testing.assert_allclose(R @ turned[3:], wrench[3:], atol=1e-14)
    cov = one.covariance_in_tool_axes(factor @ factor.T)
    assert turned @ np.linalg.solve(cov, turned) == pytest.approx(wrench @ np.linalg.solve(factor @ factor.T, wrench))
    w, *xyz = one.tool_quaternion
    np.testing.assert_allclose(2.0 * np.arccos(abs(w)), np.arccos((np.trace(R) - 1.0) / 2.0), atol=1e-9)
    assert np.linalg.norm([w, *xyz]) == pytest.approx(1.0)


def test_a_header_holds_the_wall_clock() -> None:
    made = header(1_700_000_000_999_999_999, "tool")
    assert (made.stamp.sec, made.stamp.nanosec, made.frame_id) == (1_700_000_000, 999_999_999, "tool")
