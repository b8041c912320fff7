"""Diagnostics shared by all calibrations: limits, axes in words, unexciting rotations, misread orientations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import hypot
from typing import Any, NamedTuple, TypeVar

import numpy as np

from armlab._numbers import numbers
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation.residual_tests import ResidualCheck
from armlab.lie import quaternion

Limits = TypeVar("Limits", tuple[float, float], tuple[float, float, float])
FIXED = 1e-6  # rad: an orientation that moves less does not move
NOISE = 3.0  # an orientation that moves less than this many deviations of the noise does not either
ALIGNED = 0.996  # cosine beyond which an axis is called by its letter
THINNED = 2000  # rotations among which the largest is looked for
UNSEEN = 1e-9  # a direction as long as its limits has no deviation: nothing is seen of it
ROUGH = 0.05  # rad: a larger residual is no noise of a sensor
COUNTS = {2: "two", 3: "three"}
SPREAD_AND_ANGLE = "a share of the spread of the positions and an angle [rad]"
ANGLE_WEIGHT_LENGTH = "an angle [rad], a share of the weight and a length [m]"
SUSPECT = 0.02  # residual, of the spread or rad, from which other readings are tried
MUCH_BETTER = 0.3  # share of the residual that the right reading leaves at most
FITS = 0.1  # of the spread, that it leaves at most
ROBOT, MARKER = "T_base_tool", "T_cam_marker"


def axis_text(u: np.ndarray, axes: str) -> str:
    """Return "tool axis z", or "tool axis (0.60, 0.00, 0.80)": a line, without sense."""
    parts = u.tolist()
    length = hypot(*parts)
    k = max(range(3), key=lambda i: abs(parts[i]))
    if abs(parts[k]) > ALIGNED * length:
        return f"{axes} axis {'xyz'[k]}"
    scale = length if parts[k] > 0 else -length
    return f"{axes} axis ({', '.join(f'{round(x / scale, 2) + 0.0:.2f}' for x in parts)})"


def limits_of(limits: Any, what: str, usual: Limits) -> Limits:
    """Return the limits of a fit, as many as usual, refusing others than numbers above zero."""
    values = numbers(limits, "limits", ShapeError)
    if values.shape != (len(usual),) or not np.all(values > 0):
        raise ShapeError(
            f"Expected limits as {COUNTS[len(usual)]} numbers above zero, {what}, got {limits!r}. {usual} are the "
            "usual ones."
        )
    found: Any = tuple(values.tolist())
    return found


def require_two_axes(RA: np.ndarray, noise: float, carrier: str, moved: Sequence[str]) -> None:
    """Refuse rotations about one axis, and none; `noise` is the deviation of a rotation [rad].

    ``e_u^2 = 1 - |mean(R_A) u|^2`` is the mean square by which a tool axis u turns; noise alone makes it 2 sigma^2.
    """
    M = RA.sum(axis=0) / len(RA)
    squares, u = np.linalg.eigh(np.eye(3) - M.T @ M)
    turned = np.sqrt(np.maximum(squares, 0.0))
    limit = max(FIXED, NOISE * noise) if noise < ROUGH else FIXED
    if turned[0] > limit:
        return
    axes = [u[:, 0]] if turned[1] > limit else list(np.eye(3))
    where = [f"translation of {moved[0]} along {axis_text(v, carrier)} ({moved[1]} moves with it)" for v in axes]
    turn = "about one axis only" if turned[1] > limit else "nowhere"
    largest = largest_rotation(RA)
    raise NotExcited(
        f"Expected poses that turn the tool about two axes, got rotations {turn} (largest between two poses "
        f"{largest:.3g} rad): not told is the {'; '.join(where)}. Turn the wrist about a second axis.",
        where,
        [f"turned by {t:.2g} rad, noise {noise:.2g} rad" for t in turned[: len(where)]],
    )


def largest_rotation(R: np.ndarray) -> float:
    """Return the largest angle between two of the rotations (N, 3, 3) [rad]; of many, of 2000 of them."""
    flat = R[:: 1 + len(R) // THINNED].reshape(-1, 9)
    return float(np.arccos(np.clip(0.5 * ((flat @ flat.T).min() - 1.0), -1.0, 1.0)))


def doubts_of(check: ResidualCheck, remarks: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
    """Return why a fit is not good, and the remarks that are no doubts: those are questions."""
    asked = (line for line in remarks if line.endswith("?"))
    return (*check.doubts, *asked), [line for line in remarks if line and not line.endswith("?")]


def require_most(outliers: np.ndarray, what: str, best: Any) -> None:
    """Refuse a fit that leaves out half of the samples or more: it agrees with some by chance."""
    left, total = int(np.count_nonzero(outliers)), len(outliers)
    if 2 * left < total or not left:
        return
    raise NotConverged(
        f"Expected {what} most of which agree with each other, got {left} of {total} samples left out. Check that "
        "sample i of all records is the same moment, units and frames, and noise if it was given.",
        best=best,
        reason="mismatch",
    )


class Reading(NamedTuple):
    """What orientations may have been, in words, and the poses (N, 3, 3), (N, 3) that they then are."""

    text: str
    R: np.ndarray
    t: np.ndarray


def readings(R: np.ndarray, t: np.ndarray) -> list[Reading]:
    """Return the other readings of poses; what is wrong is said of "{}".

    Both records with the wrong order of quaternions keep the rotations of ``A X = Y B`` true: ``q_A = q_Y q_B q_X^-1``
    is a rotation of four numbers, and whatever order these have it stays one. Only positions show it.
    """
    q = quaternion.from_matrix(R)
    there, back = (quaternion.to_matrix(np.roll(q, by, -1)) for by in (1, -1))
    return [
        Reading("The quaternions of {} are x, y, z, w taken as w, x, y, z.", there, t),
        Reading("The quaternions of {} are w, x, y, z taken as x, y, z, w.", back, t),
        Reading("The rotations of {} are transposed: those of the inverse.", R.transpose(0, 2, 1), t),
    ]


def readings_of_robot(R: np.ndarray, t: np.ndarray) -> Iterator[Reading]:
    """Yield readings of the poses of the robot, and of their inverses, which they are where the eye is in the hand."""
    yield from readings(R, t)
    back = R.transpose(0, 2, 1)
    for one in readings(back, -(back @ t[:, :, None])[:, :, 0]):
        again = np.ascontiguousarray(one.R.transpose(0, 2, 1))
        yield Reading(one.text, again, -(again @ one.t[:, :, None])[:, :, 0])
