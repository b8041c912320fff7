"""Gravity calibration of force sensors (axes, bias, mass, centre of mass) and accelerometers (axes, bias, scale).

    f_i = s m R^T R_base_tool,i^T g + b_f,        tau_i = c x (f_i - b_f) + b_tau,        R = R_tool_sensor

For forces with known gravity, the maximum-likelihood solution has a closed form (Umeyama 1991). All parameters are then
fitted jointly, so torques also refine the rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import hypot
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.calibrate.diagnostics import ANGLE_WEIGHT_LENGTH, doubts_of, limits_of, require_most
from armlab.calibrate.gravity_load.diagnostics import (
    MANY,
    STANDARD,
    LoadUnknowns,
    remarks,
    require_lever,
    require_match,
    require_motion,
    require_order_of_tool,
    require_right_hand,
)
from armlab.calibrate.gravity_load.diagnostics import mirrored as mirrored_error
from armlab.calibrate.gravity_load.model import Load, Turn, WeightEquation, likely_samples, mirror_solution
from armlab.calibrate.inputs import finite, gravity_of, noise_of, orientations, point_noise
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation import Fit, nonlinear_least_squares
from armlab.estimation.linear_problem import check_spread
from armlab.estimation.nonlinear import NonlinearSolution
from armlab.models import Accelerometer, ForceSensor

LIMITS = (0.2, 0.3, 0.1)  # largest accepted standard deviations: angle [rad], fraction of the weight, length [m]
UNKNOWN = np.full(3, np.nan)
CLASSES = ("force [N]",) * 3 + ("torque [N m]",) * 3
Value = TypeVar("Value")
SCHEDULE = (200.0, 60.0, 20.0, 10.0, 5.0)


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
    """Fit the axes, load and bias of a force sensor to readings at rest in many tool orientations.

    Parameters
    ----------
    T_base_tool : (N, 4, 4) poses, or (N, 3, 3) orientations, of the tool at rest without contact.
    wrench : (N, 3) raw forces, or (N, 6) raw forces and torques, in sensor axes [N, N m].
    gravity : (3,) gravity in base axes [m/s^2]; or "unknown", to also estimate the weight in base axes.
    sign : +1 if the sensor reads the weight of the load, -1 if it reads the reaction force.
    bias : whether the unloaded sensor may have non-zero readings.
    mass : known mass of the load [kg]; default: estimated.
    noise : standard deviation of the forces [N]; with torques, a pair (forces [N], torques [N m]); or covariance (k, k)
        or (N, k, k) of the k readings. Default: estimated.
    robust : detect and exclude samples with contact; `Fit.outliers` marks them.
    limits : largest accepted standard deviation along any direction: angle [rad], fraction of the weight, length [m].

    Returns
    -------
    Fit of a `models.ForceSensor`
        Parameters: rotation vector of R_tool_sensor (its covariance refers to w in R Exp(w), in sensor axes [rad]),
        mass or weight, bias, centre of mass. Without torques, `centre` and the moments of `bias` are NaN.

    Raises
    ------
    ShapeError : wrong shapes, rows with NaN, invalid rotations, gravity, sign or mass.
    NotExcited : too few samples, or an unidentifiable direction (named in the message).
    NotConverged : a mirrored axis or a reversed sign (`reason` "left_handed"); readings inconsistent with gravity.

    References
    ----------
    Umeyama, PAMI 13(4), 1991.
    """
    RA, note = orientations(T_base_tool, "T_base_tool")
    y = numbers(wrench, "wrench", ShapeError)
    if y.ndim != 2 or y.shape[1] not in (3, 6) or len(y) != len(RA):
        raise ShapeError(
            f"Expected readings of shape ({len(RA)}, 3) or ({len(RA)}, 6), one per pose with forces first, got "
            f"{y.shape}. Match readings and poses by time first."
        )
    finite(y, "wrench")
    if sign not in (1, -1) or isinstance(sign, bool):
        raise ShapeError(
            f"Expected the sign of a force sensor as +1 or -1, got {sign!r}. Use +1 for a sensor that reads the weight."
        )
    pull = None if isinstance(gravity, str) and gravity == "unknown" else sign * gravity_of(gravity)
    if mass is not None and (pull is None or not 0.0 < float(numbers(mass, "mass", ShapeError)) < np.inf):
        raise ShapeError(
            f"Expected a mass > 0 kg together with known gravity, got {mass!r} with gravity {gravity!r}. "
            "Omit the mass, or pass the known gravity."
        )
    known = None if mass is None else float(mass)
    classes, groups = CLASSES[: y.shape[1]], y.shape[1] // 3
    sds = "forces as one positive standard deviation [N]", "wrenches as (sd of force [N], sd of torque [N m])"
    cov = noise_of(noise, groups, (len(y),), "noise", sds[groups - 1])
    equation = WeightEquation(RA, y, pull, bool(bias), known, cov, classes, "force sensor")

    def value(load: Load) -> ForceSensor:
        weight = hypot(*load.gamma.tolist())
        found = weight / (STANDARD if pull is None else hypot(*pull.tolist()))
        g = sign * (load.gamma / found if pull is None else pull)
        moments = (load.centre, load.bias) if equation.torque else (UNKNOWN, np.append(load.bias, UNKNOWN))
        return ForceSensor(load.R, found, *moments, sign=sign, gravity=g)

    return fit_weight(equation, value, limits_of(limits, ANGLE_WEIGHT_LENGTH, LIMITS), robust, [note])


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
    """Fit the axes and bias of an accelerometer to readings at rest in many tool orientations.

    The model of a reading is::

        y_i = -scale R_tool_sensor^T R_base_tool,i^T g + b

    Parameters
    ----------
    T_base_tool : (N, 4, 4) poses, or (N, 3, 3) orientations, of the tool at rest.
    acc : (N, 3) readings in sensor axes [m/s^2], which point upwards at rest.
    scale : also estimate the scale of the readings; default: 1.
    gravity : (3,) gravity in base axes [m/s^2].
    noise : standard deviation [m/s^2], or covariance (3, 3) or (N, 3, 3) [m^2/s^4]. Default: estimated.
    robust : detect and exclude samples in motion; `Fit.outliers` marks them.
    limits : largest accepted standard deviation along any direction: angle [rad], fraction of gravity.

    Returns
    -------
    Fit of a `models.Accelerometer`
        Parameters: rotation vector of R_tool_sensor (its covariance refers to w in R Exp(w), in sensor axes [rad]),
        scale if estimated, bias [m/s^2].

    Raises
    ------
    ShapeError : wrong shapes, rows with NaN, or invalid rotations.
    NotExcited : too few samples, or an unidentifiable direction (named in the message).
    NotConverged : a mirrored axis or a reversed sign (`reason` "left_handed"); readings inconsistent with gravity.
    """
    RA, note = orientations(T_base_tool, "T_base_tool")
    y = numbers(acc, "acc", ShapeError)
    if y.shape != (len(RA), 3):
        raise ShapeError(
            f"Expected readings of shape ({len(RA)}, 3), one per pose, got {y.shape}. Match readings and poses by time "
            "first."
        )
    finite(y, "acc")
    g = gravity_of(gravity)
    cov, classes = point_noise(noise, (len(RA),)), ("acceleration [m/s^2]",) * 3
    equation = WeightEquation(RA, y, -g, True, None if scale else 1.0, cov, classes, "accelerometer")

    def value(load: Load) -> Accelerometer:
        size = float(np.linalg.norm(load.gamma) / np.linalg.norm(g)) if scale else 1.0
        return Accelerometer(load.R, load.bias, size, g)

    widths = limits_of((*limits, 1.0), ANGLE_WEIGHT_LENGTH, LIMITS)
    return fit_weight(equation, value, widths, robust, [note], scale="scale")


def fit_weight(
    equation: WeightEquation,
    value: Callable[[Load], Value],
    limits: tuple[float, float, float],
    robust: bool,
    notes: list[str],
    scale: str = "mass",
) -> Fit[Value]:
    moved = require_motion(equation)
    found = _solved_globally(equation, robust, moved, limits, scale)
    load, kept, residuals = found.value, ~found.outliers, equation.evaluate(found.value)[0].r
    require_order_of_tool(equation, kept)
    require_most(found.outliers, f"readings of the {equation.what}", load)
    hand = require_right_hand(equation, kept)
    require_match(equation, load, residuals, kept, moved)
    pull = load.gamma if equation.pull is None else equation.pull
    if load.gamma @ pull <= 0.0:
        raise NotExcited(
            f"Expected the readings of the {equation.what} to contain a weight, got zero weight. Check the sign and "
            "the units of the readings, and check that the tool rotates about a horizontal axis.",
            ["mass"],
            ["no weight"],
        )
    require_lever(equation, load, np.sqrt(found.cov.diagonal()))
    words = LoadUnknowns(equation, load, limits, scale)
    excitation = check_spread(found.rows.J, words.names, words.units, words.widths, equation.what, describe=words)

    squares = 2.0 * found.cost / found.freedom if equation.noise is not None and found.freedom else None
    lines = remarks(words, np.sqrt(np.diag(found.cov)), squares, moved)
    doubts, lines = doubts_of(found.check, [*notes, hand, *lines])
    return Fit(
        value(load), words.names, words.units, words.parameters(), found.cov, found.sigma, residuals, equation.N,
        excitation, lambda fit: "\n".join([fit.table(), *lines]), found.outliers,
        tuple(dict.fromkeys(equation.classes)), found.formal_cov, doubts,
    )  # fmt: skip


def _solved_globally(
    equation: WeightEquation, robust: bool, moved: float, limits: tuple[float, float, float], scale: str
) -> NonlinearSolution[Load]:
    """Return the best of all minima; raise an error with the likely cause if the descent fails."""
    start = equation.only(likely_samples(equation)).start() if robust else equation.start()
    try:
        found = _solved(equation, start, robust)
    except NotConverged as error:
        _explain(equation, error.best, moved, LoadUnknowns(equation, error.best, limits, scale))
        raise
    if equation.pull is None:
        found = _better_of_mirrored(equation, found, robust)
    elif robust and np.mean(found.outliers) > MANY:
        _try_other_hand(equation)
    return found


def _solved(equation: WeightEquation, start: Load, robust: bool) -> NonlinearSolution[Load]:
    return nonlinear_least_squares(equation.problem(), start, robust=robust, schedule=SCHEDULE, near=True)


def _better_of_mirrored(
    equation: WeightEquation, found: NonlinearSolution[Load], robust: bool
) -> NonlinearSolution[Load]:
    """Return the better of a minimum and its mirror solution, judged by outliers first, then by residuals."""
    start = mirror_solution(equation, found.value)
    if start is None:
        return found
    try:
        other = _solved(equation, start, robust)
    except (NotConverged, NotExcited):
        return found

    def badness(one: NonlinearSolution[Load]) -> tuple[int, float]:
        rest = one.cost if equation.noise is not None else float(np.prod(one.sigma))
        return int(np.count_nonzero(one.outliers)), rest

    return min((found, other), key=badness)


def _explain(equation: WeightEquation, best: Load, moved: float, words: LoadUnknowns) -> None:
    """Raise an error if the descent failed because the readings are inconsistent with gravity or the excitation is too
    small."""
    (one,) = equation.evaluate(best)
    everything = np.ones(equation.N, dtype=bool)
    require_order_of_tool(equation, everything)
    require_right_hand(equation, everything)
    require_match(equation, best, one.r, everything, moved)
    size = {name: float(np.sqrt(np.mean(one.r[:, [name == c for c in one.classes]] ** 2))) for name in one.classes}
    roots = one.roots(size)
    J = roots[:, None] * one.J if roots.ndim == 1 else roots @ one.J
    check_spread(J.reshape(-1, J.shape[2]), words.names, words.units, words.widths, equation.what, describe=words)


def _try_other_hand(equation: WeightEquation) -> None:
    """Raise an error if the forces with reversed signs have far fewer outliers."""
    noise = equation.noise
    if noise is not None:
        noise = noise[:3] if noise.ndim == 1 else noise[..., :3, :3]
    forces = replace(equation, y=equation.y[:, :3], classes=equation.classes[:3], noise=noise)
    sides = [forces, replace(forces, y=-forces.y)]
    this, other = (
        nonlinear_least_squares(one.problem(), one.start(), robust=True, schedule=SCHEDULE).outliers for one in sides
    )
    if 2 * np.count_nonzero(other) < np.count_nonzero(this):
        raise mirrored_error(forces, Turn.of(forces, ~other))
