"""Solving for parameters, friction structure and gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import identify
from armlab.dynamics import base_parameters
from armlab.estimation import Rows, least_squares
from armlab.estimation.linear_problem import LinearSolution
from armlab.identify import prepare
from armlab.identify.regression import Design
from armlab.identify.solve import GAIN_SD, GainProblem, best_cutoff, calibrated, gain_share, linearised, solved


def test_numbers_that_the_log_does_not_tell_have_no_slope(short_arm) -> None:
    """With pure noise as torque, no linearisation holds for a presliding distance that the data do not show."""
    data = prepare(short_arm.log(0, 1500), short_arm.robot)
    noise = replace(data, tau=np.random.default_rng(0).standard_normal(data.tau.shape))
    design = Design.build(noise, short_arm.robot, base_parameters(short_arm.robot))
    theta = np.full(len(design.layout.names), 1e-3)
    assert not linearised(design, theta, "wls")[0].free.any()


# Least squares with a gain per joint.


X = np.array([2.0, -1.0, 0.5])
NAMES = ("a", "b", "c")


def problem(gains: np.ndarray, seed: int = 0, noise: float = 0.01) -> GainProblem:
    rng = np.random.default_rng(seed)
    N, n = 400, len(gains)
    A = rng.standard_normal((N, n, 3))
    y = (1 + gains) * (A @ X) + noise * rng.standard_normal((N, n))
    found = least_squares(list(Rows.of(A, y, np.arange(N) // 20)), NAMES)
    return GainProblem.of(found, y - A @ found.x, np.zeros(n), 0.05)


def test_parameters_and_gains_err_as_their_covariances_say() -> None:
    """Over many draws of noise and gains."""
    nees = []
    for seed in range(60):
        gains = 0.05 * np.random.default_rng([1, seed]).standard_normal(4)
        made = problem(gains, seed=seed, noise=0.3)
        x, g = made.solve()
        pairs = (x - X, made.covariance(x, g)), (g - gains, made.gain_covariance(x, g))
        nees.append([e @ np.linalg.solve(cov, e) / len(e) for e, cov in pairs])
    assert np.all(np.abs(np.mean(nees, axis=0) - 1.0) < 3 * np.sqrt(2 / (np.array([3, 4]) * 60)))


def test_exact_measurements_are_solved() -> None:
    """Without noise a joint would seem to know its gain infinitely well."""
    made = problem(np.array([0.04, -0.03, 0.02, -0.05]), noise=0.0)
    x, g = made.solve()
    np.testing.assert_allclose(np.outer(1 + g, x), np.outer([1.04, 0.97, 1.02, 0.95], X), rtol=1e-3)
    information = made.information(x, g)
    assert np.linalg.eigvalsh(information).min() > 0
    assert x @ information @ x == pytest.approx(4 / 0.05**2, rel=0.1)  # its length is known from four gains of 5 %


# Torque gains.


GAINS = np.array([1.05, 0.96, 1.02, 1.03, 1.05, 0.99, 0.99])


@pytest.fixture(scope="module")
def misread(truth, excited) -> Design:
    robot = truth.robot
    return Design.build(
        prepare(excited.with_column("tau", GAINS * excited["tau"]), robot), robot, base_parameters(robot)
    )


def test_joints_that_disagree_tell_their_gains(misread) -> None:
    """Errors match the covariance, although not even the shape of friction is fitted yet."""
    design, _, cov = calibrated(misread, "irls")
    error = design.gains - GAINS
    assert error @ np.linalg.solve(cov, error) / 7 < 2.0
    apart = error[:4] - error[:4].mean()
    assert np.abs(apart).max() < 0.01 < np.abs(GAINS[:4] - GAINS[:4].mean()).max()
    common = design.gains  # common scale: not identifiable
    assert 1 / np.sqrt(common @ np.linalg.solve(cov, common)) == pytest.approx(GAIN_SD / np.sqrt(7), rel=0.05)
    np.testing.assert_allclose(design.tau, misread.tau / design.gains, rtol=1e-12)


def test_what_all_have_in_common_is_left_to_the_prior(misread) -> None:
    one = calibrated(misread, "wls")[0].gains
    other = calibrated(misread.with_torque(1.03 * misread.data.tau), "wls")[0].gains
    np.testing.assert_allclose(other, one, atol=2e-3)


def test_the_share_of_the_gains_is_the_derivative(misread) -> None:
    """A slightly larger gain moves the parameters as the covariance assumes."""

    def solve(design: Design) -> LinearSolution:
        rows = design.stream(np.zeros(len(design.rows), dtype=int))
        return least_squares(rows, design.layout.names, method="ols")

    found = solve(misread)
    step = np.array([0, 0, 1e-4, 0, 0, 0, 0])
    moved = solve(misread.with_gains(1.0 + step)).x - found.x
    share = gain_share(found, np.outer(step, step))
    np.testing.assert_allclose(share, np.outer(moved, moved), rtol=0.01, atol=1e-4 * np.abs(share).max())


def test_where_the_log_tells_nothing_gains_stay(misread) -> None:
    """Two base parameters with the same effect, then zero torque: gains stay 1 with their prior uncertainty."""
    alike = [A.copy() for A in misread.rigid]
    for A, columns in zip(alike, misread.layout.columns):
        at = [np.flatnonzero(columns[: A.shape[1]] == k) for k in (0, 1)]
        A[:, at[0]] = A[:, at[1]] if len(at[0]) == len(at[1]) else 0.0
        A[:, at[1]] = A[:, at[0]] if len(at[0]) == len(at[1]) else 0.0
    for blind in (replace(misread, rigid=tuple(alike)), misread.with_torque(np.zeros_like(misread.data.tau))):
        design, x, cov = calibrated(blind, "wls")
        np.testing.assert_array_equal(design.gains, np.ones(7))
        np.testing.assert_allclose(cov, GAIN_SD**2 * np.eye(7), rtol=1e-9, atol=1e-12)
        assert np.all(np.isfinite(x))


@pytest.mark.slow
def test_a_fit_of_misread_torque_reads_the_same_torque(truth, short_arm) -> None:
    """The short arm with gains of 1.05 and 0.97: they appear in the model, its covariance and its report."""
    gains, log = np.array([1.05, 0.97]), short_arm.log(1, 1500)
    fit = identify.fit_dynamics(log.with_column("tau", gains * log["tau"]), short_arm.robot, method="wls")
    plain = identify.fit_dynamics(log, short_arm.robot, method="wls")
    ratio, sd = fit.value.gains / plain.value.gains / gains, np.sqrt(np.diag(fit.value.gain_cov))
    assert np.all(np.abs(ratio - 1.0) < 2 * sd)
    p = len(fit.value.base_names)
    assert np.all(np.diag(fit.cov)[:p] >= np.diag(fit.value.base_cov))
    e = (fit.parameters - plain.parameters)[:p]
    assert e @ np.linalg.solve(fit.cov[:p, :p], e) / p < 1.0
    assert "torque gain per joint" in fit.report()
    again = identify.fit_dynamics(log, short_arm.robot, method="wls", prior=fit)
    np.testing.assert_array_equal(again.value.gains, fit.value.gains)


# The corner of the regression.


def test_the_corner_is_lower_where_acceleration_is_noisy(truth, excited) -> None:
    """The corner is low with noise, high without; parameters are then closer to the truth than with the highest one."""
    robot, base = truth.robot, base_parameters(truth.robot)
    true = base.B @ np.concatenate([truth.links.ravel(), truth.rotor])
    found = []
    for noise in (0.0, 0.03):
        qd = excited["qd"] + noise * np.random.default_rng(3).standard_normal(excited["qd"].shape)
        design = Design.build(prepare(excited.with_column("qd", qd), robot), robot, base)
        corner, why = best_cutoff(design, "wls")
        assert f"+0.0 % at {corner:g} Hz" in why
        low = Design.build(design.data, robot, base, cutoff=corner, lines=design.lines)
        errors = [np.linalg.norm(solved(one, None, "wls").x[: len(true)] - true) for one in (design, low)]
        found.append((corner, errors[1] / errors[0]))
    (high, same), (lower, better) = found
    assert high > 24.0
    assert same == 1.0
    assert lower < 13.0
    assert better < 0.6
