"""Fits of rhythmic motion: the accuracy of the motion, the statistical contract, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation import Experiment, Gauge, check_estimator
from armlab.motion import PeriodicDmp, fit_periodic_dmp

PERIOD = 2.0
T = np.linspace(0.0, 2 * PERIOD, 1001)


def wave(t: np.ndarray) -> np.ndarray:
    phi = 2 * np.pi * t / PERIOD
    return np.stack([np.sin(phi) + 0.4 * np.sin(3 * phi + 0.5), 0.3 + 0.1 * np.cos(phi)], axis=1)


def test_the_steady_motion_is_the_demonstration() -> None:
    fit = fit_periodic_dmp(T, wave(T), period=PERIOD)
    run = fit.value.rollout(T)
    size = np.ptp(wave(T), axis=0)
    assert (np.sqrt(((run.y - wave(T)) ** 2).mean(axis=0)) / size).max() < 1e-6
    assert (np.sqrt((fit.residuals**2).mean(axis=0)) / size).max() < 1e-6
    late = fit.value.rollout(T, y0=[2.0, -1.0], v0=[0.0, 0.0])
    np.testing.assert_allclose(late.y[500:], wave(T)[500:], atol=2e-6)


def test_a_shifted_clock_changes_nothing_and_other_harmonics_come_in_h() -> None:
    one, other = (fit_periodic_dmp(T + shift, wave(T), period=PERIOD) for shift in (0.0, 5.0))
    np.testing.assert_allclose(other.value.rollout(T).y, one.value.rollout(T).y, atol=1e-9)
    wide = fit_periodic_dmp(T, wave(T), period=PERIOD, h=4.0, n_basis=9, g=[0.0, 0.3])
    assert wide.value.h == 4.0
    np.testing.assert_array_equal(wide.value.g, [0.0, 0.3])


TRUTH = fit_periodic_dmp(T, wave(T)[:, :1], period=PERIOD, n_basis=6, h=0.5, g=[0.0]).value


def drawn(seed: int, n: int) -> Experiment:
    t = np.linspace(0.0, 5 * PERIOD, n)
    y = TRUTH.rollout(t).y + 0.01 * np.random.default_rng([4, seed]).normal(size=(n, 1))
    data = {"t": t, "y": y, "period": PERIOD, "n_basis": 6, "h": 0.5, "g": np.zeros(1)}
    return Experiment(data, TRUTH.weights.T.ravel())


def test_the_fit_meets_the_contract() -> None:
    contract = check_estimator(
        fit_periodic_dmp,
        drawn,
        25,
        n=150,
        noise_given=False,
        gauges=[Gauge("millimetres", lambda d: {**d, "y": 1e3 * d["y"]}, lambda fit: 1e3 * fit.parameters)],
        skip={
            "efficient": "judged from 1000 runs on",
            "order-free": "samples are a motion in time",
            "refuses": "a test of its own: periods that were seen in part",
            "robust": "a motion has no outliers that could be told from it",
        },
    )
    assert contract.passed, contract.text()


def test_a_ridge_makes_weights_smaller() -> None:
    free, held = (fit_periodic_dmp(T, wave(T), period=PERIOD, ridge=ridge).value for ridge in (0.0, 1e-3))
    assert np.linalg.norm(held.weights) < np.linalg.norm(free.weights)
    assert isinstance(replace(held, period=1.0), PeriodicDmp)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_period_seen_in_part_is_refused_by_what_is_missing(share: float) -> None:
    """The motion would be off by 1e12, 7e7 and 29 times its size where there are no samples."""
    t = np.linspace(0.0, share * PERIOD, 500)
    with pytest.raises(NotExcited, match=rf"from {share:.2g} to 1 of it.*ridge") as refused:
        fit_periodic_dmp(t, wave(t), period=PERIOD)
    assert refused.value.directions
    held = fit_periodic_dmp(t, wave(t), period=PERIOD, ridge=1e-8)
    assert np.abs(held.value.rollout(np.linspace(0.0, PERIOD, 100)).y).max() < 10.0


def test_samples_at_few_places_of_many_periods_are_refused() -> None:
    t = PERIOD / 4 * np.arange(200)
    with pytest.raises(NotExcited, match="21 of 25 weights untold"):
        fit_periodic_dmp(t, wave(t), period=PERIOD)
    t = 1.01 * t
    assert fit_periodic_dmp(t, wave(t), period=PERIOD).excitation.condition < 1e3


def test_several_demonstrations_are_refused() -> None:
    with pytest.raises(ShapeError, match="one demonstration, got 2"):
        fit_periodic_dmp([T, T], [wave(T), wave(T)], period=PERIOD)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"period": 0.0}, ShapeError, "period above zero"),
        ({"period": np.nan}, ShapeError, "period above zero"),
        ({"n_basis": 2}, ConfigError, "3 to 1000"),
        ({"h": -1.0}, ShapeError, "h above zero"),
        ({"ridge": -1.0}, ConfigError, "ridge"),
        ({"alpha_z": 0.0}, ShapeError, "alpha_z above zero"),
        ({"g": [0.0]}, ShapeError, "g with 2"),
        ({"t": T[::-1]}, ShapeError, "times that increase"),
        ({"y": np.where(T[:, None] > 3, np.nan, wave(T))}, ShapeError, "rows 751"),
        ({"y": wave(T)[:5]}, ShapeError, "shapes"),
    ],
)
def test_bad_input_is_refused_by_a_sentence(change: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        fit_periodic_dmp(**{"t": T, "y": wave(T), "period": PERIOD, **change})
