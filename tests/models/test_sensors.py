"""Models of sensors, cameras, loads and calibrated kinematics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models, robots
from armlab.errors import FrameError, ModelMismatchError, ShapeError
from armlab.kinematics import forward
from armlab.lie import se3, so3
from armlab.models import (
    Accelerometer,
    DualArmCorrection,
    ForceSensor,
    HandEye,
    KinematicCorrection,
    LaserSensor,
    Payload,
)
from armlab.models.kinematic_correction import harmonic_basis
from armlab.models.sensors import FRAMES
from armlab.robots import inertia

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z


def some(seed: int = 0, sign: int = 1) -> ForceSensor:
    rng = np.random.default_rng(seed)
    return ForceSensor(
        R_tool_sensor=so3.exp(rng.normal(size=3)),
        mass=float(rng.uniform(0.1, 3.0)),
        centre=rng.normal(size=3) * 0.05,
        bias=rng.normal(size=6),
        sign=sign,
        gravity=rng.normal(size=3) * 5.0,
        position=rng.normal(size=3) * 0.1,
        robot_name="a",
        robot_hash="b",
        sources=("c",),
    )


def close(found: np.ndarray, expected: list[float]) -> None:
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_mass_that_hangs_down_by_hand() -> None:
    """2 kg, 0.1 m out along the sensor's x. The tool's axes are the base's; the sensor is turned by 90 deg about z."""
    sensor, m_g = ForceSensor(QUARTER, 2.0, np.array([0.1, 0.0, 0.0]), np.array([1.0, 0, 0, 0, 0.5, 0])), 2.0 * 9.80665
    unloaded = sensor.unloaded(np.eye(4))
    close(unloaded, [1, 0, -m_g, 0, 0.5 + 0.1 * m_g, 0])
    pushed = unloaded + np.array([3.0, 0, 0, 0, 0, 0.2])  # along the sensor's x, the tool's y
    close(sensor.contact(pushed, np.eye(4)), [0, 3, 0, 0, 0, 0.2])
    tipped = se3.from_rp(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), np.ones(3))  # the tool's y points up
    close(sensor.contact(pushed, tipped, frame="tool")[:3], [0, 3 + m_g, -m_g])  # the weight expected elsewhere
    close(sensor.contact(sensor.unloaded(tipped) + np.array([3.0, 0, 0, 0, 0, 0]), tipped)[:3], [0, 0, 3])
    away = replace(sensor, position=np.array([0.0, 0.0, 0.5]))  # 0.5 m further along the tool: 3 N at that arm
    close(away.wrench(pushed, np.eye(4)), [0, 3, 0, -1.5, 0, 0.2])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
def test_what_was_put_in_comes_out(sign: int, batch: tuple[int, ...]) -> None:
    """Raw readings composed element by element; power is the same in all axes and at both points."""
    sensor, rng = some(1, sign), np.random.default_rng(2)
    poses = se3.from_rp(so3.exp(rng.normal(size=(*batch, 3))), rng.normal(size=(*batch, 3)))
    wrench = rng.normal(size=(*batch, 6))
    raw = np.zeros((*batch, 6))
    for at in np.ndindex(batch):
        R = poses[at][:3, :3]
        p = R @ sensor.position
        f, m = wrench[at][:3], wrench[at][3:]
        weight = sensor.mass * sensor.R_tool_sensor.T @ R.T @ sensor.gravity
        felt = np.r_[sensor.R_tool_sensor.T @ R.T @ f, sensor.R_tool_sensor.T @ R.T @ (m - np.cross(p, f))]
        raw[at] = sign * (felt + np.r_[weight, np.cross(sensor.centre, weight)]) + sensor.bias
    np.testing.assert_allclose(sensor.wrench(raw, poses), wrench, atol=1e-12)
    contact, in_tool = sensor.contact(raw, poses), sensor.contact(raw, poses, frame="tool")
    np.testing.assert_allclose(contact[..., :3], wrench[..., :3], atol=1e-12)
    R = poses[..., :3, :3]
    for part in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(np.einsum("...ij,...j->...i", R, in_tool[..., part]), contact[..., part], atol=1e-12)
    np.testing.assert_array_equal(sensor.unloaded(poses).shape, (*batch, 6))


