"""Gains of the torques: what a joint calls one newton metre may be a few percent more or less.

Base parameters are shared by all joints, so joints whose torque constants are off contradict each other, and the misfit
goes to wrong places. ``tau_i = g_i (A_i theta + e_i)`` with ``g_i ~ N(1, 0.05^2)`` is solved by Gauss-Newton
(`armlab.identify.gains`). What all gains have in common no log of the arm alone can tell: that is left to the prior,
and so it is for joints that move hardly any load of their own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armlab.estimation import LinearSolution
from armlab.identify.design import Design
from armlab.identify.gains import GainProblem
from armlab.identify.settling import solved

__all__ = ["GAIN_SD", "calibrated", "gain_share"]

GAIN_SD = 0.05
ROUNDS = 2  # weights of the joints follow their gains
MAX_CONDITION = 1e4  # of a log that tells the parameters


def calibrated(
    design: Design, method: str, known: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[Design, np.ndarray, np.ndarray]:
    """Return a design with the gains of its torques, its parameters (p,), and the covariance (J, J) of the gains.

    Where the log does not tell the parameters, the gains stay what they are: the last fit judges.

    Parameters
    ----------
    design : without slopes. method : of `fit_dynamics`.
    known : gains (n,) and their covariance (n, n) of an earlier fit, which stay.
    """
    if known is not None:
        gains, cov = known[0][design.joints], known[1][np.ix_(design.joints, design.joints)]
        design = design.with_gains(gains)
        return design, solved(design, None, method).x, cov
    cov = GAIN_SD**2 * np.eye(len(design.joints))
    for _ in range(ROUNDS):
        solution = solved(design, None, method)
        if not solution.excitation.condition < MAX_CONDITION:
            return design, solution.x, cov
        problem = GainProblem.of(_read(solution, design.gains), design.residuals(solution.x), design.gains - 1, GAIN_SD)
        x, g = problem.solve()
        design, cov = design.with_gains(1.0 + g), problem.gain_covariance(x, g)
    return design, solved(design, None, method).x, cov


def _read(solution: LinearSolution, gains: np.ndarray) -> LinearSolution:
    """Return the solution with the factors of the torque as it was read: both sides times the gains."""
    factors = replace(solution.factors, R=tuple(k * R for k, R in zip(gains, solution.factors.R)))
    return replace(solution, factors=factors, weights=solution.weights / gains)


def gain_share(solution: LinearSolution, gain_cov: np.ndarray) -> np.ndarray:
    """Return what unknown gains add to the covariance (p, p) of the parameters.

    A gain that is g too large leaves a torque that is g too small: ``dx = -sum_i (A^T W A)^-1 w_i^2 A_i^T y_i g_i``.

    Parameters
    ----------
    solution : of torques divided by their gains. gain_cov : (J, J) of the gains.
    """
    pushed = np.zeros((len(solution.x), len(gain_cov)))
    parts = zip(solution.factors.R, solution.factors.columns, solution.weights)
    for i, (R, columns, weight) in enumerate(parts):
        kept = R[solution.kept]
        pushed[columns, i] = weight**2 * np.einsum("bka,bk->a", kept[:, :, :-1], kept[:, :, -1])
    response = solution.basis @ (solution.basis.T @ pushed)
    cov = response @ gain_cov @ response.T
    return 0.5 * (cov + cov.T)
