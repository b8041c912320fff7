"""From a demonstration of poses to a movement primitive."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import check_name
from armlab.errors import ConfigError, ShapeError
from armlab.estimation import Fit
from armlab.lie import quaternion
from armlab.motion._basis import SCHEDULES
from armlab.motion._demos import read_demos
from armlab.motion._equation import SCALINGS
from armlab.motion._poses import log, poses
from armlab.motion._rotation_fit import Turning, fit_turning
from armlab.motion.dmp import Dmp
from armlab.motion.fit import fit_dmp
from armlab.motion.pose_dmp import FRAMES, PoseDmp

__all__ = ["fit_pose_dmp"]

FARTHEST = 3.0  # rad from the goal: beyond half a turn the shorter way is another one


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