def test_nan_stays_and_moments_that_were_not_calibrated_are_nan() -> None:
    sensor = some()
    raw = np.ones(6)
    raw[4] = np.nan
    assert np.isnan(sensor.contact(raw, np.eye(4))[3:]).all()
    assert np.isfinite(sensor.contact(raw, np.eye(4))[:3]).all()
    forces = replace(sensor, centre=np.full(3, np.nan), bias=np.r_[sensor.bias[:3], np.full(3, np.nan)])
    np.testing.assert_array_equal(forces.wrench(np.ones(6), np.eye(4))[:3], sensor.wrench(np.ones(6), np.eye(4))[:3])
    assert np.isnan(forces.wrench(np.ones(6), np.eye(4))[3:]).all()


# Accelerometer.


def test_by_hand() -> None:
    """A sensor turned by 90 degrees about z that reads 10 % too much, on a tool that falls, stands and starts."""
    sensor = Accelerometer(QUARTER, np.array([0.1, 0.0, 0.0]), 1.1)
    np.testing.assert_allclose(sensor.acceleration([0.1, 0.0, 1.1 * 9.80665], np.eye(4)), 0.0, atol=1e-12)
    np.testing.assert_allclose(sensor.acceleration([0.1, 0, 0], np.eye(4)), [0, 0, -9.80665], atol=1e-12)
    np.testing.assert_allclose(sensor.acceleration([1.2, 0, 1.1 * 9.80665], np.eye(4)), [0, 1, 0], atol=1e-12)


def test_batches_and_nan() -> None:
    rng = np.random.default_rng(0)
    sensor = Accelerometer(so3.exp(rng.normal(size=3)), rng.normal(size=3))
    poses = se3.from_rp(so3.exp(rng.normal(size=(2, 5, 3))), np.zeros((2, 5, 3)))
    raw = rng.normal(size=(2, 5, 3))
    raw[1, 2, 0] = np.nan
    found = sensor.acceleration(raw, poses)
    np.testing.assert_array_equal(found[0, 3], sensor.acceleration(raw[0, 3], poses[0, 3]))
    assert np.isnan(found[1, 2]).all()
    assert np.isfinite(found[0]).all()


# Laser sensor.


def some_of_laser_sensor() -> LaserSensor:
    X = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
    return LaserSensor(X, np.eye(3)[:2], np.array([1.0, 0.5]), ("a", "b"), sources=("c",))


def test_points_by_hand() -> None:
    np.testing.assert_allclose(some_of_laser_sensor().points([0.2, 0.05], np.eye(4)), [0.05, 0.2, 0.3], atol=1e-15)
    lifted = se3.from_rp(np.eye(3), [0.0, 0.0, 1.0])
    found = some_of_laser_sensor().points(np.array([[0.2, 0.05], [np.nan, 0.0]]), lifted)
    np.testing.assert_allclose(found[0], [0.05, 0.2, 1.3], atol=1e-15)
    assert np.isnan(found[1]).any()


# Hand-eye calibration.


X = se3.exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
Y = se3.exp(np.array([1.0, -2.0, 0.5, -1.0, 2.0, 0.1]))


def test_poses_have_the_names_of_their_setup() -> None:
    assert tuple(FRAMES) == ("eye_to_hand", "eye_in_hand")
    still, held = HandEye("eye_to_hand", X, Y), HandEye("eye_in_hand", X, Y)
    np.testing.assert_array_equal(still.T_tool_marker, X)
    np.testing.assert_array_equal(still.T_base_cam, Y)
    np.testing.assert_array_equal(held.T_base_marker, X)
    np.testing.assert_array_equal(held.T_tool_cam, Y)
    with pytest.raises(FrameError, match="T_tool_marker or T_base_cam, got T_tool_cam"):
        still.T_tool_cam
    with pytest.raises(FrameError, match="T_base_marker or T_tool_cam, got T_base_cam"):
        held.T_base_cam
    with pytest.raises(ValueError, match="read-only"):
        still.X[0, 0] = 1.0


def test_a_marker_of_unknown_shape_has_points_and_no_pose() -> None:
    seen = HandEye("eye_to_hand", None, Y, np.ones((2, 3)))
    assert seen.points is not None
    np.testing.assert_array_equal(seen.T_base_cam, Y)
    with pytest.raises(FrameError, match="has points but no pose"):
        seen.T_tool_marker


# Payload.


CENTRE = np.array([0.03, -0.01, 0.06])
ABOUT = np.diag([1e-3, 2e-3, 1.5e-3])


