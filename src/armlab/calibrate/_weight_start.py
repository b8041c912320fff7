"""Starts that contacts do not spoil, and the other answer that readings of small tilts almost fit."""

from __future__ import annotations

import numpy as np

from armlab.calibrate._weight_equation import Equation, Load
from armlab.lie import so3

ROUNDS = 50
SETTLED = 1e-3  # change of weights, relative to the largest
SHORT = 1e-3  # of the median residual: below it a residual is none
FAR = 4.0  # medians from which a residual is left out of the start
NULL = 1e-9
ALIKE = 0.5  # mean of the weight over the tool, relative to the weight, above which the twin is a minimum too


def likely(equation: Equation) -> np.ndarray:
    """Return which samples (N,) a start should use: those near the regression of least absolute residuals.

    Forces are linear in the orientation of the tool, ``f_i = sum_k c_k (R_i)_k + b`` (in gravity over the tool where it
    is known). ``sum |r_i|`` has one minimum wherever one begins, and a contact does not pull it.
    """
    X = equation.RA.reshape(equation.N, 9) if equation.pull is None else equation.pull @ equation.RA
    if equation.bias:
        X = np.hstack([X - X.mean(axis=0), np.ones((equation.N, 1))])
    U, size, _ = np.linalg.svd(X, full_matrices=False)
    Q, f, w = U[:, size > NULL * size[0]], equation.y[:, :3], np.ones(equation.N)
    r = w
    if 2 * Q.shape[1] > equation.N:  # it would go through half of the samples, whichever they are
        return np.ones(equation.N, dtype=bool)
    for _ in range(ROUNDS):
        weighted = Q.T * w
        r = np.linalg.norm(f - Q @ np.linalg.lstsq(weighted @ Q, weighted @ f, rcond=None)[0], axis=1)
        before, w = w, 1.0 / np.maximum(r, max(SHORT * float(np.median(r)), np.finfo(float).tiny))
        w = w / w.max()
        if np.abs(w - before).max() < SETTLED:
            break
    return r <= FAR * np.median(r)


def twin(equation: Equation, load: Load) -> Load | None:
    """Return the load with its weight reversed and the sensor turned by half a turn about it.

    Both read the same to first order in tilts: ``R^T (u x w) = (H R)^T (-u x w)`` with H the half turn about u; the
    bias takes the mean. None where tilts are large, or there is no bias: nothing is alike then.
    """
    u = load.gamma @ equation.RA.mean(axis=0)
    length = float(np.linalg.norm(u))
    if not equation.bias or length <= ALIKE * np.linalg.norm(load.gamma):
        return None
    R, gamma = so3.exp(np.pi * u / length) @ load.R, -load.gamma
    expected = gamma @ (equation.RA @ R)
    if equation.torque:
        expected = np.hstack([expected, np.cross(load.centre, expected)])
    return Load(R, gamma, np.median(equation.y - expected, axis=0), load.centre)
