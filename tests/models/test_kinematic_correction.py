"""The value of a kinematic calibration: joints, poses, their covariance, and its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models, robots
from armlab.errors import ModelMismatchError, ShapeError
from armlab.kinematics import forward
from armlab.lie import se3, so3
from armlab.models import DualArmCorrection, KinematicCorrection, harmonic_basis

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
    """Numbers drawn from `cov`, put into frames and joints: the scatter of the pose, v in base axes, w in tool axes."""
    rng, terms = np.random.default_rng(3), np.random.default_rng(2).standard_normal((4, 6, 2))
    root = np.linalg.svd(value.cov)
    draws = rng.standard_normal((4000, 20)) @ (root.U[:, :20] * np.sqrt(root.S[:20])).T
    T, e = value.forward(q, terms), []
    for x in draws:
        frames = value.frames @ se3.exp(x[:42].reshape(7, 6))
        arm = robots.from_local_poe("arm", frames, np.tile([0.0, 0, 0, 0, 0, 1], (6, 1)))
        other = replace(value, robot=arm, amplitudes=value.amplitudes + x[42:66].reshape(6, 4))
        there = replace(other, coefficients=value.coefficients + x[66:]).forward(q[:1], terms[:1])
        turn = so3.log(np.swapaxes(T[:1, :3, :3], 1, 2) @ there[:, :3, :3])
        e.append(np.concatenate([there[0, :3, 3] - T[0, :3, 3], turn[0]]))
        if len(e) == 800:
            break
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
