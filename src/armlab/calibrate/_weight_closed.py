"""The most likely load in closed form with its covariance: forces of a known gravity, noise the same along all axes.

Centred, rotation, mass and bias do not mix (u x u = 0), with u_i = R^T R_i^T gamma and v_i that of one unit of mass:

    C_w = s^2 (sum |u|^2 1 - u u^T)^-1,    C_m = s^2 / sum |v|^2,    b = b_0 - mean(hat(u)) w - mean(v) m
"""

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
    v = equation.seen @ turn.R
    r = equation.y - turn.m * v
    bias = r.sum(axis=0) / N if equation.bias else NOTHING
    r -= bias
    power, freedom = float(np.vdot(r, r)), 3 * N - sum(equation.widths.values())
    sigma = sqrt(power / freedom)
    variance = _variance(equation, sigma)
    load = Load(turn.R, turn.m * (NOTHING if equation.pull is None else equation.pull), bias, NOTHING)
    cov = _covariance(equation, variance, v.sum(axis=0) / N)
    none = np.zeros(N, dtype=bool)
    return Found(load, cov, np.array([sigma]), none, r, 0.5 * power / variance, freedom, 0, None)


def _variance(equation: Equation, sigma: float) -> float:
    if equation.noise is not None:
        return float(equation.noise[0])
    return max(sigma, ROUNDING * (float(np.abs(equation.y).max()) or 1.0)) ** 2


def _covariance(equation: Equation, variance: float, mean: np.ndarray) -> np.ndarray:
    """Return the covariance (d, d) of rotation, mass and bias, as far as they are sought.

    Parameters
    ----------
    variance : of a force. mean : (3,) of v.
    """
    turn, free = equation.turn, 3 + (equation.mass is None)
    squares, axes = equation.moved
    V = turn.R.T @ axes
    C = np.zeros((free, free))
    total = float(squares.sum())
    each = variance / equation.N
    m2 = max(turn.m * turn.m, np.finfo(float).tiny)  # no weight at all is told by its deviation
    C[:3, :3] = V * (each / m2 / (total - squares)) @ V.T
    if free == 4:
        C[3, 3] = each / total
    if not equation.bias:
        return C
    (a, b, c), m = mean.tolist(), turn.m
    A = np.array([[0.0, -m * c, m * b, a], [m * c, 0.0, -m * a, b], [-m * b, m * a, 0.0, c]])[:, :free]
    cov, B = np.empty((free + 3, free + 3)), -A @ C
    cov[:free, :free], cov[free:, :free], cov[:free, free:] = C, B, B.T
    cov[free:, free:] = each * np.eye(3) - B @ A.T
    return cov
