"""Whitening of residuals."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.estimation import Measurement
from armlab.estimation.nonlinear import Whitened, cost, median_norm, whiten

RNG = np.random.default_rng(0)
COV = np.array([[4.0, 1.0], [1.0, 9.0]])


def poses(cov: np.ndarray | None, m: int = 5) -> Measurement:
    return Measurement(RNG.standard_normal((m, 2)), RNG.standard_normal((m, 2, 3)), cov, ("t", "R"))


def test_whitened_squares_are_mahalanobis_distances() -> None:
    one = poses(COV)
    rows = whiten([one], [one.roots({})])
    assert isinstance(rows, Whitened)
    expected = np.einsum("ni,ij,nj->n", one.r, np.linalg.inv(COV), one.r)
    np.testing.assert_allclose(rows.squares(5), expected, rtol=1e-12)
    assert rows.numbers(5).tolist() == [2] * 5
    many = Measurement(one.r, one.J, np.broadcast_to(COV, (5, 2, 2)), one.classes)
    np.testing.assert_array_equal(whiten([many], [many.roots({})]).J, rows.J)
    np.testing.assert_allclose(cost([one], [one.roots({})], np.ones(5)), 0.5 * expected.sum(), rtol=1e-12)


def test_variances_alone_are_a_diagonal_covariance() -> None:
    whole = poses(np.diag([4.0, 9.0]))
    short = Measurement(whole.r, whole.J, np.array([4.0, 9.0]), whole.classes)
    assert short.roots({}).tolist() == [0.5, 1.0 / 3.0]
    first, second = (whiten([one], [one.roots({})]) for one in (whole, short))
    np.testing.assert_allclose(first.J, second.J, rtol=1e-15)
    np.testing.assert_allclose(first.r, second.r, rtol=1e-15)
    with pytest.raises(ShapeError, match="positive definite"):
        Measurement(whole.r, whole.J, np.array([4.0, 0.0]), whole.classes).roots({})


def test_estimated_noise_is_a_deviation_per_class() -> None:
    one = poses(None)
    rows = whiten([one], [one.roots({"t": 2.0, "R": 0.5})])
    np.testing.assert_allclose(rows.r.reshape(5, 2), one.r / [2.0, 0.5])
    np.testing.assert_allclose(rows.label.reshape(5, 2)[0], [0, 1])
    np.testing.assert_array_equal(rows.raw, one.r.ravel())
    assert rows.names == ("t", "R")


def test_weights_act_on_samples_and_spare_priors() -> None:
    one = poses(COV)
    known = Measurement(np.ones((1, 1)), np.ones((1, 1, 3)), np.eye(1) * 4.0, ("p",), prior=True)
    everything = [one, known]
    roots = [m.roots({}) for m in everything]
    weight = np.array([1.0, 0.25, 0.0, 1.0, 1.0])
    rows = whiten(everything, roots)
    assert rows.names == ("t", "R")
    kept = rows.times(weight)
    assert len(kept.r) == len(rows.r) - 2
    np.testing.assert_allclose(kept.r[2:4], 0.5 * rows.r[2:4])
    assert kept.r[-1] == 0.5
    assert cost(everything, roots, weight) == pytest.approx(0.5 * kept.r @ kept.r)
    assert rows.times(np.ones(5)) is rows


def test_several_measurements_may_belong_to_one_sample() -> None:
    points = Measurement(np.ones((4, 1)), np.zeros((4, 1, 2)), np.eye(1), ("p",), np.array([0, 0, 1, 1]))
    rows = whiten([points], [points.roots({})])
    assert rows.squares(2).tolist() == [2.0, 2.0]


def test_median_norm_of_three_dimensions() -> None:
    assert median_norm(3) == pytest.approx(1.5382, abs=1e-4)
    assert median_norm(1) == pytest.approx(0.67449, abs=1e-5)


def test_faults_are_refused() -> None:
    with pytest.raises(ShapeError, match="This is a fault of the residual"):
        Measurement(np.ones((3, 2)), np.ones((3, 1, 2)), COV, ("t", "R"))
    with pytest.raises(ShapeError, match="got"):
        Measurement(np.ones((3, 2)), np.ones((3, 2, 2)), COV, ("t",))
    with pytest.raises(ShapeError, match="positive definite"):
        poses(np.zeros((2, 2))).roots({})
    with pytest.raises(ShapeError, match="beside noise that is estimated"):
        Measurement(np.ones((3, 2)), np.ones((3, 2, 2)), COV, ("t", "R"), added=COV)
    with pytest.raises(ShapeError, match="Say how surely it is known"):
        Measurement(np.ones((1, 1)), np.ones((1, 1, 3)), None, ("p",), prior=True)
