"""ABB's order and the gears, with numbers written down by hand."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import RobotError, ShapeError
from armlab.robots import Robot, couplings

G = np.array([[0.5, 0.0], [0.25, 0.5]])  # the second motor also turns with the first joint, as in a wrist


@pytest.fixture(scope="module")
def yumi() -> Robot:
    return robots.load("yumi_left")


@pytest.fixture(scope="module")
def wrist() -> Robot:
    return robots.from_dh("wrist", 0.0, [1.0, 1.0], 0.0, coupling=G)


def test_abb_to_logical_by_hand(yumi: Robot) -> None:
    """ABB's axis 7 sits between its axes 2 and 3."""
    abb = [10, 20, 30, 40, 50, 60, 70]
    np.testing.assert_array_equal(couplings.abb_to_logical(yumi, abb), [10, 20, 70, 30, 40, 50, 60])


def test_orders_invert_each_other_in_batches(yumi: Robot) -> None:
    values = np.random.default_rng(0).standard_normal((4, 3, 7))
    before = values.copy()
    np.testing.assert_array_equal(couplings.logical_to_abb(yumi, couplings.abb_to_logical(yumi, values)), values)
    np.testing.assert_array_equal(couplings.abb_to_logical(yumi, couplings.logical_to_abb(yumi, values)), values)
    np.testing.assert_array_equal(values, before)
    assert couplings.abb_to_logical(yumi, np.zeros((0, 7))).shape == (0, 7)


def test_yumi_gears_by_hand(yumi: Robot) -> None:
    """100 motor turns per joint turn; joint 4 turns opposite to its motor, joint 6 has 101."""
    q_motor = np.array([100, 200, 300, 400, 500, 606, 700.0])
    np.testing.assert_allclose(couplings.motor_to_joint(yumi, q_motor), [1, 2, 3, -4, 5, -6, 7], rtol=1e-15)
    np.testing.assert_allclose(couplings.joint_to_motor(yumi, [1, 2, 3, -4, 5, -6, 7]), q_motor, rtol=1e-15)
    tau_motor = np.array([0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07])
    tau = [1, 2, 3, -4, 5, -6.06, 7]
    np.testing.assert_allclose(couplings.motor_torque_to_joint(yumi, tau_motor), tau, rtol=1e-14)
    np.testing.assert_allclose(couplings.joint_torque_to_motor(yumi, tau), tau_motor, rtol=1e-14)


def test_coupled_gears_by_hand(wrist: Robot) -> None:
    """q = (0.5 m1, 0.25 m1 + 0.5 m2); virtual work gives tau_motor = (0.5 t1 + 0.25 t2, 0.5 t2)."""
    np.testing.assert_allclose(couplings.motor_to_joint(wrist, [2.0, 4.0]), [1.0, 2.5])
    np.testing.assert_allclose(couplings.joint_to_motor(wrist, [1.0, 2.5]), [2.0, 4.0])
    np.testing.assert_allclose(couplings.joint_torque_to_motor(wrist, [1.0, 2.0]), [1.0, 1.0])
    np.testing.assert_allclose(couplings.motor_torque_to_joint(wrist, [1.0, 1.0]), [1.0, 2.0])


def test_power_is_kept_there_and_back_in_batches(wrist: Robot) -> None:
    qd_motor, tau_motor = np.random.default_rng(1).standard_normal((2, 3, 4, 2))
    qd, tau = couplings.motor_to_joint(wrist, qd_motor), couplings.motor_torque_to_joint(wrist, tau_motor)
    np.testing.assert_allclose((qd * tau).sum(axis=-1), (qd_motor * tau_motor).sum(axis=-1), rtol=1e-12)
    np.testing.assert_allclose(couplings.joint_to_motor(wrist, qd), qd_motor, rtol=0, atol=1e-14)
    np.testing.assert_allclose(couplings.joint_torque_to_motor(wrist, tau), tau_motor, rtol=0, atol=1e-14)
    np.testing.assert_allclose(qd[1, 2], couplings.motor_to_joint(wrist, qd_motor[1, 2]), rtol=1e-14)


@pytest.mark.parametrize("name", couplings.__all__)
def test_what_does_not_fit_is_refused(yumi: Robot, name: str) -> None:
    convert = getattr(couplings, name)
    for values in ("home", np.zeros(7, complex), [None] * 7, [[0] * 7, [0] * 6], None):
        with pytest.raises(ShapeError, match=r"Expected values for robot 'yumi_left' to be real numbers, got .*\."):
            convert(yumi, values)
    with pytest.raises(ShapeError, match=r"Expected values of shape \(\.\.\., 7\) for robot 'yumi_left', got \(6,\)\."):
        convert(yumi, np.zeros(6))
    with pytest.raises(RobotError, match=r"Expected a Robot, got 'irb120'\. Load the robot first"):
        convert("irb120", np.zeros(6))


def test_the_parallel_rod_of_the_irb2400() -> None:
    """ABB's axis 3 is the angle of the upper arm from the horizontal: moving axis 2 alone does not change its
    direction."""
    robot = robots.load("irb2400")
    abb = np.deg2rad([[10, 0, 20, 30, 40, 50], [10, 35, 20, 30, 40, 50]])
    q = couplings.motor_to_joint(robot, abb)
    np.testing.assert_allclose(np.rad2deg(q), [[10, 0, 20, 30, 40, 50], [10, 35, -15, 30, 40, 50]], rtol=0, atol=1e-12)
    T = kinematics.forward(robot, q)
    np.testing.assert_allclose(T[1, :3, :3], T[0, :3, :3], rtol=0, atol=1e-15)
    assert np.linalg.norm(T[1, :3, 3] - T[0, :3, 3]) > 0.4
    np.testing.assert_array_equal(robot.coupling - np.eye(6), -np.eye(6, k=-1) * (np.arange(6) == 2)[:, None])


def test_what_is_missing_of_one_motor_is_not_missing_of_all_joints(yumi: Robot, wrist: Robot) -> None:
    """A plain matrix product would spread NaN through zeros: one bad column of a log would invalidate all joints."""
    broken = np.array([np.nan, 2.0, 3, 4, 5, 6, 7])
    for convert in (
        couplings.motor_to_joint,
        couplings.joint_to_motor,
        couplings.motor_torque_to_joint,
        couplings.joint_torque_to_motor,
    ):
        whole = convert(yumi, np.nan_to_num(broken))
        np.testing.assert_array_equal(convert(yumi, broken), [np.nan, *whole[1:]])
    np.testing.assert_array_equal(couplings.motor_to_joint(wrist, [np.nan, 1]), [np.nan, np.nan])
    np.testing.assert_array_equal(couplings.motor_to_joint(wrist, [[1, np.inf], [1, 1]]), [[0.5, np.nan], [0.5, 0.75]])
    np.testing.assert_array_equal(couplings.motor_torque_to_joint(wrist, [np.nan, 1]), [np.nan, 2])
