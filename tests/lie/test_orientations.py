"""Quaternions wxyz and roll, pitch, yaw: SciPy, half turns, gimbal lock, interpolation, refusals."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.lie import euler, quaternion, so3


def random_quaternions(*shape: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).standard_normal((*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def test_from_matrix_of_half_turns() -> None:
    """A naive formula takes the square root of a negative number for about 30 % of them."""
    u = random_quaternions(20_000)[:, 1:]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    q = quaternion.from_matrix(2 * u[:, :, None] * u[:, None, :] - np.eye(3))
    np.testing.assert_allclose(np.abs((q[:, 1:] * u).sum(axis=1)), 1, rtol=1e-14)
    assert np.abs(q[:, 0]).max() <= 1e-15
    np.testing.assert_array_equal(quaternion.from_matrix(np.diag([-1.0, -1, 1])), [0, 0, 0, 1])


def test_continuous_chooses_signs_along_time() -> None:
    t = np.linspace(0, 4 * np.pi, 400)
    smooth = np.stack([np.cos(t), 0 * t, 0.6 * np.sin(t), 0.8 * np.sin(t)], axis=-1)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (400, 1))
    signs[0] = 1
    np.testing.assert_array_equal(quaternion.continuous(smooth * signs), smooth)
    from_rotations = quaternion.continuous(quaternion.from_matrix(quaternion.to_matrix(smooth)))
    np.testing.assert_allclose(from_rotations, smooth, rtol=0, atol=2e-15)
    two_arms = np.stack([smooth * signs, -smooth * signs], axis=1)
    np.testing.assert_array_equal(quaternion.continuous(two_arms)[:, 1], -smooth)


def test_continuous_bridges_missing_samples() -> None:
    q = np.array([[1.0, 0, 0, 0], [np.nan] * 4, [-1.0, 0, 0, 0], [1.0, 0, 0, 0]])
    np.testing.assert_array_equal(quaternion.continuous(q)[[0, 2, 3], 0], [1, 1, 1])
    assert np.isnan(quaternion.continuous(q)[1]).all()
    np.testing.assert_array_equal(quaternion.continuous(q[1:])[1:, 0], [-1, -1])


@pytest.mark.parametrize(("call", "sentence"), [
    (lambda: quaternion.to_matrix([0, 0, 0, 0]), r"Expected quaternion of length 1 within 0\.001 \(wxyz\), got"),
    (lambda: quaternion.to_matrix([1, 0, 0]), r"Expected quaternion of shape \(\.\.\., 4\), got \(3,\)\."),
    (lambda: quaternion.from_matrix(np.zeros((3, 3))), "Expected R to be a rotation"),
    (lambda: quaternion.multiply([1, 0, 0, 0], [1, 0]), "Expected q of shape"),
    (lambda: quaternion.conjugate([1]), "Expected quaternion of shape"),
    (lambda: quaternion.continuous([1, 0, 0, 0]), "with time along axis 0"),
    (lambda: euler.from_rpy((0, 0), "zyx"), "Expected rpy of shape"),
    (lambda: euler.to_rpy(2 * np.eye(3), "zyx"), "Expected R to be a rotation"),
])  # fmt: skip
def test_bad_input_is_a_sentence(call, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        call()


def test_a_length_off_by_rounding_is_normalised() -> None:
    """The published YuMi base has length 0.999998."""
    R = quaternion.to_matrix([0.82888, -0.31402, 0.40801, -0.2188])
    assert so3.is_rotation(R, 1e-15)
    assert quaternion.UNIT_TOLERANCE == 1e-3


LOCKED = {"zyx": (-np.pi / 2, np.pi / 2), "xyz": (-np.pi / 2, np.pi / 2), "zyz": (0.0, np.pi)}


def test_conventions_as_products() -> None:
    r, p, y = 0.1, 0.2, 0.3
    np.testing.assert_allclose(euler.from_rpy((r, p, y), "zyx"), euler.rot_z(r) @ euler.rot_y(p) @ euler.rot_x(y))
    np.testing.assert_allclose(euler.from_rpy((r, p, y), "xyz"), euler.rot_x(r) @ euler.rot_y(p) @ euler.rot_z(y))
    np.testing.assert_allclose(euler.from_rpy((r, p, y), "zyz"), euler.rot_z(r) @ euler.rot_y(p) @ euler.rot_z(y))
    assert get_args(euler.Convention) == euler.CONVENTIONS


def test_turns_about_one_axis() -> None:
    angles = np.linspace(-4, 4, 9)
    for turn, axis in ((euler.rot_x, (1, 0, 0)), (euler.rot_y, (0, 1, 0)), (euler.rot_z, (0, 0, 1))):
        np.testing.assert_allclose(turn(angles), so3.exp(angles[:, None] * np.array(axis)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(euler.rot_z(np.pi / 2) @ [1, 0, 0], [0, 1, 0], rtol=0, atol=1e-16)
    assert euler.rot_x(np.zeros((2, 3))).shape == (2, 3, 3, 3)


@pytest.mark.parametrize("convention", euler.CONVENTIONS)
@pytest.mark.parametrize("off", [0.0, 1e-16, 1e-13, -1e-12, 1e-9, 1e-6])
def test_to_rpy_at_and_near_gimbal_lock(convention, off: float) -> None:
    rng = np.random.default_rng(2)
    for lock in LOCKED[convention]:
        angles = rng.uniform(-np.pi, np.pi, (1000, 3))
        angles[:, 1] = lock + off
        R = euler.from_rpy(angles, convention)
        np.testing.assert_allclose(euler.from_rpy(euler.to_rpy(R, convention), convention), R, rtol=0, atol=1e-12)


def test_gimbal_lock_gives_the_last_angle_everything() -> None:
    for convention, lock, total in (("zyx", np.pi / 2, 0.2), ("xyz", np.pi / 2, 0.4), ("zyz", 0.0, 0.4)):
        angles = euler.to_rpy(euler.from_rpy((0.1, lock, 0.3), convention), convention)
        np.testing.assert_allclose(angles, (0, lock, total), rtol=0, atol=1e-15)


def test_an_unknown_convention_is_refused() -> None:
    with pytest.raises(UnknownName, match=r"Expected the name of a rotation convention, got 'zxz'\."):
        euler.to_rpy(np.eye(3), "zxz")  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="rotation convention"):
        euler.from_rpy((0, 0, 0), "")  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="xyz, zyx, zyz"):
        euler.from_rpy((0, 0, 0), [0, 1, 2])  # type: ignore[arg-type]


def test_the_convention_has_no_default() -> None:
    """The ancestor had one default per direction, and they differed."""
    with pytest.raises(TypeError, match="convention"):
        euler.from_rpy((0.1, 0.2, 0.3))  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="convention"):
        euler.to_rpy(np.eye(3))  # type: ignore[call-arg]
