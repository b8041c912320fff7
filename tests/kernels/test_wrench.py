"""The wrench at one instant: every method against an independent solution, and the benefit of a friction bound."""

from __future__ import annotations

from itertools import product

import numpy as np
import osqp
import pytest
from scipy import sparse
from scipy.optimize import lsq_linear

from armlab import kernels, robots
from armlab.errors import ShapeError
from armlab.kernels import solve_wrench, wrench_interval

from .. import oracles
from ..oracles.wrench import METHODS

PRIOR = np.array([400.0, 400, 400, 4, 4, 4])
MAP, BOUNDED, CLIP, LS, LUND = (METHODS.index(name) for name in ("map", "bounded", "clip", "ls", "lund"))
COULOMB = 0.05 * np.array([40.0, 40, 25, 25, 10, 10, 5])  # the simulated YuMi's, N m


def problems(count: int, seed: int, stuck: float = 0.5):
    """Yield A, true wrench, bounded part, variance, bound and torque error at random poses of the YuMi."""
    robot = robots.load("yumi_left")
    rng = np.random.default_rng(seed)
    for _ in range(count):
        A = robot.chain.jacobian(rng.uniform(robot.q_min, robot.q_max))
        variance = (0.1 * COULOMB) ** 2
        bound = np.where(rng.random(7) < stuck, 1.3 * COULOMB, 0.0)
        F, d = np.sqrt(PRIOR) * rng.standard_normal(6), rng.uniform(-1, 1, 7) * bound
        yield A, F, d, variance, bound, A.T @ F + d + np.sqrt(variance) * rng.standard_normal(7)


def cost(x: np.ndarray, A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray) -> float:
    beyond = np.maximum(np.abs(error - A.T @ x) - bound, 0)
    return float(np.sum(beyond**2 / variance) + np.sum(x**2 / PRIOR))


def by_others(A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray) -> list[np.ndarray]:
    """Return the wrench from OSQP and from an active-set solver of SciPy.

    Both minimise ``(error - d)^T S^-1 (error - d)`` over |d| <= bound, with S = A^T C A + V: the cost after
    substituting the most probable wrench for a given d.
    """
    S = A.T @ (PRIOR[:, None] * A) + np.diag(variance)
    s = np.sqrt(variance)
    W = np.linalg.inv(np.linalg.cholesky(S)) * s  # unknowns in units of the noise
    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(np.triu(W.T @ W)), -W.T @ (W @ (error / s)),
        sparse.eye(7, format="csc"), -bound / s, bound / s,
        verbose=False, eps_abs=1e-10, eps_rel=1e-10, max_iter=400_000, polishing=True,
    )  # fmt: skip
    free = bound > 0
    found = np.zeros(7)
    if free.any():
        found[free] = lsq_linear(
            W[:, free], W @ (error / s), (-(bound / s)[free], (bound / s)[free]), method="bvls", tol=1e-14
        ).x
    return [PRIOR * (A @ np.linalg.solve(S, error - s * d)) for d in (solver.solve(raise_error=True).x, found)]


def test_without_a_bound_it_is_the_most_probable_wrench() -> None:
    for A, _, _, variance, _, error in problems(200, 0):
        free = solve_wrench(A, error, variance, np.zeros(7), PRIOR, BOUNDED)
        plain = solve_wrench(A, error, variance, np.zeros(7), PRIOR, MAP)
        np.testing.assert_allclose(free[0] / np.sqrt(PRIOR), plain[0] / np.sqrt(PRIOR), rtol=0, atol=1e-10)
        np.testing.assert_allclose(free[1], plain[1], rtol=0, atol=1e-8)


def test_newton_finds_the_minimum_that_a_quadratic_programme_finds() -> None:
    """300 problems: KKT below 1e-8 everywhere; two other solvers, run on 50 of them, agree within 1e-3 N."""
    iterations = []
    for k, (A, _, _, variance, bound, error) in enumerate(problems(300, 2)):
        x, _, active, rounds, kkt, _ = solve_wrench(A, error, variance, bound, PRIOR, BOUNDED)
        assert kkt < 1e-8
        assert np.array_equal(active, np.abs(error - A.T @ x) > bound)
        iterations.append(rounds)
        if k < 50:
            for other in by_others(A, error, variance, bound):
                np.testing.assert_allclose(x, other, rtol=0, atol=1e-3)
    assert np.median(iterations) <= 6
    assert max(iterations) <= 30


def test_the_clip_iteration_creeps_to_the_same_minimum() -> None:
    """Where it converges within 20000 iterations, it agrees; the median is hundreds of iterations, not a handful."""
    rounds, arrived = [], 0
    for A, _, _, variance, bound, error in problems(40, 3):
        variance = variance * 25.0  # stiff problems need a million iterations
        x, _, _, count, kkt, _ = solve_wrench(A, error, variance, bound, PRIOR, CLIP)
        best = solve_wrench(A, error, variance, bound, PRIOR, BOUNDED)[0]
        assert cost(x, A, error, variance, bound) >= cost(best, A, error, variance, bound) - 1e-9
        rounds.append(count)
        if kkt < 1e-9:
            arrived += 1
            np.testing.assert_allclose(x, best, rtol=0, atol=1e-3)
    assert arrived >= 30
    assert np.median(rounds) > 50


