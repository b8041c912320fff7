"""The most likely load in closed form: forces of a known gravity, noise the same along all axes."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from armlab.calibrate._weight_equation import ROUNDING, Equation, Load
from armlab.estimation import NonlinearSolution

NOTHING = np.zeros(3)


class Found(NamedTuple):
    """A fit of readings: see `estimation.NonlinearSolution`; residuals (N, k) of all samples."""

    load: Load
    cov: np.ndarray
    sigma: np.ndarray
    outliers: np.ndarray
    residuals: np.ndarray
    cost: float
    freedom: int
    unseen: int
    rows: np.ndarray | None

    @classmethod
    def of(cls, equation: Equation, found: NonlinearSolution[Load]) -> Found:
        """Return what the solver found."""
        residuals = equation.evaluate(found.value)[0].r
        return cls(
            found.value,
            found.cov,
            found.sigma,
            found.outliers,
            residuals,
            found.cost,
            found.freedom,
            found.null.shape[1],
            found.rows.J,
        )

    def jacobian(self, equation: Equation) -> np.ndarray:
        """Return the whitened Jacobian (M, d) of the samples kept."""
        if self.rows is not None:
            return self.rows
        (one,) = equation.evaluate(self.load)
        J = one.J.reshape(-1, len(self.cov))
        return J / np.sqrt(_variance(equation, float(self.sigma[0])))


def is_closed(equation: Equation) -> bool:
    """Tell whether the closed form is the most likely load."""
    noise = equation.noise
    same = noise is None or (noise.ndim == 1 and bool(noise[0] == noise[1] == noise[2]))
    return same and equation.pull is not None and not equation.torque


def closed_form(equation: Equation) -> Found:
    """Return the most likely load; only where `is_closed`."""
    turn, N = equation.turn, equation.N
    freedom = 3 * N - sum(equation.widths.values())
    sigma = sqrt(turn.power / freedom)
    variance = _variance(equation, sigma)
    load = Load(turn.R, turn.m * (NOTHING if equation.pull is None else equation.pull), turn.bias, NOTHING)
    none, cost = np.zeros(N, dtype=bool), 0.5 * turn.power / variance
    return Found(load, variance * turn.cov, np.array([sigma]), none, turn.residuals, cost, freedom, 0, None)


def _variance(equation: Equation, sigma: float) -> float:
    if equation.noise is not None:
        return float(equation.noise[0])
    return max(sigma, ROUNDING * (float(np.abs(equation.y).max()) or 1.0)) ** 2
