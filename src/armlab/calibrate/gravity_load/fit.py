"""Force sensors and accelerometers calibrated by gravity: axes, bias, and mass with its centre or scale.

    f_i = s m R^T R_base_tool,i^T g + b_f,        tau_i = c x (f_i - b_f) + b_tau,        R = R_tool_sensor

Known gravity and forces alone have a closed form, which is the most likely value; torques sharpen the rotation, and
everything is then fitted together. Umeyama (1991) for the closed form.
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

LIMITS = (0.2, 0.3, 0.1)
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
    NotExcited : too few samples; an unidentifiable direction, in words.
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
    known = None if mass is None else float(mass)
    classes, groups = CLASSES[: y.shape[1]], y.shape[1] // 3
    sds = "forces as one standard deviation above zero [N]", "wrenches as (sd of force [N], sd of torque [N m])"
    cov = noise_of(noise, groups, (len(y),), "noise", sds[groups - 1])
    equation = WeightEquation(RA, y, pull, bool(bias), known, cov, classes, "force sensor")

    def value(load: Load) -> ForceSensor:
        weight = hypot(*load.gamma.tolist())
        found = weight / (STANDARD if pull is None else hypot(*pull.tolist()))
        g = sign * (load.gamma / found if pull is None else pull)
        moments = (load.centre, load.bias) if equation.torque else (UNKNOWN, np.append(load.bias, UNKNOWN))
        return ForceSensor(load.R, found, *moments, sign=sign, gravity=g)

    return fit_weight(equation, value, limits_of(limits, ANGLE_WEIGHT_LENGTH, LIMITS), robust, [note])


def _readings(wrench: ArrayLike, N: int) -> np.ndarray:
    y = numbers(wrench, "wrench", ShapeError)
    if y.ndim != 2 or y.shape[1] not in (3, 6) or len(y) != N:
        raise ShapeError(
            f"Expected readings of shape ({N}, 3) or ({N}, 6), one per pose, forces first, got {y.shape}. "
            "Pair them by their time first."
        )
    finite(y, "wrench")
    return y


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
    NotExcited : too few samples; an unidentifiable direction, in words.
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
    equation = WeightEquation(
        RA, y, -g, True, None if scale else 1.0, cov, ("acceleration [m/s^2]",) * 3, "accelerometer"
    )  # fmt: skip

    def value(load: Load) -> Accelerometer:
        size = float(np.linalg.norm(load.gamma) / np.linalg.norm(g)) if scale else 1.0
        return Accelerometer(load.R, load.bias, size, g)

    return fit_weight(
        equation, value, limits_of((*limits, 1.0), ANGLE_WEIGHT_LENGTH, LIMITS), robust, [note], scale="scale"
    )


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
    _require_weight(equation, load)
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
    """Return the best of all minima; where none is found, say why."""
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
    """Return the better of a minimum and of that from its mirror image: fewer outliers, then smaller residuals."""
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
    """Say why a descent did not converge: readings that do not follow gravity, or orientations that do not excite."""
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
    """Refuse where the mirror image of the forces leaves out far fewer samples than the forces do."""
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


def _require_weight(equation: WeightEquation, load: Load) -> None:
    along = load.gamma @ equation.pull if equation.pull is not None else load.gamma @ load.gamma
    if along <= 0.0:
        raise NotExcited(
            f"Expected a weight in the readings of the {equation.what}, got none above zero. Check sign and units of "
            "the readings, and that the tool turns about a horizontal axis.",
            ["mass"],
            ["no weight"],
        )