def test_inside_every_band_there_is_no_contact() -> None:
    A, _, _, variance, _, _ = next(problems(1, 5))
    x, P, active, *_ = solve_wrench(A, 0.9 * COULOMB, variance, COULOMB, PRIOR, BOUNDED)
    assert np.array_equal(x, np.zeros(6))
    assert not active.any()
    np.testing.assert_allclose(P, np.diag(PRIOR))


def test_least_squares_says_where_the_pose_does_not_determine_the_wrench() -> None:
    A, _, _, variance, _, error = next(problems(1, 9))
    A = A.copy()
    A[5] = A[4]
    x, P, *_, singular = solve_wrench(A, error, variance, np.zeros(7), PRIOR, LS)
    assert singular
    assert np.isnan(x).all()
    assert np.isnan(P).all()


def test_the_interval_holds_the_truth() -> None:
    """Draws with |d| <= D and |e| <= 3 s: never outside; a wider bound never gives a narrower interval."""
    rng = np.random.default_rng(10)
    box = 10 * np.sqrt(PRIOR)
    for k, (A, F, d, variance, bound, _) in enumerate(problems(600, 10)):
        s = np.sqrt(variance)
        error = A.T @ F + d + np.clip(s * rng.standard_normal(7), -3 * s, 3 * s)
        ends, violated = wrench_interval(A, error, bound + 3 * s, box)
        assert not violated.any()
        assert np.all((ends[:, 0] - 1e-9 <= F) & (ends[:, 1] + 1e-9 >= F))
        if k < 200:
            wider, _ = wrench_interval(A, error, 1.5 * bound + 3 * s, box)
            assert np.all(wider[:, 0] <= ends[:, 0] + 1e-6)
            assert np.all(wider[:, 1] >= ends[:, 1] - 1e-6)


def test_torques_that_no_wrench_explains_are_named() -> None:
    A = np.ones((1, 3))
    ends, violated = wrench_interval(A, np.array([1.0, 1.0, 5.0]), np.full(3, 0.5), np.array([10.0]))
    assert ends is None
    assert violated[2]
    assert violated.sum() <= 2


def test_nothing_in_place_of_an_array_is_refused() -> None:
    A, _, _, variance, bound, error = next(problems(1, seed=0))
    wrench = {"A": A, "error": error, "variance": variance, "bound": bound, "prior": PRIOR}
    interval = {"A": A, "error": error, "spread": bound, "box": PRIOR}
    for function, good in (((lambda **given: solve_wrench(**given, method=MAP)), wrench), (wrench_interval, interval)):
        for name in good:
            with pytest.raises(ShapeError, match=f"^Expected {name} to be an array of real numbers, got NoneType"):
                function(**{**good, name: None})


@pytest.mark.parametrize("method", range(len(METHODS)))
def test_variances_that_are_none_are_refused(method: int) -> None:
    A, _, _, variance, bound, error = next(problems(1, seed=0))
    good = {"A": A, "error": error, "variance": variance, "bound": bound, "prior": PRIOR, "method": method}
    for name, number in product(("variance", "prior", "bound"), (0.0, -1.0, np.nan, np.inf)):
        if name == "bound" and number == 0.0:
            continue
        wrong = good[name].copy()
        wrong[2] = number
        with pytest.raises(ShapeError, match=f"^Expected finite {name} .* at number 2"):
            kernels.solve_wrench(**{**good, name: wrong})


@pytest.mark.parametrize("method", range(len(METHODS)))
def test_a_torque_error_that_is_not_known_is_no_wrench_of_zero(method: int) -> None:
    A, _, _, variance, bound, error = next(problems(1, seed=0))
    error[3] = np.nan
    assert np.isnan(kernels.solve_wrench(A, error, variance, bound, PRIOR, method)[0]).all()
    ends, violated = kernels.wrench_interval(A, error, bound + 1.0, 10 * np.sqrt(PRIOR))
    assert np.isnan(ends).all()
    assert not violated.any()


def test_without_digits_left_there_is_no_wrench() -> None:
    """Seven joints, six unknowns: without noise the covariance has rank six, and its inverse has no correct digit."""
    A, _, _, variance, bound, error = next(problems(1, seed=0))
    for backend in (kernels, oracles):
        x, P, *_, singular = backend.solve_wrench(A, error, 1e-40 * variance, bound, PRIOR, MAP)
        assert singular
        assert np.isnan(x).all()
        assert np.isnan(P).all()


def test_limits_that_are_none_are_refused() -> None:
    A, _, _, _, bound, error = next(problems(1, seed=0))
    for spread, box, name in (
        (-bound - 1.0, PRIOR, "spread"),
        (bound, -PRIOR, "box"),
        (bound * np.nan, PRIOR, "spread"),
    ):
        with pytest.raises(ShapeError, match=f"^Expected finite {name}"):
            kernels.wrench_interval(A, error, spread, box)
