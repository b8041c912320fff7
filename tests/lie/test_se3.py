"""Poses: known values, translations, refusals. Group laws: tests/laws."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.lie import euler, quaternion, se3, so3


def random_twists(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, 6))


def test_from_rp() -> None:
    R, p = so3.exp([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0])
    T = se3.from_rp(R, p)
    np.testing.assert_array_equal(T[:3, :3], R)
    np.testing.assert_array_equal(T[:, 3], [1, 2, 3, 1])
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    assert se3.from_rp(R, np.zeros((4, 1, 3))).shape == (4, 1, 4, 4)
    np.testing.assert_array_equal(se3.from_rp(R)[:3, 3], 0)


def test_hat_and_vee() -> None:
    xi = np.arange(1.0, 7.0)
    np.testing.assert_array_equal(se3.hat(xi), [[0, -6, 5, 1], [6, 0, -4, 2], [-5, 4, 0, 3], [0, 0, 0, 0]])
    batch = random_twists(10)
    np.testing.assert_array_equal(se3.vee(se3.hat(batch)), batch)


def test_adjoint_by_hand() -> None:
    """A frame 1 m along x with a quarter turn about z: rotation about its z axis moves the origin of a along -y."""
    T_a_b = se3.from_rp(euler.rot_z(np.pi / 2), [1.0, 0.0, 0.0])
    twist_a = se3.adjoint(T_a_b) @ [0, 0, 0, 0, 0, 1.0]
    np.testing.assert_allclose(twist_a, [0, -1, 0, 0, 0, 1], rtol=0, atol=1e-16)
    np.testing.assert_allclose(se3.adjoint_inv(T_a_b) @ twist_a, [0, 0, 0, 0, 0, 1], rtol=0, atol=1e-16)


def test_transform_wrench_by_hand() -> None:
    """2 N along b's x axis, which is a's y axis, at 1 m along a's x axis: 2 N m about a's z axis."""
    T_a_b = se3.from_rp(euler.rot_z(np.pi / 2), [1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        se3.transform_wrench(T_a_b, [2.0, 0, 0, 0, 0, 0]), [0, 2, 0, 0, 0, 2], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(
        se3.transform_wrench(T_a_b, [0, 0, 0, 3.0, 0, 0]), [0, 0, 0, 0, 3, 0], rtol=0, atol=1e-15
    )
    assert se3.transform_wrench(T_a_b, np.zeros((5, 6))).shape == (5, 6)


@pytest.mark.parametrize("path", ["linear", "screw"])
def test_interpolate_ends_exactly_and_halves(path) -> None:
    T_a, T_b = se3.exp(random_twists(300)), se3.exp(random_twists(300, seed=1))
    np.testing.assert_array_equal(se3.interpolate(T_a, T_b, 0.0, path), T_a)
    np.testing.assert_array_equal(se3.interpolate(T_a, T_b, 1.0, path), T_b)
    middle = se3.interpolate(T_a, T_b, 0.5, path)
    R_a, R_b = T_a[:, :3, :3], T_b[:, :3, :3]
    np.testing.assert_allclose(so3.angle(R_a, middle[:, :3, :3]), so3.angle(R_a, R_b) / 2, rtol=0, atol=2e-15)
    if path == "linear":
        np.testing.assert_allclose(middle[:, :3, 3], (T_a + T_b)[:, :3, 3] / 2, rtol=0, atol=1e-15)
    else:
        half = se3.log(se3.inv(T_a) @ middle)
        np.testing.assert_allclose(2 * half, se3.log(se3.inv(T_a) @ T_b), rtol=0, atol=1e-13)
    assert se3.interpolate(T_a[0], T_b[0], np.linspace(0, 1, 7), path).shape == (7, 4, 4)


def test_angular_first_libraries() -> None:
    """The adjoint of Modern Robotics, [[R, 0], [hat(p) R, R]], is ours with row and column blocks swapped."""
    twist = np.arange(6.0)
    np.testing.assert_array_equal(se3.from_angular_first(twist), [3, 4, 5, 0, 1, 2])
    np.testing.assert_array_equal(se3.to_angular_first(se3.from_angular_first(twist)), twist)
    Ad = se3.adjoint(se3.exp(random_twists(4)))
    turned = se3.to_angular_first(se3.to_angular_first(Ad), axis=-2)
    np.testing.assert_array_equal(turned[:, :3, 3:], 0)
    np.testing.assert_array_equal(turned[:, 3:, :3], Ad[:, :3, 3:])
    J = np.arange(42.0).reshape(6, 7)
    np.testing.assert_array_equal(se3.to_angular_first(J, axis=0), np.vstack([J[3:], J[:3]]))


def test_is_pose() -> None:
    T = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    scaled, last_row, missing = T.copy(), T.copy(), T.copy()
    scaled[:3, :3] *= 1.01
    last_row[3, 0] = 1e-12
    missing[0, 3] = np.nan
    np.testing.assert_array_equal(se3.is_pose([T, scaled, last_row, missing]), [True, False, False, False])
    assert se3.is_pose(T).shape == ()
    T[:3, :3] += 2e-7
    assert se3.is_pose(T)
    assert not se3.is_pose(T, tolerance=1e-9)


def test_project() -> None:
    T = se3.exp(random_twists(10))
    rough = T.copy()
    rough[:, :3, :3] = np.round(T[:, :3, :3], 3)
    projected, distance = se3.project(rough)
    assert se3.is_pose(projected, 1e-14).all()
    np.testing.assert_array_equal(projected[:, :3, 3], T[:, :3, 3])
    assert (distance > 0).all()
    assert (distance < 2e-3).all()


@pytest.mark.parametrize(("call", "sentence"), [
    (lambda: se3.project(np.diag([1.0, 1, 1, 2])), "as the last row of M"),
    (lambda: se3.from_rp(np.eye(3), [1, 2]), "Expected p of shape"),
    (lambda: se3.from_rp(-np.eye(3)), "determinant = -1"),
    (lambda: se3.from_rp(np.tile(np.eye(3), (2, 1, 1)), np.ones((5, 3))), r"leading axes that broadcast, got R"),
    (lambda: se3.vee(np.eye(4)), "Use log for a pose"),
    (lambda: se3.hat([[1, 2]]), "Expected xi of shape"),
    (lambda: se3.ad([1, 2]), "Expected xi of shape"),
    (lambda: se3.left_jacobian([1, 2]), "Expected xi of shape"),
    (lambda: se3.left_jacobian_inv([1, 2]), "Expected xi of shape"),
    (lambda: se3.interpolate(np.eye(4), np.zeros((4, 4)), 0.5), "Expected the rotation of T_b"),
    (lambda: se3.from_angular_first(np.zeros((6, 7))), r"length 6 along axis -1, got shape \(6, 7\)"),
    (lambda: se3.to_angular_first(np.zeros(6), axis=1), "length 6 along axis 1"),
    (lambda: se3.transform_wrench(np.eye(4), [1, 2, 3]), "Expected wrench_b of shape"),
])  # fmt: skip
def test_bad_input_is_a_sentence(call, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        call()


def test_an_unknown_path_is_refused() -> None:
    with pytest.raises(UnknownName, match="linear, screw"):
        se3.interpolate(np.eye(4), np.eye(4), 0.5, "straight")  # type: ignore[arg-type]


@pytest.mark.parametrize("digits", [8, 6])
def test_rounded_rotations_are_used_as_the_nearest_ones(digits: int) -> None:
    """Every function accepts poses with six decimals, as if they were projected; beyond 1e-5, all refuse."""
    T = np.round(se3.exp(random_twists(50)), digits)
    near, w = se3.project(T)[0], np.ones(6)
    R, exact = T[:, :3, :3], near[:, :3, :3]
    of_poses = se3.inv, se3.log, se3.adjoint, se3.adjoint_inv, se3.mean, se3.orthonormalise
    of_rotations = so3.log, so3.orthonormalise, quaternion.from_matrix, se3.from_rp
    pairs = [(f(T), f(near)) for f in of_poses] + [(f(R), f(exact)) for f in of_rotations]
    pairs += [
        (euler.to_rpy(R, "zyx"), euler.to_rpy(exact, "zyx")),
        (se3.transform_wrench(T, w), se3.transform_wrench(near, w)),
        (se3.interpolate(T[0], T[1:], 0.3), se3.interpolate(near[0], near[1:], 0.3)),
        (so3.interpolate(R[0], R[1:], 0.3), so3.interpolate(exact[0], exact[1:], 0.3)),
        (so3.angle(R[0], R[1:]), so3.angle(exact[0], exact[1:])),
    ]
    for got, wanted in pairs:
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-13)
    assert se3.is_pose(T).all()
    coarse = np.round(T, 4)
    for f in (se3.inv, se3.log, se3.adjoint):
        with pytest.raises(ShapeError, match="rotation within 1e-05"):
            f(coarse)
