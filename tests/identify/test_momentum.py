"""What the momentum estimators need: memory, velocity noise, factors that make their 2 sigma hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.identify import prepare
from armlab.identify.residuals import momentum_noise, stretches, velocity_noise
from armlab.identify.validation import held_out
from armlab.models import FORCE_RATES, PRIOR


def test_velocity_noise_is_found_under_the_motion(truth, excited) -> None:
    noise = velocity_noise(prepare(excited, truth.robot))
    np.testing.assert_allclose(noise, 1e-3, rtol=0.05)


def test_stretches_hold_the_rows_with_half_a_second_before(truth, excited) -> None:
    data = prepare(excited, truth.robot)
    rows = np.isin(np.arange(len(data.t)), [*range(50, 60), *range(2000, 2100), *range(2200, 2300)])
    assert list(stretches(rows, data)) == [(0, 60), (1876, 2300)]


def test_without_rows_that_count_nothing_is_scaled(truth, excited, model) -> None:
    data = prepare(excited, truth.robot)
    rows = np.ones(len(data.t), dtype=bool)
    noise = momentum_noise(model, [(model, rows)], np.full(data.q.shape, np.nan), data)
    assert (noise.alpha2_observer, noise.alpha2_kf) == (1.0, 1.0)
    np.testing.assert_allclose(noise.memory, 0.004)


def test_some_windows_of_a_long_record_tell_the_factors(truth, excited, model, monkeypatch) -> None:
    data = prepare(excited, truth.robot)
    rows = np.ones(len(data.t), dtype=bool)
    errors, moving = held_out([(model, rows)], data)
    errors = np.where(moving, errors, np.nan)
    whole = momentum_noise(model, [(model, rows)], errors, data)
    monkeypatch.setattr("armlab.identify.residuals.ENOUGH", len(rows) // 2)
    part = momentum_noise(model, [(model, rows)], errors, data)
    assert part.alpha2_observer != whole.alpha2_observer
    assert part.alpha2_observer == pytest.approx(whole.alpha2_observer, rel=0.2)
    np.testing.assert_array_equal(part.memory, whole.memory)


def test_momentum_noise_makes_two_sigma_hold(truth, excited, model) -> None:
    """On the rows that it is set on 95.4 % of the axes that can be seen, unless a factor met its bound."""
    data = prepare(excited, truth.robot)
    rows = np.arange(len(data.t)) < len(data.t) // 2
    folds = [(model, rows), (model, ~rows)]
    errors, moving = held_out(folds, data)
    errors = np.where(moving, errors, np.nan)
    noise = momentum_noise(model, folds, errors, data)
    assert np.all((noise.memory > 0.004) & (noise.memory < 1.0))
    assert 0.25 <= noise.alpha2_kf < 1.0  # a walk that never walks is followed too fast
    rate, prior = np.square(FORCE_RATES["normal"]), np.square(PRIOR)
    judged = replace(model, momentum=noise)
    rows = moving.all(axis=1) & (data.t > 1.0)
    for filters, factor in ((True, noise.alpha2_kf), (False, noise.alpha2_observer)):
        kernel = judged.momentum_kernel(prior, rate, filters=filters)
        F, P, seen, error, variance, *_ = (a[rows] for a in kernel.run(data.q, data.qd, data.tau, data.dt)[:5])
        ratio = (F**2 / np.einsum("kii->ki", P))[seen > 0.9] if filters else error**2 / variance
        assert np.mean(ratio < 4.0) == pytest.approx(0.954, abs=0.02) or factor == 0.25
