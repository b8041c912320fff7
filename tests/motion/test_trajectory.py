"""Joint trajectories: the path between points against SciPy's, and how their controller begins, waits and ends."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import BPoly

from armlab import robots
from armlab.errors import ShapeError, UnknownName
from armlab.motion import JointTrajectory, Tolerance, TrajectoryController
from armlab.state import State

ROBOT = robots.load("yumi_left")
NAMES = ROBOT.ros_joint_names
DT = 0.004
T = np.array([0.0, 0.5, 1.2, 2.0])


def points(order: int, t: np.ndarray = T) -> JointTrajectory:
    """Return a motion that begins and ends at rest, with positions, velocities and accelerations up to `order`."""
    rng = np.random.default_rng(order)
    columns = [0.1 * rng.standard_normal((len(t), 7)) for _ in range(order + 1)]
    columns[0] = ROBOT.q_home + columns[0] - columns[0][0]
    for one in columns[1:]:
        one[[0, -1]] = 0.0
    return JointTrajectory(t, *columns, joints=NAMES)


class Arm:
    """An arm that follows at once, `lag` s late, or not at all."""

    def __init__(self, controller: TrajectoryController, lag: float = 0.0, holds: bool = False, **first: Any) -> None:
        self.controller, self.lag, self.holds = controller, lag, holds
        self.q, self.sent, self.now = np.array(ROBOT.q_home), np.array(ROBOT.q_home), 0.0
        self.rows: list[tuple[float, np.ndarray, np.ndarray]] = []
        self.first = first

    def tick(self, dt: float = DT, **fields: Any) -> bool:
        """Process a packet; return False once the motion has ended."""
        given = {"qd": np.zeros(7), "q_sent": self.sent, "qd_sent": np.zeros(7), **self.first, **fields}
        command = self.controller(State(self.now, dt, self.q, tau=np.zeros(7), **given))
        self.now += dt
        if command.q is None or command.qd is None:
            assert command.ends
            return False
        self.rows.append((self.controller.t, command.q, command.qd))
        self.sent = command.q
        if not self.holds:
            self.q = self.q + (command.q - self.q) * (1.0 if not self.lag else min(1.0, dt / self.lag))
        return True

    def run(self, seconds: float = 10.0) -> Arm:
        while self.now < seconds and self.tick():
            pass
        return self


@pytest.mark.parametrize("order", [0, 1, 2])
def test_the_path_is_the_polynomial_of_lowest_order_through_the_points(order: int) -> None:
    trajectory = points(order)
    columns = [one for one in (trajectory.q, trajectory.qd, trajectory.qdd) if one is not None]
    oracle = BPoly.from_derivatives(T, np.stack(columns, axis=1))
    arm = Arm(trajectory.controller(ROBOT)).run()
    assert (arm.controller.ending, arm.controller.done, arm.controller.reason) == ("arrived", True, "")
    t, q, qd = (np.array(one) for one in zip(*arm.rows, strict=True))
    inside = t < T[-1]
    assert np.count_nonzero(inside) >= 499
    np.testing.assert_allclose(q[inside], oracle(t[inside]), atol=1e-12)
    np.testing.assert_allclose(qd[inside], oracle.derivative()(t[inside]), atol=1e-10)
    np.testing.assert_allclose(q[-1], trajectory.q[-1], atol=1e-6)
    assert trajectory.duration == 2.0
    np.testing.assert_array_equal(arm.controller.goal, trajectory.q[-1])


def test_columns_are_sorted_by_the_names_of_the_joints() -> None:
    trajectory, order = points(1), [3, 0, 6, 1, 5, 2, 4]
    assert trajectory.qd is not None
    mixed = JointTrajectory(T, trajectory.q[:, order], trajectory.qd[:, order], joints=[NAMES[i] for i in order])
    sorted_ = mixed.ordered(NAMES)
    np.testing.assert_array_equal(sorted_.q, trajectory.q)
    np.testing.assert_array_equal(sorted_.qd, trajectory.qd)
    assert sorted_.joints == NAMES


def test_a_late_first_point_is_reached_from_the_arm() -> None:
    trajectory = points(1, T + 1.0)
    arm = Arm(trajectory.controller(ROBOT)).run()
    assert arm.controller.done
    t, q, _ = (np.array(one) for one in zip(*arm.rows, strict=True))
    np.testing.assert_array_equal(q[0], ROBOT.q_home)
    before = np.flatnonzero(t < 1.0)[-1]
    np.testing.assert_allclose(q[before], trajectory.q[0], atol=0.01)


def test_begin_skips_points_or_waits() -> None:
    late = Arm(points(1).controller(ROBOT, begin=0.5))
    late.q = late.sent = points(1).q[1]
    late.run()
    assert late.controller.done
    assert 1.5 < late.now < 1.6
    early = Arm(points(1).controller(ROBOT, begin=-0.3)).run()
    assert early.controller.done
    assert 2.3 < early.now < 2.4
    waiting = [q for t, q, qd in early.rows if t < 0.0]
    assert len(waiting) > 70
    assert np.all(np.array(waiting) == points(1).q[0])


@pytest.mark.parametrize(
    ("arm", "ending", "words"),
    [
        (Arm(points(1).controller(ROBOT), q_sent=ROBOT.q_home + 0.2), "refused", "near the arm.*0.2 away"),
        (Arm(points(1, T + 0.01).controller(ROBOT), q_sent=ROBOT.q_home + 0.2), "refused", "speeds up to 3.14.*0.010"),
        (Arm(points(1).controller(ROBOT, begin=3.0)), "refused", "ends in the future.*3.000 s late"),
        (Arm(points(1).controller(ROBOT, path_tolerance=Tolerance(0.03)), holds=True), "path", r"\(tolerance 0.03\)"),
        (
            Arm(points(0).controller(ROBOT, path_tolerance=Tolerance(velocity=0.01))),
            "path",
            "velocity error of",
        ),
        (Arm(points(1).controller(ROBOT, goal_time=0.5), holds=True), "goal", "0.5 s after the last point.*position"),
        (Arm(points(1).controller(ROBOT), qd=np.full(7, 0.1)), "goal", "velocity error of 0.1 at yumi_robl_joint_1"),
    ],
)
def test_a_motion_that_does_not_arrive_says_why(arm: Arm, ending: str, words: str) -> None:
    arm.run()
    assert (arm.controller.ending, arm.controller.done) == (ending, False)
    assert re.search(words, arm.controller.reason), arm.controller.reason


def test_a_slow_arm_arrives_within_the_goal_time() -> None:
    arm = Arm(points(1).controller(ROBOT), lag=0.2).run()
    assert arm.controller.done
    assert 2.1 < arm.now < 3.5
    np.testing.assert_allclose(arm.q, points(1).q[-1], atol=0.01)


@pytest.mark.parametrize(
    ("fields", "words"), [({"session": 2}, "new session"), ({"dt": 0.2}, "at most 100 ms apart, got 200.0 ms")]
)
def test_a_pause_of_the_robot_interrupts(fields: dict[str, Any], words: str) -> None:
    arm = Arm(points(1).controller(ROBOT))
    for _ in range(10):
        assert arm.tick()
    assert not arm.tick(**fields)
    assert arm.controller.ending == "interrupted"
    assert words in arm.controller.reason


def test_a_running_arm_is_taken_over_at_its_speed() -> None:
    """A newer trajectory begins at the last reference: position and velocity go on without a step."""
    speed = np.full(7, 0.1)
    controller = points(1, T + 0.5).controller(ROBOT)
    state = State(0.0, DT, ROBOT.q_home, speed, np.zeros(7), q_sent=ROBOT.q_home + 0.02, qd_sent=speed)
    assert controller.begin(state, is_moving=True) == ""
    command = controller(state, 0.0)
    assert command.q is not None
    assert command.qd is not None
    np.testing.assert_allclose(command.q, ROBOT.q_home + 0.02)
    np.testing.assert_allclose(command.qd, speed)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"t": [], "q": np.zeros((0, 7))}, "points with times"),
        ({"t": [0.0, 1.0], "q": np.zeros(2)}, "points with times"),
        ({"t": [0.0, 1.0, 1.0], "q": np.zeros((3, 7))}, "got 1 s at point 2 after 1 s"),
        ({"t": [-1.0, 1.0], "q": np.zeros((2, 7))}, "got -1 s at point 0"),
        ({"t": [0.0, np.nan], "q": np.zeros((2, 7))}, "got nan s at point 1"),
        ({"t": [0.0, 1.0], "q": [[0.0], [np.nan]]}, "finite q.*point 1"),
        ({"t": [0.0, 1.0], "q": np.zeros((2, 7)), "qd": np.zeros((2, 6))}, r"qd of shape \(2, 7\)"),
        ({"t": [0.0, 1.0], "q": np.zeros((2, 7)), "qdd": np.zeros((2, 7))}, "velocities together with accelerations"),
        ({"t": [0.0, 1.0], "q": np.zeros((2, 7)), "qd": np.ones((2, 7))}, "zero velocities at the last point"),
        ({"t": [0.0, 1.0], "q": np.zeros((2, 2)), "joints": ("a", "a")}, "2 different joint names"),
    ],
)
def test_refused_points(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        JointTrajectory(**given)


def test_refused_robots() -> None:
    q = np.tile(ROBOT.q_home, (2, 1))
    for joints, error, words in (
        (("other", *NAMES[1:]), UnknownName, "joint, got 'other'"),
        (NAMES[:6], UnknownName, "no column for yumi_robl_joint_7"),
        ((), ShapeError, "7 joints"),
    ):
        n = len(joints) or 3
        with pytest.raises(error, match=words):
            JointTrajectory([0.0, 1.0], q[:, :n], joints=joints).controller(ROBOT)
    step = np.array([[0.0], [1.0]])
    with pytest.raises(ShapeError, match=r"positions from -2.941 to 2.941 for yumi_robl_joint_3, got .* after 1.688 s"):
        JointTrajectory([0.0, 9.0], q + 4.0 * step, joints=NAMES).check(ROBOT)
    with pytest.raises(ShapeError, match=r"speeds up to 3.142 for yumi_robl_joint_1, got 5 after 0.000 s"):
        JointTrajectory([0.0, 0.1], q + 0.5 * step, joints=NAMES).check(ROBOT)
    huge = np.full((2, 7), 1e308)
    with pytest.raises(ShapeError, match=r"positions from .* got -?(nan|inf)"), np.errstate(all="ignore"):
        JointTrajectory([0.0, 10.0], q, 0.0 * q, huge, joints=NAMES).check(ROBOT)
    inside = JointTrajectory([0.0, 1.0], q, [[60.0] * 7, [0.0] * 7], joints=NAMES)
    with pytest.raises(ShapeError, match="positions"):  # between the points
        inside.check(ROBOT)
    wrong = State(0.0, DT, np.zeros(14), np.zeros(14), np.zeros(14))
    assert "7 joints, got 14" in points(0).controller(ROBOT).begin(wrong)
    np.testing.assert_array_equal(Tolerance(0.1).spread(2), [[0.1, 0.1], [np.inf, np.inf]])
