"""Calibration of an accelerometer on the tool by gravity: axes, bias, scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.calibrate._arguments import finite, gravity_of, orientations, point_noise
from armlab.calibrate._weight_equation import Equation, Load
from armlab.calibrate._weight_fit import fit_weight
from armlab.calibrate._weight_words import STANDARD, limits_of
from armlab.calibrate.force_sensor import LIMITS
from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.models import Accelerometer

__all__ = ["fit_accelerometer"]


def fit_accelerometer(
    T_base_tool: ArrayLike,
    acc: ArrayLike,
    *,
    scale: bool = False,
    gravity: ArrayLike = (0.0, 0.0, -STANDARD),
    noise: ArrayLike | None = None,
    robust: bool = False,
    limits: tuple[float, float] = LIMITS[:2],
) -> Fit[Accelerometer]:
    """Find axes and bias of an accelerometer from its readings at rest in many orientations of the tool.

        y_i = -scale R_tool_sensor^T R_base_tool,i^T g + b

    Parameters
    ----------
    T_base_tool : (N, 4, 4) poses of the tool, or (N, 3, 3) its orientations, at rest.
    acc : (N, 3) readings, sensor axes [m/s^2]; upwards at rest.
    scale : find the scale of the readings too; it is 1 otherwise.
    gravity : (3,) base axes [m/s^2].
    noise : standard deviation [m/s^2], or covariance (3, 3) or (N, 3, 3). Estimated when left out.
    robust : find samples that were not at rest; `Fit.outliers` marks them, and they do not count.
    limits : largest standard deviation accepted along any direction: angle [rad], share of gravity.

    Returns
    -------
    Fit of a `models.Accelerometer`. Parameters: rotation vector of R_tool_sensor (covariance of R Exp(w), sensor axes),
    scale where it is asked for, bias.

    Raises
    ------
    ShapeError : another shape, NaN rows, no rotations.
    NotExcited : too few samples; a direction that the orientations do not tell, in words.
    NotConverged : an axis mirrored or the sign reversed (`reason` "left_handed"); readings that do not follow gravity.
    """
    RA, note = orientations(T_base_tool, "T_base_tool")
    y = numbers(acc, "acc", ShapeError)
    if y.shape != (len(RA), 3):
        raise ShapeError(
            f"Expected readings of shape ({len(RA)}, 3), one per pose, got {y.shape}. Pair them by their time first."
        )
    finite(y, "acc")
    g = gravity_of(gravity)
    cov = point_noise(noise, (len(RA),))
    equation = Equation(
        RA, y, -g, True, None if scale else 1.0, cov, ("acceleration [m/s^2]",) * 3, "accelerometer"
    )  # fmt: skip

    def value(load: Load) -> Accelerometer:
        size = float(np.linalg.norm(load.gamma) / np.linalg.norm(g)) if scale else 1.0
        return Accelerometer(load.R, load.bias, size, g)

    return fit_weight(equation, value, limits_of((*limits, 1.0)), robust, [note], scale="scale")
