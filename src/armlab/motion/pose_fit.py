"""From a demonstration of poses to a movement primitive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.estimation import Fit
from armlab.lie import quaternion
from armlab.motion._demos import read_demos
from armlab.motion._least_squares import solve
from armlab.motion._poses import exp, log, poses
from armlab.motion.dmp import Dmp
from armlab.motion.fit import fit_dmp
from armlab.motion.pose_dmp import FRAMES, PoseDmp

__all__ = ["fit_pose_dmp"]

FINE = 1000  # steps of the response over a duration, at least
FARTHEST = 3.0  # rad from the goal: beyond half a turn the shorter way is another one
SWEEPS = 50
ENOUGH = 1e-9  # rad of change in a sweep


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

    The position is fitted as by `fit_dmp`. For the orientation the rotation vector from the goal starts a search: the
    angle between demonstration and motion, base axes, goes through the linear response of the weights, until a sweep
    changes nothing.

    Parameters
    ----------
    t : (N,) increasing times [s].
    T : (N, 4, 4) poses, or (N, 7): position, quaternion wxyz, each of either sign.
    n_basis, schedule, convention, hold : as of `fit_dmp`; not schedule "position".
    scaling : of the forcing with start and goal: "goal", "none", or "rotate" of the position.
    frame : axes that the forcing belongs to: "base", or "goal", with which it turns.

    Returns
    -------
    Fit of a `PoseDmp`. `residuals` (N, 6) [m, rad]; the covariance of the orientation is that of the linear
    response, with its start and goal as turns of those (4,) quaternions, base axes.

    Raises
    ------
    ShapeError : no poses, NaN with its rows, times that do not increase, an orientation half a turn from the last.
    UnknownName : options that do not exist. ConfigError : schedule "position".
    """
    if schedule == "position":
        raise ConfigError("Expected a phase of time for poses, got schedule 'position'. Use 'canonical' or 'time'.")
    if frame not in FRAMES:
        raise UnknownName.among("frame of the forcing", frame, FRAMES)
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
    found = _turned(linear.value, demo.t, q, hold)
    value = PoseDmp(position.value, found.dmp, q[-1], frame)
    return _fit(value, position, linear, found)


@dataclass(frozen=True)
class _Turned:
    """The primitive of orientations, and its residuals (N, 3) [rad]."""

    dmp: Dmp
    residuals: np.ndarray


def _turned(dmp: Dmp, t: np.ndarray, q: np.ndarray, hold: float) -> _Turned:
    """Correct weights and velocity at the start until the motion on the group is nearest to the demonstration."""
    N, step = len(t), dmp.duration / (len(t) - 1)
    rest = dmp.duration + step * np.arange(1, round(hold * dmp.duration / step) + 1)
    times = np.concatenate([t, rest])
    wanted = np.concatenate([q, np.broadcast_to(q[-1], (len(rest), 4))])
    Y, _ = dmp.primitive.response(times, dmp.tau_d, dmp.duration / FINE * (1 + 1e-9))
    A = np.delete(Y[:, :-1], -2, axis=1)  # weights and velocity: start and goal are those of the demonstration
    estimator = solve(A, np.zeros((len(A), 3))).G @ A.T
    best, least = dmp, np.inf
    residuals = np.zeros((N, 3))
    for _ in range(SWEEPS):
        w = kernels.rotation_rollout(
            dmp.primitive, times, dmp.tau_d, quaternion.multiply(exp(dmp.y0), q[-1]), dmp.v0, q[-1], np.eye(3)
        )[0]
        error = log(quaternion.multiply(wanted, quaternion.conjugate(w)))
        square = float((error**2).sum())
        if square >= least:
            break
        best, least, residuals = dmp, square, -error[:N]
        change = estimator @ error
        if np.abs(A @ change).max() < ENOUGH:
            break
        dmp = replace(dmp, weights=dmp.weights + change[:-1], v0=dmp.v0 + change[-1])
    return _Turned(best, residuals)


def _fit(value: PoseDmp, position: Fit[Dmp], linear: Fit[Dmp], found: _Turned) -> Fit[PoseDmp]:
    dof = len(found.residuals) * (linear.sigma**2).clip(min=1e-300) / (linear.residuals**2).sum(axis=0).clip(min=1e-300)
    sigma = np.sqrt((found.residuals**2).mean(axis=0) * dof)
    a, b = len(position.parameters), len(linear.parameters)
    each = np.repeat(sigma / np.where(linear.sigma > 0, linear.sigma, 1.0), b // 3)
    cov = np.zeros((a + b, a + b))
    cov[:a, :a], cov[a:, a:] = position.cov, linear.cov * np.outer(each, each)
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
        excitation=lambda: position.excitation,
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
