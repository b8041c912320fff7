"""Means of rotations and poses: what they minimise, weights, what has no mean."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armlab.errors import NotConverged, ShapeError, UnknownName
from armlab.lie import se3, so3


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


def test_noise_is_averaged_out() -> None:
    """A thousand measurements of 0.1 rad: the mean is about 0.1 / sqrt(1000) rad off."""
    truth, R = scattered(1000, 0.1)
    for method in ("chordal", "geodesic"):
        assert so3.angle(truth, so3.mean(R, method=method)) < 3 * 0.1 * np.sqrt(3 / 1000)


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


def test_a_missing_rotation_leaves_its_mean_missing() -> None:
    _, R = scattered(20, 0.3)
    sets = R.reshape(10, 2, 3, 3).copy()
    sets[3, 1] = np.nan
    for method in ("chordal", "geodesic"):
        mean = so3.mean(sets, method=method)
        assert np.isfinite(mean[0]).all()
        assert np.isnan(mean[1]).all()


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


@pytest.mark.parametrize(
    ("call", "error", "sentence"),
    [
        (lambda: so3.mean(EVERYWHERE), ShapeError, "agree on a mean, got ones that point everywhere"),
        (lambda: so3.mean(EVERYWHERE[:2]), ShapeError, "Cluster them"),
        (lambda: so3.mean(np.zeros((0, 3, 3))), ShapeError, "at least one element along axis 0"),
        (lambda: so3.mean(np.eye(3)), ShapeError, "at least one element along axis 0"),
        (lambda: so3.mean(np.zeros((2, 3, 3))), ShapeError, r"Expected R\[0\] to be a rotation"),
        (lambda: so3.mean(EVERYWHERE, [1, 2]), ShapeError, r"Expected weights of shape \(4,\), got \(2,\)"),
        (lambda: so3.mean(EVERYWHERE, [1, 2, 3, -1]), ShapeError, "none negative"),
        (lambda: so3.mean(EVERYWHERE, np.zeros(4)), ShapeError, "sum above 0"),
        (lambda: so3.mean(EVERYWHERE, [1, np.nan, 0, 0]), ShapeError, "Expected finite weights"),
        (lambda: so3.mean(EVERYWHERE, method="median"), UnknownName, "chordal, geodesic"),
        (lambda: se3.mean(np.zeros((2, 4, 4))), ShapeError, r"Expected the rotation of T\[0\]"),
    ],
)
def test_what_has_no_mean_is_refused(call, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        call()


def test_an_iteration_that_does_not_end_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """No set of rotations is known that needs more than a few steps; one step is too few for this one."""
    monkeypatch.setattr("armlab.lie.so3.ITERATIONS", 1)
    with pytest.raises(NotConverged, match="Take the chordal mean"):
        so3.mean(scattered(10, 0.6)[1], method="geodesic")
