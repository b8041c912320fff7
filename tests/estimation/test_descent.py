"""Gauss-Newton with damping: textbook problems, and what it does at the end of its means."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotConverged
from armlab.estimation import Measurement, NonlinearProblem
from armlab.estimation.nonlinear import Descent, descend


def problem(residual, jacobian, **options) -> NonlinearProblem[np.ndarray]:
    def evaluate(x: np.ndarray) -> list[Measurement]:
        return [Measurement(residual(x)[:, None], jacobian(x)[:, None, :], np.eye(1), ("r",))]

    return NonlinearProblem(evaluate, lambda x, step: x + step, **options)


def rosenbrock() -> NonlinearProblem[np.ndarray]:
    return problem(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
    )


def test_rosenbrock_from_the_usual_start() -> None:
    found = descend(rosenbrock(), np.array([-1.2, 1.0]), {}, np.ones(2))
    assert isinstance(found, Descent)
    np.testing.assert_allclose(found.value, 1.0, rtol=1e-9)
    assert np.all(np.diff(found.history) < 0)
    np.testing.assert_allclose(found.basis.T @ found.rows.J.T @ found.rows.J @ found.basis, np.eye(2), atol=1e-9)


def test_a_linear_problem_takes_one_step() -> None:
    A = np.random.default_rng(0).standard_normal((20, 3))
    found = descend(problem(lambda x: A @ x - 1.0, lambda x: A), np.zeros(3), {}, np.ones(20))
    assert len(found.history) == 2
    np.testing.assert_allclose(found.value, np.linalg.lstsq(A, np.ones(20), rcond=None)[0], rtol=1e-12)


def test_what_the_data_do_not_see_stays_and_is_reported() -> None:
    """Only x + 2 y is measured: the smallest step in units of the scale, and the other direction in `null`."""
    see = problem(lambda x: np.array([x[0] + 2 * x[1] - 5.0]), lambda x: np.array([[1.0, 2.0]]), scale=np.ones(2))
    found = descend(see, np.zeros(2), {}, np.ones(1))
    np.testing.assert_allclose(found.value, [1.0, 2.0])
    np.testing.assert_allclose(np.abs(found.null[:, 0]), np.array([2.0, 1.0]) / np.sqrt(5))
    assert found.basis.shape == (2, 1)


def test_iterations_end_with_the_best_value_and_history() -> None:
    with pytest.raises(NotConverged, match="after 3 iterations") as caught:
        descend(rosenbrock(), np.array([-1.2, 1.0]), {}, np.ones(2), iterations=3)
    assert caught.value.best.shape == (2,)
    assert len(caught.value.history) == 3
    loose = descend(rosenbrock(), np.array([-1.2, 1.0]), {}, np.ones(2), iterations=3, strict=False)
    np.testing.assert_array_equal(loose.value, caught.value.best)


def test_a_wrong_jacobian_does_not_pass_for_a_minimum() -> None:
    wrong = problem(lambda x: np.array([x[0] - 3.0, x[1]]), lambda x: -np.eye(2))
    with pytest.raises(NotConverged):
        descend(wrong, np.zeros(2), {}, np.ones(2))


def test_exact_data_end_at_the_rounding_floor() -> None:
    A = np.random.default_rng(0).standard_normal((20, 3)) * [1e3, 1.0, 1.0]
    tight = problem(lambda x: 1e9 * (A @ x - A @ np.ones(3)), lambda x: 1e9 * A)
    np.testing.assert_allclose(descend(tight, np.zeros(3), {}, np.ones(20)).value, 1.0, rtol=1e-12)
