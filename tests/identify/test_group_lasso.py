"""Group lasso: the optimum, and the groups that matter."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.identify import GroupLasso, group_lasso, select_groups
from armlab.kernels import basis_weights
from armlab.models import speed_basis


def problem(seed: int, N: int = 60, groups: int = 5, size: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((N, groups * size)) @ np.diag(rng.uniform(0.3, 3, groups * size))
    x = np.zeros(groups * size)
    x[: 2 * size] = rng.standard_normal(2 * size)
    return A, A @ x + 0.3 * rng.standard_normal(N)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("penalty", [0.5, 5.0, 30.0])
def test_the_objective_is_that_of_an_independent_solver(seed: int, penalty: float) -> None:
    """Newton's method would stop at the corners of the norms: quadratics above them, ever closer, do not."""
    A, y = problem(seed)
    found = group_lasso(A, y, 3, penalty)
    threshold = penalty * np.sqrt(3)
    x = np.linalg.lstsq(A, y, rcond=None)[0]
    for corner in np.geomspace(1.0, 1e-10, 3000):
        norms = np.sqrt(np.sum(x.reshape(-1, 3) ** 2, axis=1) + corner**2)
        x = np.linalg.solve(A.T @ A + np.diag(np.repeat(threshold / norms, 3)), A.T @ y)
    least = 0.5 * np.sum((y - A @ x) ** 2) + threshold * np.linalg.norm(x.reshape(-1, 3), axis=1).sum()
    assert isinstance(found, GroupLasso)
    assert found.gap <= 1e-6
    assert found.objective <= least * (1 + 1e-6)
    assert found.objective == pytest.approx(least, rel=1e-5)


def test_a_large_penalty_leaves_nothing_and_a_tiny_one_is_least_squares() -> None:
    A, y = problem(0)
    largest = np.linalg.norm((A.T @ y).reshape(-1, 3), axis=1).max() / np.sqrt(3)
    assert not group_lasso(A, y, 3, 1.001 * largest).x.any()
    assert group_lasso(A, y, 3, 0.98 * largest).x.any()
    x = group_lasso(A, y, 3, 1e-7).x
    np.testing.assert_allclose(x, np.linalg.lstsq(A, y, rcond=None)[0], atol=1e-3)


@pytest.mark.slow  # 20 s
def test_three_lines_of_twelve_are_found() -> None:
    """The example of LPVSpectral.jl: amplitudes that grow, pass through a peak, and jump."""
    rng = np.random.default_rng(0)
    N, speeds = 500, 50
    X, v = np.sort(rng.uniform(0, 10, N)), np.linspace(0, 1, N)
    lines = np.arange(2.0, 26.0, 2.0)
    y = v**2 * np.cos(2 * np.pi * 2 * X) + 2 * np.exp(-5 * np.abs(v - 0.5)) * np.cos(2 * np.pi * 10 * X)
    y += np.where(v > 0.8, 0.5, 0.3) * np.cos(2 * np.pi * 20 * X) + np.sin(2 * np.pi * 20 * X)
    y += 0.1 * rng.standard_normal(N)
    psi = basis_weights(v, *speed_basis(0.0, 1.0, speeds))
    waves = [wave(2 * np.pi * c * X)[:, None] * psi for c in lines for wave in (np.cos, np.sin)]
    kept = select_groups(np.hstack(waves), y, 2 * speeds, np.arange(N) // 10)
    assert lines[kept].tolist() == [2.0, 10.0, 20.0]


def test_noise_selects_no_group() -> None:
    rng = np.random.default_rng(3)
    A, y = rng.standard_normal((300, 24)), rng.standard_normal(300)
    assert not select_groups(A, y, 4, np.arange(300) // 10).any()
    assert not select_groups(A, np.zeros(300), 4, np.arange(300) // 10).any()


def test_wrong_arguments_are_refused() -> None:
    A, y = problem(0)
    for wrong in ((A, y[:-1], 3, 1.0), (A, y, 4, 1.0), (A, y, 3, 0.0)):
        with pytest.raises(ShapeError, match="groups of equal size"):
            group_lasso(*wrong)
    y[3] = np.nan
    with pytest.raises(ShapeError, match="finite"):
        group_lasso(A, y, 3, 1.0)
