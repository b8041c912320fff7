"""How many samples a coloured record is worth."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.estimation import block_seconds, correlation_time, effective_samples

RHO = 0.95  # of the AR(1) records of conftest


def test_correlation_time_and_effective_samples_of_known_processes(problems) -> None:
    x = problems.ar1(np.random.default_rng(0), (200_000, 1))[:, 0]
    exact = 0.004 * (0.5 + RHO / (1 - RHO))
    assert correlation_time(x, 0.004) == pytest.approx(exact, rel=0.1)
    assert effective_samples(x) == pytest.approx(len(x) * 0.002 / exact, rel=0.1)
    white = np.random.default_rng(0).standard_normal(50_000)
    assert effective_samples(white) == pytest.approx(50_000, rel=0.05)
    assert correlation_time(np.zeros(100), 0.01) == 0.005


def test_block_seconds_follow_the_longest_memory(problems) -> None:
    rng = np.random.default_rng(0)
    white = rng.standard_normal((50_000, 1))
    slow = problems.ar1(rng, (50_000, 1))
    assert block_seconds(white, 0.004) == 0.5
    assert block_seconds(np.hstack([white, slow]), 0.1) == 4.0 * correlation_time(slow[:, 0], 0.1)


def test_effective_samples_make_the_band_of_a_mean_true() -> None:
    """AR(1) residuals, rho 0.95, 4 ms: two sigma of the mean of 1 s hold 90 to 97 %, of white noise below 60 %."""
    from scipy.signal import lfilter

    dt, seconds = 0.004, 1.0
    record = lfilter([1.0], [1.0, -RHO], np.random.default_rng(1).standard_normal(1_250_000))
    training, means = record[:250_000], record[250_000:].reshape(-1, int(seconds / dt)).mean(axis=1)
    variance = np.mean(training**2)
    honest = np.sqrt(2.0 * variance * correlation_time(training, dt) / seconds)
    white = np.sqrt(variance * dt / seconds)
    assert 0.90 < np.mean(np.abs(means) < 2.0 * honest) < 0.97
    assert np.mean(np.abs(means) < 2.0 * white) < 0.60
    assert honest == pytest.approx(np.sqrt(variance / (effective_samples(training) * seconds / (dt * len(training)))))


def test_records_that_tell_nothing_are_refused() -> None:
    for wrong, words in ((np.zeros(0), r"\(0,\)"), (np.zeros(1), r"\(1,\)"), (np.array([1.0, np.nan, 2.0]), "1 NaN")):
        for function in (effective_samples, lambda x: correlation_time(x, 0.1), lambda x: block_seconds(x[:, None], 1)):
            with pytest.raises(ShapeError, match=words):
                function(wrong)
    assert block_seconds(np.zeros((10, 0)), 0.1) == 0.5
