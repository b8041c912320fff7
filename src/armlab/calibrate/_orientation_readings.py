"""Orientations that were read wrongly before they came here: quaternions in another order, matrices by columns.

Both records with the wrong order of quaternions keep the rotations of ``A X = Y B`` true: ``q_A = q_Y q_B q_X^-1`` is a
rotation of four numbers, and whatever order these have it stays one. Only positions tell.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from armlab.calibrate._hand_eye_equation import Equation
from armlab.calibrate._marker_equation import Sight
from armlab.calibrate._weight_equation import Equation as Weight
from armlab.calibrate._weight_equation import Turn
from armlab.errors import NotConverged
from armlab.lie import quaternion

SUSPECT = 0.02  # residual, of the spread or rad, from which other readings are tried
MUCH_BETTER = 0.3  # share of the residual that the right reading leaves at most
FITS = 0.1  # of the spread, that it leaves at most
UNEXPLAINED, MUCH = 1e-3, 0.1  # share of the variation of forces from which other readings are tried
WIDE = 0.4  # share of gravity: where it moves farther over the tool, a wrong reading leaves much
ROBOT, MARKER = "T_base_tool", "T_cam_marker"


class Reading(NamedTuple):
    """What orientations may have been, in words, and the poses (N, 3, 3), (N, 3) that they then are."""

    text: str
    R: np.ndarray
    t: np.ndarray


def readings(R: np.ndarray, t: np.ndarray) -> list[Reading]:
    """Return the other readings of poses; what is wrong is said of "{}"."""
    q = quaternion.from_matrix(R)
    return [
        Reading(
            "The quaternions of {} are x, y, z, w taken as w, x, y, z.", quaternion.to_matrix(np.roll(q, 1, -1)), t
        ),
        Reading(
            "The quaternions of {} are w, x, y, z taken as x, y, z, w.", quaternion.to_matrix(np.roll(q, -1, -1)), t
        ),
        Reading("The rotations of {} are transposed: those of the inverse.", R.transpose(0, 2, 1), t),
    ]


def require_order(equation: Equation, r: np.ndarray, kept: np.ndarray) -> None:
    """Refuse two records of poses that fit much better when orientations are read in another way.

    Parameters
    ----------
    equation : all pairs. r : (N, 6) residuals at the best value. kept : (N,) pairs that were not left out.
    """
    now = _sizes(r[kept])
    if now[0] < SUSPECT * equation.spread and now[1] < SUSPECT:
        return
    for text, other in _equations(equation):
        position, rotation = _sizes(other.evaluate(other.start())[0].r)
        fits = position < min(max(MUCH_BETTER * now[0], SUSPECT * equation.spread), FITS * equation.spread)
        if fits and rotation < max(MUCH_BETTER * now[1], SUSPECT):
            raise NotConverged(
                f"Expected two records of poses that belong together, got {now[0]:.3g} m and {now[1]:.3g} rad between "
                f"them (RMS). {text}",
                best=other.start(),
                reason="mismatch",
            )


def require_order_of_robot(sight: Sight) -> None:
    """Refuse poses that fit the points of a marker much better when orientations are read in another way.

    Parameters
    ----------
    sight : what was seen.
    """
    rms = sight.solution.misfit
    if rms < SUSPECT * sight.spread:
        return
    for one in _of_robot(sight.RA, sight.tA):
        other = sight.linear(one.R, one.t)
        if other.misfit < min(MUCH_BETTER * rms, FITS * sight.spread):
            raise NotConverged(
                f"Expected poses and points that belong together, got {rms:.3g} m between them (RMS). "
                f"{one.text.format(ROBOT)}",
                best=other,
                reason="mismatch",
            )


def require_order_of_tool(equation: Weight, kept: np.ndarray) -> None:
    """Refuse orientations that explain the forces much better when they are read in another way.

    Parameters
    ----------
    equation : of readings of a known gravity. kept : (N,) samples that were not left out.
    """
    if equation.pull is None:
        return
    now = equation.turn if kept.all() else Turn.of(equation, kept)
    if now.power < (MUCH if now.moved[1] > WIDE else UNEXPLAINED) * now.signal:
        return
    for one in readings(equation.RA, np.zeros((equation.N, 3))):
        other = Turn.of(replace(equation, RA=np.ascontiguousarray(one.R)), kept)
        if other.power < MUCH_BETTER * now.power and other.m > 0.0:
            raise NotConverged(
                f"Expected readings that follow gravity as the tool turns, got {now.power / now.signal:.2g} of their "
                f"variation unexplained. {one.text.format(ROBOT)}",
                best=other,
                reason="mismatch",
            )


def _of_robot(R: np.ndarray, t: np.ndarray) -> Iterator[Reading]:
    """Yield readings of the poses of the robot, and of their inverses, which they are where the eye is in the hand."""
    yield from readings(R, t)
    back = R.transpose(0, 2, 1)
    for one in readings(back, -(back @ t[:, :, None])[:, :, 0]):
        again = np.ascontiguousarray(one.R.transpose(0, 2, 1))
        yield Reading(one.text, again, -(again @ one.t[:, :, None])[:, :, 0])


def _equations(equation: Equation) -> Iterator[tuple[str, Equation]]:
    """Yield the equation with the robot, the marker, or both read in another way."""
    RA, tA, RB, tB = equation.RA, equation.tA, equation.RB, equation.tB
    of_marker = readings(RB, tB)
    for one in of_marker:
        yield one.text.format(MARKER), Equation(RA, tA, one.R, one.t)
    for one in _of_robot(RA, tA):
        yield one.text.format(ROBOT), Equation(one.R, one.t, RB, tB)
        for two in of_marker:
            if two.text == one.text:
                yield one.text.format(f"{ROBOT} and {MARKER}"), Equation(one.R, one.t, two.R, two.t)


def _sizes(r: np.ndarray) -> tuple[float, float]:
    """Return the RMS length of the residuals (N, 6): of positions [m], of rotations [rad]."""
    position, rotation = np.sqrt((r**2).sum(axis=0).reshape(2, 3).sum(axis=1) / max(len(r), 1))
    return float(position), float(rotation)
