"""Fit a movement primitive of poses to a demonstration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name
from armlab.errors import ConfigError, NotConverged, ShapeError
from armlab.estimation import Fit
from armlab.lie import quaternion, so3
from armlab.motion.dmp import Dmp
from armlab.motion.pose_dmp import FRAMES, PoseDmp, exp, log, poses
from armlab.motion.primitive.demonstrations import read_demos
from armlab.motion.primitive.equation import SCALINGS, SCHEDULES
from armlab.motion.primitive.fit import fit_dmp
from armlab.motion.primitive.least_squares import solve

FARTHEST = 3.0  # rad from the goal: beyond half a turn the shorter way is another one

FINE = 1000  # steps of the slopes over a duration, at least
ROUNDS = 30
ENOUGH = 1e-9  # rad of change, and relative gain of the sum of squares, that end the search
PARTS = (1.0, 0.5, 0.2, 0.05)  # of a step that are tried


def fit_pose_dmp(
    t: ArrayLike,
    T: ArrayLike,
    *,
    n_basis: int = 50,
    schedule: str = "canonical",
    scaling: str = "goal",
    convention: str = "lund",
    frame: str = "base",
    hold: float = 0.3,
) -> Fit[PoseDmp]:
    """Fit a movement primitive of poses to one demonstration: the weights whose own motion is nearest to it.

    The position is fitted as by `fit_dmp`. For the orientation the rotation vector from the goal starts a search, by
    Gauss and Newton, for the weights with the least ``sum |log(q_demo q^-1)|^2``.

    Parameters
    ----------
    t : (N,) increasing times [s].
    T : (N, 4, 4) poses, or (N, 7): position, quaternion wxyz, each of either sign.
    n_basis, schedule, convention, hold : as of `fit_dmp`; not schedule "position".
    scaling : of the forcing with start and goal: "goal", "none", or "rotate" of the position.
    frame : axes that the forcing belongs to: "base", or "goal", with which it turns.

    Returns
    -------
    Fit of a `PoseDmp`. `residuals` (N, 6) [m, rad]; start and goal of the orientation are in the covariance as turns
    of those (4,) quaternions, base axes.

    Raises
    ------
    ShapeError : no poses, NaN with its rows, times that do not increase, an orientation half a turn from the last.
    UnknownName : options that do not exist. ConfigError : schedule "position". NotConverged : the search did not end.
    """
    check_name(schedule, "schedule", SCHEDULES)
    check_name(scaling, "scaling", SCALINGS)
    check_name(frame, "frame of the forcing", FRAMES)
    if schedule == "position":
        raise ConfigError("Expected a phase of time for poses, got schedule 'position'. Use 'canonical' or 'time'.")
    p, q = poses(T, "T")
    demo = read_demos(t, np.concatenate([p, q], axis=1), None)[0]
    way = log(quaternion.multiply(q, quaternion.conjugate(q[-1])))  # from the goal
    far = np.flatnonzero(np.linalg.norm(way, axis=1) > FARTHEST)
    if len(far):
        raise ShapeError(
            f"Expected orientations within {FARTHEST:g} rad from the last one, got {np.linalg.norm(way[far[0]]):.3g} "
            f"in row {far[0]}: half a turn away the shorter way changes sides. Fit the motion in two parts."
        )
    options: dict[str, Any] = {"n_basis": n_basis, "schedule": schedule, "convention": convention, "hold": hold}
    position = fit_dmp(demo.t, p, scaling=scaling, **options)
    turning = "goal" if scaling == "goal" else "none"
    linear = fit_dmp(demo.t, way, scaling=turning, **options)
    found = fit_turning(linear.value, demo.t, q, hold)
    value = PoseDmp(position.value, found.dmp, q[-1], frame)
    return _fit(value, position, linear, found)


def _fit(value: PoseDmp, position: Fit[Dmp], linear: Fit[Dmp], found: Turning) -> Fit[PoseDmp]:
    dof = len(found.residuals) * (linear.sigma**2).clip(min=1e-300) / (linear.residuals**2).sum(axis=0).clip(min=1e-300)
    sigma = np.sqrt((found.residuals**2).mean(axis=0) * dof)
    a, b = len(position.parameters), len(linear.parameters)
    cov = np.zeros((a + b, a + b))
    cov[:a, :a], cov[a:, a:] = position.cov, np.tensordot(sigma**2, found.spread, 1)
    dmp = found.dmp
    parameters = np.concatenate([dmp.weights, [dmp.y0], [dmp.v0], [dmp.g]]).T.ravel()
    return Fit(
        value=value,
        names=tuple(
            f"{part}: {name}" for part, fit in (("position", position), ("rotation", linear)) for name in fit.names
        ),
        units=tuple(
            unit.replace("unit of y", own) for own, fit in (("m", position), ("rad", linear)) for unit in fit.units
        ),
        parameters=np.concatenate([position.parameters, parameters]),
        cov=cov,
        sigma=np.concatenate([position.sigma, sigma]),
        residuals=np.concatenate([position.residuals, found.residuals], axis=1),
        n=position.n,
        excitation=position.excitation,
        summary=_report,
        classes=tuple(
            f"{what} {axis} [{unit}]" for what, unit in (("position", "m"), ("rotation", "rad")) for axis in "xyz"
        ),
    )


def _report(fit: Fit[PoseDmp]) -> str:
    value, squares = fit.value, fit.residuals.reshape(-1, 2, 3) ** 2
    rmse = np.sqrt(squares.sum(axis=2).mean(axis=0))
    head = (
        f"Movement primitive of poses with {value.position.n_basis} kernels, schedule {value.position.schedule!r}, "
        f"scaling {value.position.scaling!r}, forcing in the axes of the {value.frame}."
    )
    return "\n".join([head, f"RMSE of the motion: {rmse[0]:.3g} m, {rmse[1]:.3g} rad", fit.table()])


@dataclass(frozen=True)
class Turning:
    """The primitive; residuals (N, 3) [rad]; covariances (3, d, d) of weights, turn of the start, velocity and turn of
    the goal, coordinate by coordinate, for samples with unit variance around each base axis."""

    dmp: Dmp
    residuals: np.ndarray
    spread: np.ndarray


def fit_turning(dmp: Dmp, t: np.ndarray, q: np.ndarray, hold: float) -> Turning:
    """Correct weights and start velocity of a first guess until its motion is nearest to orientations q (N, 4).

    Gauss-Newton on the group of rotations. A turn psi of the path, base axes, and a change of eta = tau_d w obey, in
    units of tau_d, the linearised equation

        psi' = d_eta + eta x psi,    d_eta' = alpha_z beta_z (J_l^-1(e) gamma - J_r^-1(e) psi) - alpha_z d_eta + df

    with the way e to the goal, its turn gamma, and the forcing's change df. One sweep over the motion gives the slopes
    of all weights, of the velocity and turn at the start, and of the goal. `hold` is the rest at the goal after the
    end, over the duration.
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
