"""Objectives for the joints that a task leaves free (specification; the compiled twin is native/objective.h)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from armlab.kernels._reference.chain import Chain
    from armlab.kernels._reference.descent import Goal, Iterate

__all__ = ["Objective", "value_and_gradient"]

NONE, POSTURE, LIMITS, MANIPULABILITY = range(4)
TIE = 1e-3  # of the sum of squares in the objective LIMITS
_Value = tuple[float, np.ndarray]


class Objective(NamedTuple):
    """What is made least: 0 nothing, 1 posture, 2 limits, 3 manipulability; reference and scale (n,) of 1 and 2."""

    kind: int
    reference: np.ndarray
    scale: np.ndarray


def value_and_gradient(
    chain: Chain, goal: Goal, weight: float, objective: Objective, sharpness: float, at: Iterate
) -> _Value:
    """Return an objective and its gradient (n,) at a posture.

    With ``x = scale (q - reference)``: posture is ``sum of x^2 / 2``; limits is the largest ``|x|`` made smooth,
    ``log(sum of exp(s x) + exp(-s x)) / s`` with the sharpness s, and a little of the sum of squares for the joints
    that are not the nearest to their limits; manipulability is ``-log(det(J J^T)) / 2`` of the rows of the task.

    Parameters
    ----------
    chain, goal, weight, at : as in `descent.Descent`.
    objective : which.
    sharpness : s.
    """
    if objective.kind == MANIPULABILITY:
        return _manipulability(chain, goal, weight, at)
    x = objective.scale * (at.q - objective.reference)
    squares = float(x @ x) / 2.0
    if objective.kind == POSTURE:
        return squares, objective.scale * x
    largest = np.abs(x).max()
    up, down = np.exp(sharpness * (x - largest)), np.exp(sharpness * (-x - largest))
    total = np.sum(up + down)
    gradient = objective.scale * ((up - down) / total + TIE * x)
    return float(largest + np.log(total) / sharpness + TIE * squares), gradient


def _manipulability(chain: Chain, goal: Goal, weight: float, at: Iterate) -> _Value:
    """``d/dq_k = -tr((J J^T)^-1 dJ/dq_k J^T)``; rows across the tool's axis turn with the tool."""
    T, J = chain.forward_jacobian(at.q)
    dJ = chain.jacobian_derivative(np.broadcast_to(at.q, (chain.n, chain.n)), np.eye(chain.n))  # by joint
    rows = []
    if goal.has_position:
        rows.append(weight * dJ[:, :3])
    if goal.task == 6:
        rows.append(dJ[:, 3:])
    if goal.has_axis:
        across = goal.across @ T[:3, :3].T
        turning = np.cross(J[3:].T[:, None], across)  # w_k x u
        rows.append(across @ dJ[:, 3:] + turning @ J[3:])
    normal = at.J @ at.J.T
    sign, logarithm = np.linalg.slogdet(normal)
    if sign <= 0:
        return np.inf, np.zeros(chain.n)
    G = np.linalg.solve(normal, at.J)
    return -float(logarithm) / 2.0, -np.einsum("kaj,aj->k", np.concatenate(rows, axis=1), G)
