"""Fit: a value with its covariance, frozen, with a report."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError, ShapeError
from armlab.estimation import Excitation, Fit


def fit(cov: np.ndarray) -> Fit[float]:
    excitation = Excitation(2, 2, np.array([2.0, 1.0]), "b")
    return Fit(3.0, ("a", "b"), ("m", "N"), np.array([1.0, 2.0]), cov, np.ones(1), np.zeros((5, 1)), 5, excitation)


def test_fit_is_frozen_and_reports_value_deviation_and_unit() -> None:
    result = fit(np.diag([0.04, 0.09]))
    np.testing.assert_allclose(result.sd, [0.2, 0.3])
    assert "+- 0.2 m" in result.report()
    assert "5 samples" in result.report()
    with pytest.raises(ValueError, match="read-only"):
        result.cov[0, 0] = 1.0


def test_fit_refuses_a_covariance_of_another_size() -> None:
    with pytest.raises(ShapeError, match=r"cov of shape \(2, 2\)"):
        fit(np.eye(3))


def test_a_value_without_a_file_format_is_not_saved(tmp_path) -> None:
    with pytest.raises(ConfigError, match="float"):
        fit(np.eye(2)).save(tmp_path / "x.toml")
    assert not list(tmp_path.iterdir())
