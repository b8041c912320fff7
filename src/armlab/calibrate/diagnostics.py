"""Diagnostics shared by all calibrations: limits, axis names, insufficient rotation, misread orientations."""

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
FIXED = 1e-6  # rotation [rad] below which poses count as not rotated
NOISE = 3.0  # the same limit in standard deviations of the noise
ALIGNED = 0.996  # cosine above which an axis is named by its letter
THINNED = 2000  # maximum number of rotations searched for the largest angle
UNSEEN = 1e-9  # information below which a direction is unobservable
ROUGH = 0.05  # residual [rad] too large for sensor noise
COUNTS = {2: "two", 3: "three"}
SPREAD_AND_ANGLE = "a fraction of the position spread and an angle [rad]"
ANGLE_WEIGHT_LENGTH = "an angle [rad], a fraction of the weight and a length [m]"
SUSPECT = 0.02  # residual (relative or in rad) above which other interpretations are tried
MUCH_BETTER = 0.3  # maximum residual of a better interpretation, relative to the current residual
FITS = 0.1  # maximum residual of a better interpretation, relative to the spread
ROBOT, MARKER = "T_base_tool", "T_cam_marker"


def axis_text(u: np.ndarray, axes: str) -> str:
    """Return "tool axis z", or "tool axis (0.60, 0.00, 0.80)"; the sign is arbitrary."""
    parts = u.tolist()
    length = hypot(*parts)
    k = max(range(3), key=lambda i: abs(parts[i]))
    if abs(parts[k]) > ALIGNED * length:
        return f"{axes} axis {'xyz'[k]}"
    scale = length if parts[k] > 0 else -length
    return f"{axes} axis ({', '.join(f'{round(x / scale, 2) + 0.0:.2f}' for x in parts)})"


def limits_of(limits: Any, what: str, usual: Limits) -> Limits:
    """Return the limits of a fit; raise an error unless they are positive numbers."""
    values = numbers(limits, "limits", ShapeError)
    if values.shape != (len(usual),) or not np.all(values > 0):
        raise ShapeError(
            f"Expected limits as {COUNTS[len(usual)]} positive numbers ({what}), got {limits!r}. The defaults are "
            f"{usual}."
        )
    found: Any = tuple(values.tolist())
    return found


def require_two_axes(RA: np.ndarray, noise: float, carrier: str, moved: Sequence[str]) -> None:
    """Raise an error unless the tool rotates about two axes; `noise` is the standard deviation of a rotation [rad].

    The mean square rotation of a tool axis u is ``1 - |mean(R_A) u|^2``; noise alone gives a value of 2 sigma^2.
    """
    M = RA.sum(axis=0) / len(RA)
    squares, u = np.linalg.eigh(np.eye(3) - M.T @ M)
    turned = np.sqrt(np.maximum(squares, 0.0))
    limit = max(FIXED, NOISE * noise) if noise < ROUGH else FIXED
    if turned[0] > limit:
        return
    axes = [u[:, 0]] if turned[1] > limit else list(np.eye(3))
    where = [f"translation of {moved[0]} along {axis_text(v, carrier)} ({moved[1]} moves with it)" for v in axes]
    turn = "rotations about one axis only" if turned[1] > limit else "no rotation"
    largest = largest_rotation(RA)
    raise NotExcited(
        f"Expected poses that rotate the tool about two axes, got {turn} (largest angle between two poses "
        f"{largest:.3g} rad). Not identifiable: {'; '.join(where)}. Rotate the wrist about a second axis.",
        where,
        [f"rotated by {t:.2g} rad, noise {noise:.2g} rad" for t in turned[: len(where)]],
    )


def largest_rotation(R: np.ndarray) -> float:
    """Return the largest angle between any two rotations (N, 3, 3) [rad], using at most 2000 samples."""
    flat = R[:: 1 + len(R) // THINNED].reshape(-1, 9)
    return float(np.arccos(np.clip(0.5 * ((flat @ flat.T).min() - 1.0), -1.0, 1.0)))


def doubts_of(check: ResidualCheck, remarks: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
    """Return the doubts plus all remarks that end with a question mark and, separately, the other remarks."""
    asked = (line for line in remarks if line.endswith("?"))
    return (*check.doubts, *asked), [line for line in remarks if line and not line.endswith("?")]


def require_most(outliers: np.ndarray, what: str, best: Any) -> None:
    """Raise an error if a fit excludes at least half of the samples; the remaining samples may then fit by chance."""
    left, total = int(np.count_nonzero(outliers)), len(outliers)
    if 2 * left < total or not left:
        return
    raise NotConverged(
        f"Expected mostly consistent {what}, but {left} of {total} samples were excluded. Check that sample i was "
        "taken at the same time in all records. Also check the units, the frames, and the noise if given.",
        best=best,
        reason="mismatch",
    )


class Reading(NamedTuple):
    """Interpretation of the orientations: its description, and the resulting rotations and positions."""

    text: str
    R: np.ndarray
    t: np.ndarray


def readings(R: np.ndarray, t: np.ndarray) -> list[Reading]:
    """Return alternative interpretations of poses; "{}" in a description stands for the name of the poses.

    If both records have the wrong quaternion order, the rotations in ``A X = Y B`` still agree, because ``q_A = q_Y q_B
    q_X^-1`` is a 4D rotation of the components in any order. Only the positions then reveal the error.
    """
    q = quaternion.from_matrix(R)
    there, back = (quaternion.to_matrix(np.roll(q, by, -1)) for by in (1, -1))
    return [
        Reading("The quaternions of {} are x, y, z, w but were read as w, x, y, z.", there, t),
        Reading("The quaternions of {} are w, x, y, z but were read as x, y, z, w.", back, t),
        Reading("The rotations of {} are transposed (they belong to the inverse poses).", R.transpose(0, 2, 1), t),
    ]


def readings_of_robot(R: np.ndarray, t: np.ndarray) -> Iterator[Reading]:
    """Yield alternative interpretations of the robot poses, and of their inverses for eye-in-hand setups."""
    yield from readings(R, t)
    back = R.transpose(0, 2, 1)
    for one in readings(back, -(back @ t[:, :, None])[:, :, 0]):
        again = np.ascontiguousarray(one.R.transpose(0, 2, 1))
        yield Reading(one.text, again, -(again @ one.t[:, :, None])[:, :, 0])
