"""The weights whose own motion on the group of rotations is nearest to the demonstration, by Gauss and Newton.

A turn psi of the path, base axes, and a change of eta = tau_d w obey, in units of tau_d, the linearised equation

    psi' = d_eta + eta x psi,    d_eta' = alpha_z beta_z (J_l^-1(e) gamma - J_r^-1(e) psi) - alpha_z d_eta + df

with the way e to the goal, its turn gamma, and the forcing's change df. One sweep over the motion gives the slopes of
all weights, of the velocity and turn at the start, and of the goal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armlab import kernels
from armlab.errors import NotConverged
from armlab.lie import quaternion, so3
from armlab.motion._least_squares import solve
from armlab.motion._poses import exp, log
from armlab.motion.dmp import Dmp

__all__ = ["Turning", "fit_turning"]

FINE = 1000  # steps of the slopes over a duration, at least
ROUNDS = 30
ENOUGH = 1e-9  # rad of change, and relative gain of the sum of squares, that end the search
PARTS = (1.0, 0.5, 0.2, 0.05)  # of a step that are tried


@dataclass(frozen=True)
class Turning:
    """The primitive; residuals (N, 3) [rad]; covariances (3, d, d) of weights, turn of the start, velocity and turn of
    the goal, coordinate by coordinate, for samples with unit variance around each base axis."""

    dmp: Dmp
    residuals: np.ndarray
    spread: np.ndarray


def fit_turning(dmp: Dmp, t: np.ndarray, q: np.ndarray, hold: float) -> Turning:
    """Correct weights and velocity at the start until the motion is nearest to the demonstration.

    Parameters
    ----------
    dmp : first guess, of the rotation vector from the goal. t : (N,) from 0 [s]. q : (N, 4) orientations.
    hold : seconds of rest at the goal after the end, over the duration.

    Raises
    ------
    NotConverged : the search went on and on.
    """
    step = dmp.duration / (len(t) - 1)
    rest = dmp.duration + step * np.arange(1, round(hold * dmp.duration / step) + 1)
    times = np.concatenate([t, rest])
    wanted = np.concatenate([q, np.broadcast_to(q[-1], (len(rest), 4))])
    p, error = dmp.weights.size + 3, _error(dmp, times, wanted)
    for _ in range(ROUNDS):
        slopes = _slopes(dmp, times, q[-1])
        A = slopes[..., :p].reshape(-1, p)
        found = solve(A, error.reshape(-1, 1))
        square = (error**2).sum()
        for part in PARTS:
            change = part * found.x.reshape(-1, 3)
            moved = replace(dmp, weights=dmp.weights + change[:-1], v0=dmp.v0 + change[-1])
            left = _error(moved, times, wanted)
            if (left**2).sum() < square:
                break
        else:
            break
        dmp, error = moved, left
        if np.abs(A @ found.x).max() < ENOUGH or (left**2).sum() > (1.0 - ENOUGH) * square:
            break
    else:
        raise NotConverged(
            f"Expected weights nearest to the orientations within {ROUNDS} rounds, got a search that goes on. Take "
            "fewer kernels, or fit the motion in two parts.",
            dmp,
        )
    gain = (found.G @ A.T).reshape(p, -1, 3)
    return Turning(dmp, -error[: len(t)], _spread(gain, slopes, len(t)))


def _error(dmp: Dmp, times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the turns (R, 3) that lead from the motion to what is wanted, base axes [rad]."""
    goal = wanted[-1]
    start = quaternion.multiply(exp(dmp.y0), goal)
    run = kernels.rotation_rollout(dmp.primitive, times, dmp.tau_d, start, dmp.v0, goal, np.eye(3))[0]
    return log(quaternion.multiply(wanted, quaternion.conjugate(run)))


def _slopes(dmp: Dmp, times: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the turns (R, 3, 3 m + 9) of the path by weights (m, 3), velocity and turn at the start, turn of the goal.

    By the implicit midpoint rule on steps of at most a thousandth of the duration.
    """
    parts = np.ceil(np.diff(times) / (dmp.duration / FINE) * (1 - 1e-9)).astype(int)
    rows = np.concatenate([[0], np.cumsum(parts)])
    grid = np.interp(np.arange(rows[-1] + 1), rows, times)
    h = (np.diff(grid) / dmp.tau_d)[:, None, None]
    start = quaternion.multiply(exp(dmp.y0), goal)
    q, w, _ = kernels.rotation_rollout(dmp.primitive, grid, dmp.tau_d, start, dmp.v0, goal, np.eye(3))
    inverse = so3.left_jacobian_inv(log(quaternion.multiply(goal, quaternion.conjugate(q))))
    stiffness = dmp.alpha_z * dmp.beta_z
    A = np.zeros((len(grid), 6, 6))
    A[:, :3, :3], A[:, :3, 3:] = so3.hat(dmp.tau_d * w), np.eye(3)
    A[:, 3:, :3], A[:, 3:, 3:] = -stiffness * np.swapaxes(inverse, 1, 2), -dmp.alpha_z * np.eye(3)
    half = 0.25 * h * (A[1:] + A[:-1])
    ahead = np.linalg.inv(np.eye(6) - half)
    onward, push = ahead @ (np.eye(6) + half), h * ahead[:, :, 3:]
    pull = push @ (0.5 * stiffness * (inverse[1:] + inverse[:-1]))
    forcing = dmp.primitive_of(np.eye(dmp.n_basis)).forcing(dmp.phase(grid))
    forcing = 0.5 * (forcing[1:] + forcing[:-1])
    m = dmp.weights.size
    state = np.zeros((6, m + 9))
    state[3:, m : m + 3], state[:3, m + 3 : m + 6] = dmp.tau_d * np.eye(3), np.eye(3)
    found = np.empty((len(times), 3, m + 9))
    found[0], at = state[:3], 0
    for k in range(1, len(times)):
        for at in range(rows[k - 1], rows[k]):
            state = onward[at] @ state
            state[:, :m] += (forcing[at, None, :, None] * push[at, :, None, :]).reshape(6, m)
            state[:, m + 6 :] += pull[at]
        found[k] = state[:3]
    return found


def _spread(gain: np.ndarray, slopes: np.ndarray, N: int) -> np.ndarray:
    """Return the covariances for unit noise around each axis: of the unknowns, and of the pinned start and goal.

    The start and the goal are samples, whose noise shifts every row; rest is at the goal.
    """
    p, R = gain.shape[:2]
    m = p // 3 - 1
    effect = np.zeros((p + 6, N, 3))
    effect[:p] = gain[:, :N]
    effect[:p, -1] += gain[:, N:].sum(axis=1)
    whole = gain.reshape(p, -1) @ slopes[..., p:].reshape(3 * R, 6)
    effect[:p, 0] -= whole[:, :3]
    effect[:p, -1] -= whole[:, 3:]
    effect[p : p + 3, 0] = effect[p + 3 :, -1] = np.eye(3)
    order = [[*range(i, 3 * m, 3), p + i, 3 * m + i, p + 3 + i] for i in range(3)]
    effect = effect[np.concatenate(order)]
    return np.einsum("aki,bki->iab", effect, effect, optimize=True)