@pytest.fixture
def payload(truth) -> Payload:
    robot = truth.robot
    return Payload(robot.name, robot.hash, inertia.from_body(0.5, CENTRE, ABOUT), robot.links[-1], ("log sha256:0",))


def test_mass_centre_and_inertia(payload: Payload) -> None:
    assert payload.mass == pytest.approx(0.5)
    np.testing.assert_allclose(payload.centre, CENTRE, atol=1e-15)
    np.testing.assert_allclose(payload.inertia, ABOUT, atol=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        payload.pi[0] = 1.0


def test_a_model_that_carries_it_feels_its_weight(payload: Payload, truth, model) -> None:
    """At rest: J^T of the weight at the centre of mass."""
    robot, q = truth.robot, truth.robot.q_home + 0.2
    loaded = payload.added_to(model)
    zero = np.zeros(robot.n)
    change = loaded.rigid_torque(q, zero, zero) - model.rigid_torque(q, zero, zero)
    T_base_flange = robot.chain.forward(q)
    arm = T_base_flange[:3, :3] @ CENTRE
    weight = 0.5 * robot.gravity
    wrench = np.concatenate([weight, np.cross(arm, weight)])
    np.testing.assert_allclose(change, -robot.chain.jacobian(q).T @ wrench, atol=1e-12)
    np.testing.assert_array_equal(loaded.base_values, model.base_values)


# Kinematic correction.


ORDERS = (1, 3)


@pytest.fixture
def value() -> KinematicCorrection:
    robot, rng = robots.load("irb2400"), np.random.default_rng(0)
    half = 1e-4 * rng.standard_normal((42 + 24 + 2, 20))
    amplitudes, coefficients = 1e-3 * rng.standard_normal((6, 4)), 1e-3 * rng.standard_normal(2)
    return KinematicCorrection(robot, robot.name, robot.hash, ORDERS, amplitudes, coefficients, half @ half.T)


@pytest.fixture
def q() -> np.ndarray:
    return np.random.default_rng(1).uniform(-2, 2, (4, 6))


def test_joints_and_their_inverse(value, q) -> None:
    terms = np.random.default_rng(2).standard_normal((4, 6, 2))
    waves = np.sum(harmonic_basis(q, ORDERS) * value.amplitudes, axis=-1)
    np.testing.assert_allclose(value.joints(q, terms), q + waves + terms @ value.coefficients, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(value.forward(q, terms), forward(value.robot, value.joints(q, terms)))
    plain = replace(value, coefficients=np.zeros(0), cov=value.cov[:-2, :-2])
    np.testing.assert_allclose(plain.joints(plain.command(q)), q, rtol=0, atol=1e-15)
    assert np.abs(plain.command(q) - q).max() > 1e-4


def test_the_covariance_of_a_pose_is_that_of_draws(value, q) -> None:
    """Samples drawn from `cov`, applied to frames and joints: the scatter of the pose, v in base axes, w in tool
    axes."""
    rng, terms = np.random.default_rng(3), np.random.default_rng(2).standard_normal((4, 6, 2))
    root = np.linalg.svd(value.cov)
    draws = rng.standard_normal((500, 20)) @ (root.U[:, :20] * np.sqrt(root.S[:20])).T
    T, e = value.forward(q, terms), []
    for x in draws:
        frames = value.frames @ se3.exp(x[:42].reshape(7, 6))
        arm = robots.from_local_poe("arm", frames, np.tile([0.0, 0, 0, 0, 0, 1], (6, 1)))
        other = replace(value, robot=arm, amplitudes=value.amplitudes + x[42:66].reshape(6, 4))
        there = replace(other, coefficients=value.coefficients + x[66:]).forward(q[:1], terms[:1])
        turn = so3.log(np.swapaxes(T[:1, :3, :3], 1, 2) @ there[:, :3, :3])
        e.append(np.concatenate([there[0, :3, 3] - T[0, :3, 3], turn[0]]))
    C = value.pose_cov(q, terms)
    assert C.shape == (4, 6, 6)
    sd = np.sqrt(np.diag(C[0]))
    np.testing.assert_allclose(np.cov(np.array(e).T) / np.outer(sd, sd), C[0] / np.outer(sd, sd), rtol=0, atol=0.15)


def test_files(value, q, tmp_path: Path) -> None:
    terms = np.ones((4, 6, 2))
    full = replace(value, points=np.ones((2, 3)), anchor=np.arange(3.0), length_offset=0.1, sources=("a",))
    again = models.load(models.save(full, tmp_path / "value.toml"), kind="kinematic_correction")
    assert again.forward(q, terms).tobytes() == full.forward(q, terms).tobytes()
    assert again.pose_cov(q, terms).tobytes() == full.pose_cov(q, terms).tobytes()
    assert again.robot == full.robot
    np.testing.assert_array_equal(again.anchor, full.anchor)
    assert again.harmonics == ORDERS
    with pytest.raises(ModelMismatchError, match="hand_eye"):
        models.load(tmp_path / "value.toml", kind="hand_eye")


def test_two_arms(value, q, tmp_path: Path) -> None:
    plain = replace(value, coefficients=np.zeros(0), cov=value.cov[:-2, :-2])
    T = se3.exp([1.0, 0.2, 0.3, 0.1, 0.2, 3.0])
    both = DualArmCorrection(plain, plain, T, np.eye(66 + 66 + 6))
    Z = both.forward(q, q[::-1])
    np.testing.assert_allclose(plain.forward(q) @ Z, T @ plain.forward(q[::-1]), rtol=0, atol=1e-13)
    again = models.load(models.save(both, tmp_path / "both.toml"), kind="dual_arm_correction")
    assert again.forward(q, q).tobytes() == both.forward(q, q).tobytes()
    with pytest.raises(ShapeError, match="cov"):
        replace(both, cov=np.eye(3))


def test_the_pose_between_two_arms_moves_as_its_jacobian_says(value, q) -> None:
    """Central differences of v in axes of tool a and w in axes of tool b; the covariance follows."""
    T = se3.exp([1.0, 0.2, 0.3, 0.1, 0.2, 3.0])
    terms = np.random.default_rng(2).standard_normal((2, 4, 6, 2))
    half = 1e-4 * np.random.default_rng(4).standard_normal((142, 30))
    both = DualArmCorrection(value, replace(value, amplitudes=-value.amplitudes), T, half @ half.T)
    q_b, J = q[::-1], both.pose_jacobian(q, q[::-1], *terms)
    Z = both.forward(q, q_b, *terms)
    for k in (0, 4, 20, 41, 50, 67, 68, 73, 99, 111, 120, 134, 136, 138, 141):
        ends = []
        for step in (1e-6, -1e-6):
            x = step * np.eye(142)[k]
            arms = shifted(both.arm_a, x[:68]), shifted(both.arm_b, x[68:136])
            moved = DualArmCorrection(*arms, T @ se3.exp(x[136:]), both.cov).forward(q, q_b, *terms)
            turn = so3.log(np.swapaxes(Z[:, :3, :3], 1, 2) @ moved[:, :3, :3])
            ends.append(np.concatenate([moved[:, :3, 3], turn], axis=1))
        np.testing.assert_allclose(J[:, :, k], (ends[0] - ends[1]) / 2e-6, rtol=0, atol=2e-8)
    np.testing.assert_allclose(both.pose_cov(q, q_b, *terms), J @ both.cov @ J.swapaxes(1, 2), rtol=0, atol=1e-15)
    assert both.pose_cov(q[0], q_b[0], *terms[:, 0]).shape == (6, 6)


def shifted(arm: KinematicCorrection, x: np.ndarray) -> KinematicCorrection:
    frames = arm.frames @ se3.exp(x[:42].reshape(7, 6))
    robot = robots.from_local_poe("arm", frames, np.tile([0.0, 0, 0, 0, 0, 1], (6, 1)))
    amplitudes = arm.amplitudes + x[42:66].reshape(6, 4)
    return replace(arm, robot=robot, amplitudes=amplitudes, coefficients=arm.coefficients + x[66:])


def test_poses_with_few_digits_are_used_as_the_nearest_ones_and_no_poses_are_refused() -> None:
    rng = np.random.default_rng(4)
    T = np.round(se3.exp(rng.standard_normal((5, 6))), 6)
    R = np.round(T[0, :3, :3], 6)
    sensor = Accelerometer(R, np.zeros(3))
    assert so3.is_rotation(sensor.R_tool_sensor, 1e-14)
    raw = rng.standard_normal((5, 3))
    wanted = sensor.acceleration(raw, se3.project(T)[0])
    np.testing.assert_allclose(sensor.acceleration(raw, T), wanted, rtol=0, atol=1e-13)
    with pytest.raises(ShapeError, match="rotation of T_base_tool"):
        sensor.acceleration(raw, 2.0 * T)
