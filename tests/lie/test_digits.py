"""A hundred thousand random and near-singular inputs against 64 bits of mantissa.

Half of the rotations are uniform, a quarter have angles from 1e-16 to 0.1 rad, a quarter are 1e-12 to 0.01 rad short of
a half turn. Errors are largest absolute errors of an entry unless stated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab.lie import euler, quaternion, se3, so3

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="needs a long double of 64 bits of mantissa"),
]

COUNT = 100_000
LONG = np.longdouble
LOCKED = {"zyx": (-np.pi / 2, np.pi / 2), "xyz": (-np.pi / 2, np.pi / 2), "zyz": (0.0, np.pi)}


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    u = rng.standard_normal((count, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def rotation_vectors(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q = rng.standard_normal((COUNT // 2, 4))
    uniform = 2 * np.arctan2(np.linalg.norm(q[:, 1:], axis=1), np.abs(q[:, 0]))
    small = 10.0 ** rng.uniform(-16, -1, COUNT // 4)
    large = np.pi - 10.0 ** rng.uniform(-12, -2, COUNT // 4)
    return np.concatenate([uniform, small, large])[:, None] * directions(rng, COUNT)


def exact_quaternion(w: np.ndarray) -> np.ndarray:
    w = w.astype(LONG)
    theta = np.sqrt((w * w).sum(axis=1, keepdims=True))
    return np.concatenate([np.cos(theta / 2), np.sin(theta / 2) / theta * w], axis=1)


def exact_matrix(q: np.ndarray) -> np.ndarray:
    """In long double, of a unit quaternion in long double."""
    w, x, y, z = q.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def largest(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).max())


def either_sign(q: np.ndarray, truth: np.ndarray) -> float:
    return float(np.minimum(np.abs(q - truth).max(axis=1), np.abs(q + truth).max(axis=1)).max())


@pytest.fixture(scope="module")
def w() -> np.ndarray:
    return rotation_vectors()


@pytest.fixture(scope="module")
def truth(w: np.ndarray) -> np.ndarray:
    return exact_matrix(exact_quaternion(w))


def test_exp(w: np.ndarray, truth: np.ndarray) -> None:
    """To 9e-16."""
    R = so3.exp(w)
    assert largest(R, truth) <= 1e-15


def test_log(w: np.ndarray, truth: np.ndarray) -> None:
    """Relative to the angle, of the rounded true matrix: to 7e-16."""
    R = truth.astype(float)
    theta = np.linalg.norm(w, axis=1)

    def error(v: np.ndarray) -> float:
        return float((np.linalg.norm(v - w, axis=1) / theta).max())

    assert error(so3.log(R)) <= 1e-15
    axis, angle = so3.to_axis_angle(R)
    assert error(axis * angle[:, None]) <= 1e-15
    assert largest(so3.from_axis_angle(axis, angle), truth) <= 2e-15


def test_quaternion(w: np.ndarray, truth: np.ndarray) -> None:
    """from_matrix to 3e-16, to_matrix to 9e-16."""
    exact = exact_quaternion(w)
    q, R = exact.astype(float), truth.astype(float)
    assert either_sign(quaternion.from_matrix(R), exact) <= 5e-16
    assert largest(quaternion.to_matrix(q), truth) <= 1e-15


def test_half_turns() -> None:
    """Random half turns, half of them off symmetry by the rounding of a product.

    No square root of a negative number; w is 3e-16 at most, the angle 1.3e-15 off π (its last digit is 4e-16); where w
    is 0 the first component is positive.
    """
    u = directions(np.random.default_rng(2), COUNT)
    R = 2 * u[:, :, None] * u[:, None, :] - np.eye(3)
    R_a = so3.exp(rotation_vectors(1)[: COUNT // 2])
    R[: COUNT // 2] = R_a @ (np.swapaxes(R_a, 1, 2) @ R[: COUNT // 2])
    q = quaternion.from_matrix(R)
    assert np.abs(q[:, 0]).max() <= 5e-16
    assert np.minimum(np.abs(q[:, 1:] - u).max(axis=1), np.abs(q[:, 1:] + u).max(axis=1)).max() <= 1e-15
    v = so3.log(R)
    assert largest(np.linalg.norm(v, axis=1), np.full(COUNT, np.pi)) <= 2e-15
    exactly = q[:, 0] == 0
    assert 0.5 < exactly.mean() < 0.99
    first = np.take_along_axis(v, np.argmax(v != 0, axis=1)[:, None], axis=1)
    assert (first[exactly] > 0).all()


def test_slerp_and_interpolate(w: np.ndarray) -> None:
    """Between random pairs, 0 to 1 of the way: both agree to 1.4e-15."""
    R_a, R_b = so3.exp(rotation_vectors(1)), so3.exp(rotation_vectors(2))
    s = np.random.default_rng(3).uniform(0, 1, COUNT)
    a, b = quaternion.from_matrix(R_a), quaternion.from_matrix(R_b)
    between = quaternion.to_matrix(quaternion.slerp(a, b, s))
    assert largest(between, so3.interpolate(R_a, R_b, s)) <= 5e-15


@pytest.mark.parametrize("convention", euler.CONVENTIONS)
def test_euler(convention) -> None:
    """Over the three conventions, half of them 1e-17 to 0.1 rad from gimbal lock, and at it.

    from_rpy to 4e-16; the rotation that to_rpy reproduces to 2e-13 (the width of the lock), 5e-16 away from it.
    """
    count = COUNT // len(euler.CONVENTIONS)
    rng = np.random.default_rng(0)
    low, high = LOCKED[convention]
    angles = rng.uniform(-np.pi, np.pi, (count, 3))
    half = count // 2
    angles[:half, 1] = rng.uniform(low, high, half)
    off = 10.0 ** rng.uniform(-17, -1, count - half)
    angles[half:, 1] = np.where(rng.integers(0, 2, count - half), low + off, high - off)
    angles[-2000:-1000, 1], angles[-1000:, 1] = low, high
    turns = [exact_turn(angles[:, k], "xyz".index(letter)) for k, letter in enumerate(convention)]
    truth = turns[0] @ turns[1] @ turns[2]
    assert largest(euler.from_rpy(angles, convention), truth) <= 5e-16

    R = truth.astype(float)

    def reproduced(function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        return np.abs(euler.from_rpy(function(R), convention) - R).max(axis=(1, 2))

    ours = reproduced(lambda R: euler.to_rpy(R, convention))
    assert ours.max() <= 1e-12
    assert ours[:half].max() <= 2e-15


def exact_turn(angle: np.ndarray, axis: int) -> np.ndarray:
    R = np.zeros((len(angle), 3, 3), dtype=LONG)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(angle.astype(LONG)), np.sin(angle.astype(LONG))
    R[:, axis, axis] = 1
    R[:, j, j], R[:, k, k], R[:, j, k], R[:, k, j] = c, c, -s, s
    return R


def test_poses(w: np.ndarray, truth: np.ndarray) -> None:
    """Positions of a few metres, errors over 1 + abs(v).

    exp to 5e-16; round trip T → log → exp → T to 9e-16.
    """
    v = 3 * np.random.default_rng(5).standard_normal((COUNT, 3))
    xi = np.concatenate([v, w], axis=1)
    size = 1 + np.linalg.norm(v, axis=1)

    def error(T: np.ndarray) -> float:
        return float((np.abs(T[:, :3, 3] - exact_position(v, w)).max(axis=1) / size).max())

    T = se3.exp(xi)
    assert error(T) <= 1e-15
    assert largest(T[:, :3, :3], truth) <= 1e-15

    def round_trip(again: np.ndarray) -> float:
        return float((np.abs(again - T).max(axis=(1, 2)) / (1 + np.linalg.norm(T[:, :3, 3], axis=1))).max())

    assert round_trip(se3.exp(se3.log(T))) <= 3e-15


def exact_position(v: np.ndarray, w: np.ndarray) -> np.ndarray:
    """V v in long double; (θ - sin θ)/θ³ by its series below 0.3 rad, where 64 bits are not enough either."""
    v, w = v.astype(LONG), w.astype(LONG)
    square = (w * w).sum(axis=1, keepdims=True)
    theta = np.sqrt(square)
    term = np.full_like(theta, LONG(1) / 6)
    series = term
    for k in range(1, 9):
        term = -term * square / ((2 * k + 2) * (2 * k + 3))
        series = series + term
    a = 2 * (np.sin(theta / 2) / theta) ** 2
    b = np.where(theta < 0.3, series, (theta - np.sin(theta)) / theta**3)
    wv = np.cross(w, v)
    return v + a * wv + b * np.cross(w, wv)


def test_project(w: np.ndarray) -> None:
    """Rotations with noise of 0.05 per entry, and RᵀM, which is symmetric of the nearest one.

    To 1.4e-15; idempotent to 1.3e-15.
    """
    M = so3.exp(w) + 0.05 * np.random.default_rng(6).standard_normal((COUNT, 3, 3))
    R, _ = so3.project(M)

    def asymmetry(R: np.ndarray) -> float:
        A = np.swapaxes(R, 1, 2).astype(LONG) @ M.astype(LONG)
        return largest(A, np.swapaxes(A, 1, 2))

    assert asymmetry(R) <= 3e-15
    assert largest(so3.project(R)[0], R) <= 2e-15
