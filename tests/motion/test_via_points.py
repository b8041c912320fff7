"""Via-points and final velocities: met, and nothing changes that need not."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.motion import Dmp, fit_dmp
from armlab.motion.via_points import with_via_points

U = np.linspace(0.0, 1.0, 501)
S = U**3 * (10 - 15 * U + 6 * U**2)
TIMES, POINTS = [0.3, 0.64], np.array([[0.25, -0.1], [0.5, 0.1]])


@pytest.fixture(scope="module")
def dmp() -> Dmp:
    return fit_dmp(U, np.stack([S, 0.3 * np.sin(np.pi * S)], axis=1), n_basis=20).value


def at(dmp: Dmp, t: list[float]) -> tuple[np.ndarray, np.ndarray]:
    fine = np.unique(np.r_[np.linspace(0, dmp.duration, 2001), t])
    run = dmp.rollout(fine)
    rows = np.searchsorted(fine, t)
    return run.y[rows], run.yd[rows]


def test_points_are_passed_and_ends_stay(dmp: Dmp) -> None:
    bent = with_via_points(dmp, TIMES, POINTS)
    np.testing.assert_allclose(at(bent, TIMES)[0], POINTS, rtol=0, atol=1e-9)
    long = np.linspace(0, 20, 4001)
    np.testing.assert_allclose(bent.rollout(long).y[[0, -1]], dmp.rollout(long).y[[0, -1]], rtol=0, atol=1e-9)
    velocity = with_via_points(dmp, TIMES, POINTS, [[0.0, 0.0], [1.0, 0.5]])
    for own, wanted in zip(at(velocity, TIMES), (POINTS, [[0.0, 0.0], [1.0, 0.5]])):
        np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-8)


def test_a_point_on_the_path_changes_nothing(dmp: Dmp) -> None:
    same = with_via_points(dmp, TIMES, at(dmp, TIMES)[0])
    np.testing.assert_allclose(same.rollout(U).y, dmp.rollout(U).y, rtol=0, atol=1e-9)


def test_no_other_change_that_passes_the_point_is_smaller(dmp: Dmp) -> None:
    bent = with_via_points(dmp, [0.5], [[0.6, 0.2]])
    grid = np.linspace(0.0, 1.0, 401)
    least = bent.rollout(grid).y - dmp.rollout(grid).y
    Y = dmp.primitive.response(grid, dmp.tau_d, 1e-3)[0][:, :-3]
    for other in np.random.default_rng(0).normal(size=(20, 20, 2)):
        free = other - np.outer(np.linalg.pinv(Y[[200]]), Y[200] @ other)  # does not move the point
        assert ((least + 1e-3 * Y @ free) ** 2).sum() > (least**2).sum() * (1 - 1e-6)


def test_it_ends_with_a_velocity(dmp: Dmp) -> None:
    moving = with_via_points(dmp, 1.0, dmp.g, [0.7, -0.4])
    y, yd = at(moving, [1.0])
    np.testing.assert_allclose(y[0], dmp.g, rtol=0, atol=1e-9)
    np.testing.assert_allclose(yd[0], [0.7, -0.4], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        moving.rollout(np.linspace(0, 20, 4001)).y[-1], dmp.g, atol=1e-9
    )  # and settles when it runs on


def test_bad_input_is_refused_by_a_sentence(dmp: Dmp) -> None:
    for words, call in {
        "neither": lambda: with_via_points(dmp, 0.5),
        "times": lambda: with_via_points(dmp, 1.5, dmp.g),
        "different times": lambda: with_via_points(dmp, [0.5, 0.5], POINTS),
        "finite y of shape": lambda: with_via_points(dmp, 0.5, [0.0, np.nan]),
        "yd of shape": lambda: with_via_points(dmp, 0.5, yd=[[0.0, 1.0, 2.0]]),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
    with pytest.raises(NotExcited, match="20 weights"):
        with_via_points(dmp, np.linspace(0.1, 0.9, 30), np.zeros((30, 2)))
    slow = fit_dmp(U, S, n_basis=8, schedule="position", method="acceleration").value
    with pytest.raises(ConfigError, match="phase of time"):
        with_via_points(slow, 0.5, [0.5])
