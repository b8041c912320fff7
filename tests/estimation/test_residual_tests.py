"""Tests of residuals, and covariances that hold for correlated noise and for few samples."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from armlab.calibrate import fit_force_sensor, fit_hand_eye
from armlab.errors import NotExcited
from armlab.estimation import Fit, Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.linear_problem import student_factor
from armlab.estimation.nonlinear import NonlinearSolution
from armlab.lie import se3, so3

GRAVITY = np.array([0.0, 0.0, -9.80665])
Case = tuple[Fit[Any], np.ndarray]


def slow(rng: np.random.Generator, shape: tuple[int, int], phi: float) -> np.ndarray:
    e = rng.normal(size=shape) * np.sqrt(1.0 - phi**2)
    e[0] /= np.sqrt(1.0 - phi**2)
    for before, now in pairwise(e):
        now += phi * before
    return e


def pose_error(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.concatenate([T[:3, 3] - truth[:3, 3], so3.log(truth[:3, :3].T @ T[:3, :3])])


def random_poses(rng: np.random.Generator, N: int) -> np.ndarray:
    return se3.from_rp(so3.exp(0.7 * rng.normal(size=(N, 3))), 0.3 * rng.normal(size=(N, 3)))


def hand_eye(seed: int, N: int, phi: float) -> Case:
    rng = np.random.default_rng([7, seed])
    A, (X, Y) = random_poses(rng, N), random_poses(rng, 2)
    B, noise = se3.inv(Y) @ A @ X, slow(rng, (N, 6), phi)
    B = se3.from_rp(B[:, :3, :3] @ so3.exp(1e-3 * noise[:, 3:]), B[:, :3, 3] + 5e-4 * noise[:, :3])
    fit = fit_hand_eye(A, B)
    return fit, np.concatenate([pose_error(fit.value.X, X), pose_error(fit.value.Y, Y)])


def force(seed: int, N: int, phi: float) -> Case:
    rng = np.random.default_rng([8, seed])
    RA, R, bias = random_poses(rng, N)[:, :3, :3], so3.exp(rng.normal(size=3)), rng.normal(size=3)
    fit = fit_force_sensor(RA, 1.5 * (GRAVITY @ (RA @ R)) + bias + 0.3 * slow(rng, (N, 3), phi))
    turn = so3.log(R.T @ fit.value.R_tool_sensor)
    return fit, np.concatenate([turn, [fit.value.mass - 1.5], fit.value.bias[:3] - bias])


def covered(case: Callable[[int, int, float], Case], runs: int, N: int, phi: float) -> float:
    inside = []
    for seed in range(runs):
        try:
            fit, e = case(seed, N, phi)
        except NotExcited:
            continue
        inside.append(e @ np.linalg.solve(fit.cov, e) < chi2.ppf(0.95, len(e)))
    assert len(inside) > 0.9 * runs
    return float(np.mean(inside))


@pytest.mark.parametrize("case", [hand_eye, force])
def test_slow_noise_does_not_narrow_the_covariance(case) -> None:
    """With AR(1) noise of coefficient 0.9, covariances that assume white noise cover 1 %."""
    assert covered(case, 15, 40, 0.9) > 0.8
    fit, _ = case(0, 40, 0.9)
    assert not fit.good
    assert "correlated in time" in fit.doubts[0]
    assert fit.doubts[0] in fit.report()
    assert "good:" not in fit.report().replace("not good:", "")
    assert np.trace(fit.formal_cov) < 0.5 * np.trace(fit.cov)


@pytest.mark.slow
@pytest.mark.parametrize("N", [30, 100])
@pytest.mark.parametrize("case", [hand_eye, force])
def test_coverage_of_slow_noise(case, N) -> None:
    """Hand-eye calibration with 30 poses covers 98.7 %: too wide, as the target is 97 %."""
    assert 0.90 <= covered(case, 300, N, 0.9) <= 0.99


@pytest.mark.slow
@pytest.mark.parametrize("N", [4, 5, 8])
@pytest.mark.parametrize("case", [hand_eye, force])
def test_coverage_of_few_samples(case, N) -> None:
    """Coverage is 93 to 97 %, allowing two standard errors of 1500 runs at the lower end."""
    assert 0.919 <= covered(case, 1500, N, 0.0) <= 0.97


def test_three_poses_cover_what_they_say() -> None:
    """Without Student's factor they cover 50 %; a class that is fitted exactly must not dominate."""
    assert covered(hand_eye, 40, 3, 0.0) >= 0.90


@pytest.mark.parametrize("case", [hand_eye, force])
def test_white_noise_is_good(case) -> None:
    fits = [case(seed, 25, 0.0)[0] for seed in range(20)]
    assert sum(not fit.good for fit in fits) <= 1
    assert all(fit.formal_cov is None for fit in fits if fit.good)


def test_student_factor() -> None:
    assert student_factor(np.array([4.0]), np.array([6.0])) == pytest.approx(4 * 4.533677 / 9.487729, rel=1e-6)
    assert student_factor(np.array([4.0, 3.0]), np.array([np.inf, np.inf])) == 1.0
    rng = np.random.default_rng(0)
    for nu in (3.0, 18.0, 54.0):
        sums = 6.0 * (rng.f(6, nu, 200_000) + rng.f(6, nu, 200_000))
        expected = np.quantile(sums, 0.95) / chi2.ppf(0.95, 12)
        assert student_factor(np.full(2, 6.0), np.full(2, nu)) == pytest.approx(expected, rel=0.02)


def level(y: np.ndarray, noise: float | None = None, robust: bool = False) -> NonlinearSolution[np.ndarray]:
    cov = None if noise is None else np.array([noise**2])

    def evaluate(x: np.ndarray) -> list[Measurement]:
        return [Measurement(y[:, None] - x, -np.ones((len(y), 1, 1)), cov, ("y",))]

    problem: NonlinearProblem[np.ndarray] = NonlinearProblem(evaluate, lambda x, step: x + step)
    return nonlinear_least_squares(problem, np.zeros(1), robust=robust)


def test_each_fault_has_its_sentence() -> None:
    rng = np.random.default_rng(1)
    white = rng.normal(size=60)
    assert level(white).check.doubts == ()
    wrong = white + 8.0 * (np.arange(60) % 15 == 0) * np.where(np.arange(60) % 30 == 0, 1.0, -1.0)
    assert "robust=True" in " ".join(level(wrong).check.doubts)
    assert level(wrong, robust=True).check.doubts == ()
    assert any("halves" in one or "half" in one for one in level(white + 2.5 * (np.arange(60) > 29)).check.doubts)
    assert "the given noise" in level(2.0 * white, noise=1.0).check.doubts[0]


def test_the_variance_of_a_mean_of_slow_noise() -> None:
    """The mean of AR(1) noise has (1 + phi) / (1 - phi) times the variance of white noise."""
    found = [level(slow(np.random.default_rng(seed), (400, 1), 0.8)[:, 0]).cov[0, 0] for seed in range(20)]
    assert 0.9 < np.median(found) / (9.0 / 400) < 1.5


def test_false_alarms_are_rare() -> None:
    alarms = [level(np.random.default_rng(seed).normal(size=20)).check.doubts for seed in range(300)]
    assert sum(bool(one) for one in alarms) <= 6
