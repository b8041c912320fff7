"""From a message to the reference of the drives: decoding, guidance, external axes."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.robots import Robot
from armlab.sim.controller.guidance import ExternalAxes, Guidance, ReferenceDecoder, has_numbers
from armlab.sim.controller.settings import ControllerSettings
from armlab.wire.egm.robot_side import SensorMessage

T = ControllerSettings().period


@pytest.fixture(scope="module")
def robot() -> Robot:
    return robots.load("yumi_left")


def run_along(
    robot: Robot, settings: ControllerSettings, speed: float, feedforward: bool, seconds: float = 4.0
) -> np.ndarray:
    """Follow a ramp on all joints; return the lag of the reference at the end [rad]."""
    guidance = Guidance(robot, settings, robot.q_home)
    for k in range(round(seconds / T)):
        q_ref = robot.q_home + speed * k * T
        guidance.follow(q_ref, np.full(7, speed) if feedforward else None)
    return q_ref - guidance.q


def test_lag_is_v_over_k_g_without_a_speed_reference_and_none_with_one(robot: Robot) -> None:
    """10 deg/s with k = 5: 2 degrees, the tracking error that users report; half the gain doubles it."""
    speed = np.radians(10.0)
    one_cycle = speed * T  # the reference is of this cycle, the motion reaches the next
    np.testing.assert_allclose(
        run_along(robot, ControllerSettings(), speed, False), np.radians(2.0) - one_cycle, rtol=2e-3
    )
    half = run_along(robot, ControllerSettings(position_gain=0.5), speed, False, 8.0)
    np.testing.assert_allclose(half, np.radians(4.0) - one_cycle, rtol=2e-3)
    np.testing.assert_allclose(np.degrees(run_along(robot, ControllerSettings(), speed, True)), 0.0, atol=0.05)


def test_one_cycle_by_hand(robot: Robot) -> None:
    settings = ControllerSettings(level=0, ramp_in=0.005)
    guidance = Guidance(robot, settings, robot.q_home)
    guidance.follow(robot.q_home + 0.01, np.full(7, 0.02))
    pole = 1 - np.exp(-2 * np.pi * 20 * T)
    v = pole * (T / 0.005) * (5.0 * 0.01 + 0.02)
    np.testing.assert_allclose(guidance.qd, v, rtol=1e-12)
    np.testing.assert_allclose(guidance.q, robot.q_home + v * T, rtol=1e-15)
    twice = Guidance(robot, ControllerSettings(level=1, ramp_in=0.005), robot.q_home)
    twice.follow(robot.q_home + 0.01, np.full(7, 0.02))
    np.testing.assert_allclose(twice.qd, pole * v, rtol=1e-12)


def test_speed_deviation_scales_all_joints(robot: Robot) -> None:
    guidance = Guidance(robot, ControllerSettings(max_speed=0.1, ramp_in=0.005), robot.q_home)
    far = robot.q_home + np.array([0.4, 0.2, 0, 0, 0, 0, 0])
    for _ in range(100):
        guidance.follow(far, None)
    np.testing.assert_allclose(guidance.qd[:2], [0.1, 0.05], rtol=0.02)
    assert guidance.utilization == pytest.approx(100 * 5 * (far - guidance.q)[0] / robot.qd_max[0], rel=0.05)


def test_the_fastest_joint_bounds_the_speed(robot: Robot) -> None:
    guidance = Guidance(robot, ControllerSettings(ramp_in=0.005), robot.q_home)
    for _ in range(200):
        guidance.follow(None, np.full(7, 100.0))
    np.testing.assert_allclose(guidance.qd, robot.qd_max.max(), rtol=1e-6)
    assert guidance.utilization > 1000


def test_violations_are_named(robot: Robot) -> None:
    guidance = Guidance(robot, ControllerSettings(max_deviation=0.05), robot.q_home)
    assert guidance.violation() == ""
    guidance.q = robot.q_home + np.array([0, 0, 0.06, 0, 0, 0, 0])
    assert "joint 3" in guidance.violation()
    guidance.q = robot.q_max + 0.1
    assert "joint 1" in guidance.violation()
    assert "joint 4" in guidance.refusal(robot.q_max + np.array([-1, -1, -1, 1e-3, -1, -1, -1]))
    assert guidance.refusal(robot.q_home) == ""


def test_axes_follow_no_faster_than_one_radian_a_second() -> None:
    axes = ExternalAxes(2, ControllerSettings())
    axes.follow(None)
    axes.follow(np.array([1.0]))
    np.testing.assert_array_equal(axes.q, 0.0)
    reached = []
    for _ in range(1000):
        axes.follow(np.array([0.5, -2.0, 9.0]))
        reached.append(axes.q)
    assert np.abs(np.diff(reached, axis=0)).max() <= 0.004032 + 1e-12
    np.testing.assert_allclose(axes.q, [0.5, -2.0], atol=1e-2)


ROBOT = robots.load("yumi_right")
HOME = ROBOT.q_home + 0.05
ONES = np.ones(7)


def test_the_extension_takes_the_place_of_joint_references() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())
    plain = target.read(SensorMessage(0, 1, 3, q=HOME, qd=ONES), HOME)
    other = target.read(SensorMessage(0, 1, 3, q=HOME, q_reference=HOME + 1, qd_reference=2 * ONES), HOME)
    np.testing.assert_array_equal(plain, (HOME, ONES))
    np.testing.assert_array_equal(other, (HOME + 1, 2 * ONES))


def test_a_pose_is_reached_from_the_planned_posture() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings(mode="pose"))
    goal = HOME + 0.02
    twist = ROBOT.chain.jacobian(HOME) @ (0.1 * ONES)
    found = target.read(SensorMessage(0, 1, 3, T_frame_tool=ROBOT.chain.forward(goal), twist=twist), HOME)
    q, qd = found
    np.testing.assert_allclose(ROBOT.chain.forward(q), ROBOT.chain.forward(goal), atol=1e-8)
    np.testing.assert_allclose(ROBOT.chain.jacobian(HOME) @ qd, twist, atol=1e-9)
    far = np.eye(4)
    far[0, 3] = 9.0
    assert target.read(SensorMessage(0, 1, 3, T_frame_tool=far), HOME) is None


def test_what_is_absent_goes_back_to_its_default() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())

    def assert_added(tau: float, gain_q: float) -> None:
        found = (target.tau, target.gain_q, target.gain_qd)
        np.testing.assert_array_equal(found, np.repeat([[tau], [gain_q], [1.0]], 7, axis=1))

    assert_added(0.0, 1.0)
    target.accept(SensorMessage(0, 1, 3, tau=ONES, gain_q=9 * ONES, q_ext=np.array([0.5])), HOME, None)
    assert_added(1.0, 2.0)
    target.accept(SensorMessage(1, 1, 3), HOME, None)
    assert_added(0.0, 1.0)
    assert target.q_ext is not None, "an external reference stays"
    target.accept(SensorMessage(2, 1, 3, tau=ONES), HOME, None)
    target.release()
    assert_added(0.0, 1.0)
    target.begin(HOME)
    assert target.q is None


def test_what_rapid_heard_outlives_a_session() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())
    assert (target.rapid_data.size, target.rapid_digital) == (0, None)
    target.accept(SensorMessage(0, 1, 3, rapid_data=ONES, rapid_digital=True), HOME, None)
    target.accept(SensorMessage(1, 1, 3), HOME, None)
    target.begin(HOME)
    np.testing.assert_array_equal(target.rapid_data, ONES)
    assert target.rapid_digital is True


@pytest.mark.parametrize("field", ["tau", "gain_q", "gain_qd", "q_ext"])
def test_no_usable_number_anywhere(field: str) -> None:
    assert has_numbers(SensorMessage(0, 1, 3), HOME, None)
    for value in (np.nan, np.inf, 1e300):
        message = SensorMessage(0, 1, 3)._replace(**{field: np.array([0.0, value])})
        assert not has_numbers(message, HOME, None)
