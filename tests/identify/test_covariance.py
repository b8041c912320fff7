"""Torque covariance over velocity: recovered from synthetic residuals, within its own formal deviation."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.identify import fit_velocity_covariance
from armlab.models import velocity_covariance

C0, CINF, RATE = 0.25, 0.01, 30.0


def sample(seed: int, kind: str, N: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    qd = 0.3 * rng.standard_normal((N, 2))
    shape = [RATE, RATE] if kind == "exp" else [0.05, 0.05]
    truth = velocity_covariance(kind, [C0, 4 * C0], [CINF, 4 * CINF], shape)
    return rng.standard_normal((N, 2)) * np.sqrt(truth.variance(qd)), qd


@pytest.mark.parametrize("kind", ["exp", "step"])
def test_fit_velocity_covariance_recovers_the_truth(kind: str) -> None:
    fit = fit_velocity_covariance(*sample(0, kind, 40_000), kind=kind)
    np.testing.assert_allclose(fit.value.C0, [C0, 4 * C0], rtol=0.1)
    np.testing.assert_allclose(fit.value.Cinf, [CINF, 4 * CINF], rtol=0.05)
    np.testing.assert_allclose(fit.value.shape, RATE if kind == "exp" else 0.05, rtol=0.1)


def test_errors_match_the_formal_deviation() -> None:
    """Normalised squared errors of log C0, log Cinf and log rate over 60 seeds average to one per parameter."""
    expected = np.array([np.log(CINF), np.log(C0 / CINF), np.log(RATE)])
    nees = []
    for seed in range(60):
        fit = fit_velocity_covariance(*sample(seed, "exp"))
        error = fit.parameters[:3] - expected
        nees.append(error @ np.linalg.solve(fit.cov[:3, :3], error) / 3)
    assert 0.7 < np.mean(nees) < 1.35


def test_what_the_data_do_not_tell_is_uncertain_and_never_exact() -> None:
    """White residuals have no rate of decay; always fast joints have no variance at rest."""
    rng = np.random.default_rng(0)
    e, qd = rng.standard_normal((2, 2000, 1))
    white = fit_velocity_covariance(e, qd)
    assert white.sd[2] > 0.5
    assert white.excitation.condition > 1.0
    fast = fit_velocity_covariance(e, 5 + 0.1 * qd)
    assert fast.sd[1] > 3.0
    assert np.all(fit_velocity_covariance(e, qd, "step").sd > 0.01)


def test_constant_is_the_mean_square() -> None:
    residuals, qd = sample(0, "exp")
    fit = fit_velocity_covariance(residuals, qd, "const")
    np.testing.assert_allclose(fit.value.variance(qd)[0], np.mean(residuals**2, axis=0))


def test_bad_input_is_refused() -> None:
    residuals, qd = sample(0, "exp")
    with pytest.raises(ShapeError, match="one shape"):
        fit_velocity_covariance(residuals, qd[:10])
    with pytest.raises(ShapeError, match="finite"):
        fit_velocity_covariance(residuals, np.where(qd == qd[3], np.nan, qd))
    with pytest.raises(NotExcited, match="zeros for joint 2"):
        fit_velocity_covariance(residuals * [1.0, 0.0], qd)
    with pytest.raises(NotExcited, match="one speed"):
        fit_velocity_covariance(residuals, np.ones_like(qd), "step")
    with pytest.raises(NotExcited, match="at least 100"):
        fit_velocity_covariance(residuals[:10], qd[:10])
    with pytest.raises(UnknownName, match="const, exp, step"):
        fit_velocity_covariance(residuals, qd, "cubic")
