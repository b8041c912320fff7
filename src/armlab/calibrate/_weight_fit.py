"""The fit that force sensors and accelerometers share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from armlab.calibrate._agreement import require_most
from armlab.calibrate._orientation_readings import require_order_of_tool
from armlab.calibrate._weight_closed import Found, closed_form, is_closed
from armlab.calibrate._weight_equation import Equation, Load, Turn
from armlab.calibrate._weight_start import likely, twin
from armlab.calibrate._weight_words import (
    MANY,
    Words,
    remarks,
    require_lever,
    require_match,
    require_motion,
    require_right_hand,
)
from armlab.calibrate._weight_words import mirrored as mirrored_error
from armlab.errors import NotConverged, NotExcited
from armlab.estimation import Excitation, Fit, NonlinearSolution, check_spread, nonlinear_least_squares, unhurried

Value = TypeVar("Value")

SCHEDULE = (200.0, 60.0, 20.0, 10.0, 5.0)
RICH = 0.01  # share of gravity over two directions from which the closed form keeps 12 digits


def fit_weight(
    equation: Equation,
    value: Callable[[Load], Value],
    limits: tuple[float, float, float],
    robust: bool,
    notes: list[str],
    scale: str = "mass",
) -> Fit[Value]:
    """Fit readings of a turned weight.

    Parameters
    ----------
    equation : the readings. value : makes the result. limits : see `Words`. robust : find outliers.
    notes : for the report. scale : name of the mass.
    """
    moved = require_motion(equation)
    if not robust and moved > RICH and is_closed(equation):
        found = closed_form(equation)
    else:
        found = _descended(equation, robust, moved, limits, scale)
    load, kept = found.load, ~found.outliers
    require_order_of_tool(equation, kept)
    require_most(found.outliers, f"readings of the {equation.what}", load)
    hand = require_right_hand(equation, kept)
    require_match(equation, load, found.residuals, kept, moved)
    _require_weight(equation, load)
    require_lever(equation, load, np.sqrt(found.cov.diagonal()))
    words = Words(equation, load, limits, scale)

    def excitation() -> Excitation:
        J = found.jacobian(equation)
        return check_spread(J, words.names, words.units, words.widths, equation.what, describe=words)

    def summary(fit: Fit[Value]) -> str:
        squares = 2.0 * found.cost / found.freedom if equation.noise is not None and found.freedom else None
        lines = [*notes, hand, *remarks(words, np.sqrt(np.diag(found.cov)), squares, moved)]
        return "\n".join([fit.table(), *(line for line in lines if line)])

    return Fit(
        value(load), words.names, words.units, words.parameters(), found.cov, found.sigma, found.residuals, equation.N,
        unhurried(excitation, found.cov, words.widths, found.unseen), summary, found.outliers,
        tuple(dict.fromkeys(equation.classes)),
    )  # fmt: skip


def _descended(equation: Equation, robust: bool, moved: float, limits: tuple[float, float, float], scale: str) -> Found:
    start = equation.only(likely(equation)).start() if robust else equation.start()
    try:
        found = _solved(equation, start, robust)
    except NotConverged as error:
        _explain(equation, error.best, moved, Words(equation, error.best, limits, scale))
        raise
    if equation.pull is None:
        found = _better_of_twins(equation, found, robust)
    elif robust and np.mean(found.outliers) > MANY:
        _try_other_hand(equation)
    return Found.of(equation, found)


def _solved(equation: Equation, start: Load, robust: bool) -> NonlinearSolution[Load]:
    return nonlinear_least_squares(equation.problem(), start, robust=robust, schedule=SCHEDULE, near=True)


def _better_of_twins(equation: Equation, found: NonlinearSolution[Load], robust: bool) -> NonlinearSolution[Load]:
    """Return the better of a minimum and of that from its `twin`: fewer outliers, then smaller residuals."""
    start = twin(equation, found.value)
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


def _explain(equation: Equation, best: Load, moved: float, words: Words) -> None:
    """Say why a descent came to no end, where readings do not follow gravity or orientations do not tell."""
    (one,) = equation.evaluate(best)
    everything = np.ones(equation.N, dtype=bool)
    require_right_hand(equation, everything)
    require_match(equation, best, one.r, everything, moved)
    size = {name: float(np.sqrt(np.mean(one.r[:, [name == c for c in one.classes]] ** 2))) for name in one.classes}
    roots = one.roots(size)
    J = roots[:, None] * one.J if roots.ndim == 1 else roots @ one.J
    check_spread(J.reshape(-1, J.shape[2]), words.names, words.units, words.widths, equation.what, describe=words)


def _try_other_hand(equation: Equation) -> None:
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


def _require_weight(equation: Equation, load: Load) -> None:
    """Refuse readings in which there is no weight."""
    along = load.gamma @ equation.pull if equation.pull is not None else load.gamma @ load.gamma
    if along <= 0.0:
        raise NotExcited(
            f"Expected a weight in the readings of the {equation.what}, got none above zero. Check sign and units of "
            "the readings, and that the tool turns about a horizontal axis.",
            ["mass"],
            ["no weight"],
        )
