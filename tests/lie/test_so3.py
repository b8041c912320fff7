"""Rotations: known values, SciPy, edge cases at 0 and at half turns, means, refusals. Group laws: tests/laws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armlab.errors import NotConverged, ShapeError, UnknownName
from armlab.lie import se3, so3

HALF_TURNS = [np.diag(d) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]


def rotation_vectors(count: int, longest: float = np.pi, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((count, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True) * rng.uniform(0, longest, (count, 1))


def test_hat_is_the_cross_product() -> None:
    w, x = rotation_vectors(100), rotation_vectors(100, seed=1)
    np.testing.assert_allclose((so3.hat(w) @ x[..., None])[..., 0], np.cross(w, x), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(so3.hat([1, 2, 3]), [[0, -3, 2], [3, 0, -1], [-2, 1, 0]])


def test_vee_inverts_hat_and_never_guesses() -> None:
    w = rotation_vectors(100)
    np.testing.assert_array_equal(so3.vee(so3.hat(w)), w)
    with pytest.raises(ShapeError, match="Use log for a rotation"):
        so3.vee(so3.exp([0.1, 0.2, 0.3]))
    with pytest.raises(ShapeError, match="Use log for a rotation"):
        so3.vee(np.eye(3))


def test_skew_part() -> None:
    M = np.random.default_rng(0).standard_normal((5, 3, 3))
    S = so3.skew_part(M)
    np.testing.assert_array_equal(S, -np.swapaxes(S, -1, -2))
    np.testing.assert_allclose(so3.skew_part(S + np.eye(3)), S, rtol=0, atol=1e-16)


def test_log_of_half_turns() -> None:
    """Numbers from Robotlib.jl's tests; the sign rule: the first non-zero component is positive."""
    np.testing.assert_array_equal(so3.log(np.diag([-1.0, -1, 1])), [0, 0, np.pi])
    r = np.pi / np.sqrt(2)
    np.testing.assert_allclose(so3.log([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]), [0, r, r], rtol=1e-15)
    np.testing.assert_allclose(so3.log([[-1, 0, 0], [0, 0, -1], [0, -1, 0]]), [0, r, -r], rtol=1e-15)
    np.testing.assert_array_equal(so3.log(HALF_TURNS), np.pi * np.eye(3))


@pytest.mark.parametrize("angle", [1e-8, 1e-4, 0.5, 2.0, np.pi - 1e-4, np.pi - 1e-5, np.pi - 1e-9])
def test_log_keeps_all_digits(angle: float) -> None:
    w = rotation_vectors(1000)
    w *= angle / np.linalg.norm(w, axis=1, keepdims=True)
    assert np.abs(so3.log(so3.exp(w)) - w).max() <= 2e-15 * angle


def test_angle() -> None:
    R = so3.exp(rotation_vectors(1000))
    w = rotation_vectors(1000, seed=1)
    assert so3.angle(R, R).max() <= 1e-15
    np.testing.assert_allclose(so3.angle(R, R @ so3.exp(w)), np.linalg.norm(w, axis=1), rtol=0, atol=2e-15)
    degree = so3.exp([0, 0, np.pi / 180])
    np.testing.assert_allclose(so3.angle(np.eye(3), degree), np.pi / 180, rtol=1e-14)
    assert so3.angle(np.eye(3), R).shape == (1000,)


def test_is_rotation_and_its_tolerance() -> None:
    R = so3.exp([0.1, 0.2, 0.3])
    bad = [R, -R, R * 1.001, np.full((3, 3), np.nan), np.zeros((3, 3)), np.full((3, 3), np.inf)]
    np.testing.assert_array_equal(so3.is_rotation(bad), [True] + [False] * 5)
    off = R + 2e-7
    assert so3.is_rotation(off)
    assert not so3.is_rotation(off, tolerance=1e-9)
    for tolerance in ("a", -1e-9, np.nan, [1e-6, 1e-6], None):
        with pytest.raises(ShapeError, match="tolerance"):
            so3.is_rotation(off, tolerance=tolerance)
    assert so3.ROTATION_TOLERANCE == 1e-5


