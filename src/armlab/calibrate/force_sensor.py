"""Calibration of a force sensor by the weight that hangs on it: axes, mass, centre of mass and bias.

    f_i = s m R^T R_base_tool,i^T g + b_f,        tau_i = c x (f_i - b_f) + b_tau,        R = R_tool_sensor

Known gravity and forces alone have a closed form, which is the most likely value; torques sharpen the rotation, and
everything is then fitted together. Umeyama (1991) for the closed form.
"""

from __future__ import annotations

from math import hypot
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.calibrate._arguments import covariance, finite, gravity_of, orientations
from armlab.calibrate._weight_equation import Equation, Load
from armlab.calibrate._weight_fit import fit_weight
from armlab.calibrate._weight_words import STANDARD, limits_of
from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.models import ForceSensor

__all__ = ["fit_force_sensor"]

LIMITS = (0.2, 0.3, 0.1)
UNKNOWN = np.full(3, np.nan)
CLASSES = ("force [N]",) * 3 + ("torque [N m]",) * 3


def fit_force_sensor(
    T_base_tool: ArrayLike,
    wrench: ArrayLike,
    *,
    gravity: ArrayLike | Literal["unknown"] = (0.0, 0.0, -STANDARD),
    sign: int = 1,
    bias: bool = True,
    mass: float | None = None,
    noise: ArrayLike | None = None,
    robust: bool = False,
    limits: tuple[float, float, float] = LIMITS,
) -> Fit[ForceSensor]:
    """Find axes, load and bias of a force sensor from its readings at rest in many orientations of the tool.

    Parameters
    ----------
    T_base_tool : (N, 4, 4) poses of the tool, or (N, 3, 3) its orientations, without contact.
    wrench : (N, 3) forces, or (N, 6) forces and torques, raw, sensor axes [N, N m].
    gravity : (3,) base axes [m/s^2], or "unknown": then the weight in base axes is found with the rest.
    sign : +1 when the sensor reads the weight that hangs on it, -1 when it reads the reaction.
    bias : whether readings without weight may differ from zero.
    mass : what hangs on the sensor [kg], where it is known.
    noise : standard deviation of the force [N]; with torques (sd of force [N], of torque [N m]); or covariance (k, k)
        or (N, k, k). Estimated when left out.
    robust : find samples with contact; `Fit.outliers` marks them, and they do not count.
    limits : largest standard deviation accepted along any direction: angle [rad], share of the weight, length [m].

    Returns
    -------
    Fit of a `models.ForceSensor`. Parameters: rotation vector of R_tool_sensor (covariance of R Exp(w), sensor axes),
    mass or weight, bias, centre of mass. `centre` and the moments of `bias` are NaN where no torques were measured.

    Raises
    ------
    ShapeError : another shape, NaN rows, no rotations, a gravity, sign or mass that cannot be.
    NotExcited : too few samples; a direction that the orientations do not tell, in words.
    NotConverged : an axis mirrored or the sign reversed (`reason` "left_handed"); readings that do not follow gravity.

    References
    ----------
    Umeyama, PAMI 13(4), 1991.
    """
    RA, note = orientations(T_base_tool, "T_base_tool")
    y = _readings(wrench, len(RA))
    if sign not in (1, -1) or isinstance(sign, bool):
        raise ShapeError(f"Expected the sign +1 or -1 of a force sensor, got {sign!r}. +1 reads the weight.")
    pull = None if isinstance(gravity, str) and gravity == "unknown" else sign * gravity_of(gravity)
    if mass is not None and (pull is None or not 0.0 < float(numbers(mass, "mass", ShapeError)) < np.inf):
        raise ShapeError(
            f"Expected a mass above zero [kg] together with a known gravity, got {mass!r} with gravity {gravity!r}. "
            "Leave one of them out."
        )
    equation = Equation(
        RA, y, pull, bool(bias), None if mass is None else float(mass), _noise(noise, y.shape), CLASSES[: y.shape[1]],
        "force sensor",
    )  # fmt: skip

    def value(load: Load) -> ForceSensor:
        weight = hypot(*load.gamma.tolist())
        found = weight / (STANDARD if pull is None else hypot(*pull.tolist()))
        g = sign * (load.gamma / found if pull is None else pull)
        moments = (load.centre, load.bias) if equation.torque else (UNKNOWN, np.append(load.bias, UNKNOWN))
        return ForceSensor(load.R, found, *moments, sign=sign, gravity=g)

    return fit_weight(equation, value, limits_of(limits), robust, [note])


def _readings(wrench: ArrayLike, N: int) -> np.ndarray:
    y = numbers(wrench, "wrench", ShapeError)
    if y.ndim != 2 or y.shape[1] not in (3, 6) or len(y) != N:
        raise ShapeError(
            f"Expected readings of shape ({N}, 3) or ({N}, 6), one per pose, forces first, got {y.shape}. "
            "Pair them by their time first."
        )
    finite(y, "wrench")
    return y


def _noise(noise: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return variances (k,), or covariance (k, k) or (N, k, k); None for None."""
    if noise is None:
        return None
    N, k = shape
    values = numbers(noise, "noise", ShapeError)
    if values.ndim == 0 and k == 3 and 0 < values < np.inf:
        return np.full(3, float(values) ** 2)
    if values.shape == (2,) and k == 6 and np.all(values > 0) and np.isfinite(values).all():
        return np.repeat(values**2, 3)
    if values.shape not in ((k, k), (N, k, k)) or not np.isfinite(values).all():
        usual = "one standard deviation above zero [N]" if k == 3 else "(sd of force [N], sd of torque [N m])"
        raise ShapeError(
            f"Expected noise as {usual}, or as a covariance ({k}, {k}) or ({N}, {k}, {k}), got {noise!r}. Correct it."
        )
    return covariance(values, "noise")
