"""Quaternions wxyz: SciPy, half turns, interpolation, continuity along time, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armlab.errors import ShapeError
from armlab.lie import quaternion, so3


def random_quaternions(*shape: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).standard_normal((*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def to_scipy(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(q[..., [1, 2, 3, 0]])


def test_from_matrix_of_half_turns() -> None:
    """The square root of a negative number, for about 30 % of them, is what a naive formula takes."""
    u = random_quaternions(100_000)[:, 1:]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    q = quaternion.from_matrix(2 * u[:, :, None] * u[:, None, :] - np.eye(3))
    np.testing.assert_allclose(np.abs((q[:, 1:] * u).sum(axis=1)), 1, rtol=1e-14)
    assert np.abs(q[:, 0]).max() <= 1e-15
    np.testing.assert_array_equal(quaternion.from_matrix(np.diag([-1.0, -1, 1])), [0, 0, 0, 1])


def test_from_matrix_with_six_decimals() -> None:
    q = random_quaternions(1000)
    q[q[:, 0] < 0] *= -1
    rounded = np.round(quaternion.to_matrix(q), 7)
    again = quaternion.from_matrix(rounded)
    np.testing.assert_allclose(np.linalg.norm(again, axis=1), 1, rtol=1e-15)
    np.testing.assert_allclose(again, q, rtol=0, atol=1e-6)


def test_multiply_is_the_product_of_rotations() -> None:
    p, q = random_quaternions(1000), random_quaternions(1000, seed=1)
    product = quaternion.to_matrix(p) @ quaternion.to_matrix(q)
    np.testing.assert_allclose(quaternion.to_matrix(quaternion.multiply(p, q)), product, rtol=0, atol=2e-15)
    i, j, k = np.eye(4)[1:]
    np.testing.assert_array_equal(quaternion.multiply(i, j), k)
    assert quaternion.multiply(p, i).shape == p.shape


def test_slerp_ends_and_middle() -> None:
    a, b = random_quaternions(500), random_quaternions(500, seed=1)
    R_a, R_b = quaternion.to_matrix(a), quaternion.to_matrix(b)
    np.testing.assert_allclose(quaternion.slerp(a, b, 0.0), a, rtol=0, atol=1e-15)
    assert so3.angle(quaternion.to_matrix(quaternion.slerp(a, b, 1.0)), R_b).max() <= 3e-15
    middle = quaternion.to_matrix(quaternion.slerp(a, b, 0.5))
    np.testing.assert_allclose(so3.angle(R_a, middle), so3.angle(R_a, R_b) / 2, rtol=0, atol=3e-15)
    np.testing.assert_allclose(quaternion.slerp(a, -b, 0.3), quaternion.slerp(a, b, 0.3), rtol=0, atol=1e-15)


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


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: quaternion.to_matrix([0, 0, 0, 0]), r"Expected quaternion of length 1 within 0\.001 \(wxyz\), got"),
        (lambda: quaternion.to_matrix([1, 0, 0]), r"Expected quaternion of shape \(\.\.\., 4\), got \(3,\)\."),
        (lambda: quaternion.to_matrix([[1, 0, 0, 0], [2, 0, 0, 0]]), "got length 2"),
        (lambda: quaternion.from_matrix(np.zeros((3, 3))), "Expected R to be a rotation"),
        (lambda: quaternion.slerp([1, 0, 0, 0], [3, 0, 0, 0], 0.5), "Expected b of length 1"),
        (lambda: quaternion.multiply([1, 0, 0, 0], [1, 0]), "Expected q of shape"),
        (lambda: quaternion.conjugate([1]), "Expected quaternion of shape"),
        (lambda: quaternion.continuous([1, 0, 0, 0]), "with time along axis 0"),
    ],
)
def test_bad_input_is_a_sentence(call, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        call()


def test_a_length_off_by_rounding_is_normalised() -> None:
    """The published YuMi base has length 0.999998."""
    R = quaternion.to_matrix([0.82888, -0.31402, 0.40801, -0.2188])
    assert so3.is_rotation(R, 1e-15)
    assert quaternion.UNIT_TOLERANCE == 1e-3


def test_missing_stays_missing() -> None:
    q = random_quaternions(2)
    q[1] = np.nan
    R = quaternion.to_matrix(q)
    for result in (R, quaternion.from_matrix(R), quaternion.slerp(q, q[:1], 0.5)):
        assert np.isfinite(result[0]).all()
        assert np.isnan(result[1]).all()