def test_project_is_the_nearest_rotation() -> None:
    rng = np.random.default_rng(0)
    R = so3.exp(rotation_vectors(50))
    M = R + 0.1 * rng.standard_normal(R.shape)
    projected, distance = so3.project(M)
    assert so3.is_rotation(projected, 1e-14).all()
    np.testing.assert_allclose(distance, np.linalg.norm(projected - M, axis=(1, 2)), rtol=1e-14)
    nearby = projected @ so3.exp(1e-3 * rng.standard_normal((20, 50, 3)))
    assert (np.linalg.norm(nearby - M, axis=(-1, -2)) > distance).all()
    symmetric = np.swapaxes(projected, 1, 2) @ M
    np.testing.assert_allclose(symmetric, np.swapaxes(symmetric, 1, 2), rtol=0, atol=3e-15)


def test_project_of_a_reflection_and_of_nothing() -> None:
    R, _ = so3.project(np.diag([1.0, 1.0, -0.5]))
    np.testing.assert_allclose(R, np.eye(3), rtol=0, atol=1e-15)
    for M in (np.diag([1.0, 0.0, 0.0]), np.zeros((3, 3)), -np.eye(3)):
        with pytest.raises(ShapeError, match="unique nearest rotation"):
            so3.project(M)


def test_axis_angle_by_hand() -> None:
    axis, angle = so3.to_axis_angle(np.eye(3))
    np.testing.assert_array_equal(axis, [0, 0, 1])
    assert angle == 0
    axis, angle = so3.to_axis_angle(HALF_TURNS)
    np.testing.assert_array_equal(axis, np.eye(3))
    np.testing.assert_array_equal(angle, np.pi)
    np.testing.assert_allclose(so3.from_axis_angle([0, 0, 7.0], np.pi / 2) @ [1, 0, 0], [0, 1, 0], rtol=0, atol=1e-15)
    assert so3.from_axis_angle(np.eye(3)[:, None], np.zeros(5)).shape == (3, 5, 3, 3)


def test_xy_angle_is_the_signed_turn_about_z() -> None:
    """The ancestor's function was documented as this but returned the turn about x."""
    turns = np.linspace(-np.pi, np.pi, 41)[1:]
    R_a = so3.exp(rotation_vectors(40))
    R_b = R_a @ so3.exp(turns[:, None] * [0.0, 0, 1])
    difference = so3.xy_angle(R_a, R_b) - turns
    np.testing.assert_allclose(difference - 2 * np.pi * np.round(difference / (2 * np.pi)), 0, rtol=0, atol=2e-15)
    np.testing.assert_allclose(
        so3.xy_angle(np.eye(3), so3.exp([[0, 0, -0.3], [0.4, 0, 0]])), [-0.3, 0], rtol=0, atol=1e-16
    )


def test_xy_angle_has_no_value_where_x_is_vertical() -> None:
    angles = so3.xy_angle(np.eye(3), so3.exp([[0, -np.pi / 2, 0], [0, np.pi / 2, 0], [0, 1.5, 0]]))
    np.testing.assert_array_equal(np.isnan(angles), [True, True, False])


def test_angle_about_is_the_twist() -> None:
    """R = swing twist: the turn about the axis is found for any swing at right angles to it."""
    rng = np.random.default_rng(3)
    axis = rng.standard_normal((500, 3))
    across = np.cross(axis, rng.standard_normal((500, 3)))
    twist = rng.uniform(-np.pi, np.pi, 500)
    swing = so3.from_axis_angle(across, rng.uniform(0, 3.0, 500))
    R_a = so3.exp(rotation_vectors(500))
    R_b = R_a @ swing @ so3.from_axis_angle(axis, twist)
    np.testing.assert_allclose(so3.angle_about(R_a, R_b, axis), twist, rtol=0, atol=2e-14)
    R_z = so3.exp([[0, 0, 1.0], [0, 0, -2.0], [0, 0, np.pi], [0, 0, -np.pi]])
    np.testing.assert_allclose(so3.angle_about(np.eye(3), R_z, [0, 0, 2.0]), [1, -2, np.pi, np.pi], rtol=1e-15)
    np.testing.assert_allclose(so3.xy_angle(np.eye(3), R_z[:2]), [1, -2], rtol=1e-15)
    assert so3.angle_about(np.eye(3), HALF_TURNS[2], [0, 0, -1.0]) == np.pi
    assert np.isnan(so3.angle_about(np.eye(3), HALF_TURNS[0], [0, 0, 1.0]))


@pytest.mark.parametrize("method", ["chordal", "geodesic"])
def test_mean_of_a_symmetric_pair(method) -> None:
    """The mean of R exp(w) and R exp(-w) is R, to the last digits, up to a quarter turn each way."""
    R, w = so3.exp(rotation_vectors(1000)), rotation_vectors(1000, longest=1.4, seed=1)
    pair = np.stack([R @ so3.exp(w), R @ so3.exp(-w)])
    assert np.abs(so3.mean(pair, method=method) - R).max() <= 2e-15


@pytest.mark.parametrize(("call", "sentence"), [
    (lambda: so3.hat(1.0), r"Expected w of shape \(\.\.\., 3\), got \(\)\."),
    (lambda: so3.hat(["turn"]), r"Expected w to be an array of real numbers, got list"),
    (lambda: so3.hat([1j, 0, 0]), r"Expected w to be an array of real numbers, got list"),
    (lambda: so3.interpolate(np.eye(3), 2 * np.eye(3), 0.5), "Expected R_b to be a rotation"),
    (lambda: so3.xy_angle(np.eye(4), np.eye(3)), "Expected R_a of shape"),
    (lambda: so3.angle_about(np.eye(3), np.eye(3), np.zeros(3)), r"an axis of finite, non-zero length, got \[0\."),
    (lambda: so3.from_axis_angle([[1, 0, 0], [0, 0, 0]], 1.0), "Expected an axis of finite, non-zero length"),
    (lambda: so3.from_axis_angle(np.ones((3, 3)), np.ones(4)), r"leading axes that broadcast, got axis of"),
    (lambda: so3.xy_angle(np.tile(np.eye(3), (2, 1, 1)), np.tile(np.eye(3), (5, 1, 1))),
     r"leading axes that broadcast, got R_a of shape \(2, 3, 3\), R_b of shape \(5, 3, 3\)\."),
    (lambda: so3.angle_about(np.eye(3), np.tile(np.eye(3), (2, 1, 1)), np.ones((5, 3))),
     r"leading axes that broadcast, got R_a of shape \(3, 3\), R_b of .*, axis of shape \(5, 3\)\."),
    (lambda: so3.project(np.diag([np.inf, 1, 1])), "finite matrices, got an infinite entry"),
    (lambda: so3.to_axis_angle(np.zeros((3, 3))), "Expected R to be a rotation"),
    (lambda: so3.project(np.eye(2)), "Expected M of shape"),
])  # fmt: skip
def test_bad_input_is_a_sentence(call, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        call()


def test_missing_stays_missing() -> None:
    R = so3.exp(np.array([[0.1, 0.2, 0.3], [np.nan, 0, 0]]))
    for result in (R, so3.log(R), so3.angle(R, np.eye(3)), so3.project(R)[0], so3.left_jacobian_inv(so3.log(R))):
        assert np.isfinite(result[0]).all()
        assert np.isnan(result[1]).any()


def scattered(count: int, spread: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    R = so3.exp(rng.standard_normal(3))
    return R, R @ so3.exp(spread * rng.standard_normal((count, 3)))


def test_chordal_mean_equals_scipy() -> None:
    _, R = scattered(200, 0.4)
    weights = np.random.default_rng(1).uniform(0, 1, 200)
    expected = Rotation.from_matrix(R).mean(weights).as_matrix()
    np.testing.assert_allclose(so3.mean(R, weights), expected, rtol=0, atol=2e-15)


@pytest.mark.parametrize("spread", [1e-9, 0.1, 0.6])
def test_geodesic_mean_has_no_gradient(spread: float) -> None:
    _, R = scattered(100, spread)
    weights = np.random.default_rng(1).uniform(0, 1, 100)
    mean = so3.mean(R, weights, "geodesic")
    gradient = (weights[:, None] * so3.log(mean.T @ R)).sum(axis=0) / weights.sum()
    assert np.abs(gradient).max() <= 1e-15
    cost = (weights * so3.angle(mean, R) ** 2).sum()
    for step in 1e-3 * spread * np.vstack([np.eye(3), -np.eye(3)]):
        assert (weights * so3.angle(mean @ so3.exp(step), R) ** 2).sum() > cost


def test_weights_and_batches() -> None:
    _, R = scattered(60, 0.3)
    sets = R.reshape(20, 3, 3, 3)
    means = so3.mean(sets)
    assert means.shape == (3, 3, 3)
    np.testing.assert_allclose(means[1], so3.mean(sets[:, 1]), rtol=0, atol=1e-15)
    weights = np.zeros((20, 3))
    weights[4] = 2.0
    np.testing.assert_allclose(so3.mean(sets, weights), sets[4], rtol=0, atol=2e-15)
    np.testing.assert_allclose(
        so3.mean(sets, np.arange(20), "geodesic")[2], so3.mean(sets[:, 2], np.arange(20), "geodesic")
    )
    np.testing.assert_allclose(so3.mean(np.tile(sets[0, 0], (7, 1, 1))), sets[0, 0], rtol=0, atol=2e-15)


@pytest.mark.parametrize("method", ["chordal", "geodesic"])
def test_a_weight_of_zero_leaves_out_what_is_missing(method) -> None:
    T = se3.exp(0.3 * np.random.default_rng(2).standard_normal((6, 2, 6)))
    holed, weights = T.copy(), np.ones((6, 2))
    holed[1, 0] = np.nan
    weights[1, 0] = 0.0
    mean = se3.mean(holed, weights, method)
    np.testing.assert_array_equal(mean, se3.mean(T, weights, method))
    np.testing.assert_array_equal(mean[:, :3, :3], so3.mean(holed[..., :3, :3], weights, method))
    np.testing.assert_allclose(mean[0], se3.mean(np.delete(T[:, 0], 1, axis=0), method=method), rtol=0, atol=1e-15)
    assert np.isnan(se3.mean(holed, method=method)[0]).any()


def test_mean_of_poses() -> None:
    rng = np.random.default_rng(0)
    T = se3.exp(np.concatenate([rng.standard_normal((50, 3)), 0.3 * rng.standard_normal((50, 3))], axis=1))
    weights = rng.uniform(0, 1, 50)
    mean = se3.mean(T, weights, "geodesic")
    np.testing.assert_allclose(mean[:3, 3], np.average(T[:, :3, 3], axis=0, weights=weights), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(mean[:3, :3], so3.mean(T[:, :3, :3], weights, "geodesic"))
    assert se3.is_pose(se3.mean(T.reshape(10, 5, 4, 4))).all()


EVERYWHERE = so3.exp(np.pi / 2 * np.array([[0, 0, 0], [0, 0, 2], [2, 0, 0], [0, 2, 0]]))


@pytest.mark.parametrize(("call", "error", "sentence"), [
    (lambda: so3.mean(EVERYWHERE), ShapeError, "well-defined mean, got an agreement of"),
    (lambda: so3.mean(EVERYWHERE[:2]), ShapeError, "Cluster them"),
    (lambda: so3.mean(np.zeros((0, 3, 3))), ShapeError, "at least one element along axis 0"),
    (lambda: so3.mean(np.eye(3)), ShapeError, "at least one element along axis 0"),
    (lambda: so3.mean(np.zeros((2, 3, 3))), ShapeError, r"Expected R\[0\] to be a rotation"),
    (lambda: so3.mean(EVERYWHERE, [1, 2]), ShapeError, r"Expected weights of shape \(4,\), got \(2,\)"),
    (lambda: so3.mean(EVERYWHERE, [1, 2, 3, -1]), ShapeError, ">= 0"),
    (lambda: so3.mean(EVERYWHERE, np.zeros(4)), ShapeError, "positive sum"),
    (lambda: so3.mean(EVERYWHERE, [1, np.nan, 0, 0]), ShapeError, "Expected finite weights"),
    (lambda: so3.mean(EVERYWHERE, method="median"), UnknownName, "chordal, geodesic"),
    (lambda: se3.mean(np.zeros((2, 4, 4))), ShapeError, r"Expected the rotation of T\[0\]"),
])  # fmt: skip
def test_what_has_no_mean_is_refused(call, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        call()


def test_an_iteration_that_does_not_end_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """No known set of rotations needs more than a few steps; this one needs more than one."""
    monkeypatch.setattr("armlab.lie.so3.ITERATIONS", 1)
    with pytest.raises(NotConverged, match="Use the chordal mean"):
        so3.mean(scattered(10, 0.6)[1], method="geodesic")
