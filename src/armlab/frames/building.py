"""A frame from two features and a point: the weld seam's z along a line, its y against a plate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import FrameError, ShapeError
from armlab.estimation import Fit
from armlab.frames import _check
from armlab.frames.features import Circle, Line, Plane, Sphere

__all__ = ["BuiltFrame", "build"]

LETTERS = ("x", "y", "z")
LEAST_ANGLE = 1e-6  # rad between the features


@dataclass(frozen=True, eq=False)
class BuiltFrame:
    """A frame that was built from features.

    Attributes
    ----------
    T : (4, 4) its pose in the frame of the features.
    angle : between the two features [rad]. deviation : of it from a right angle [rad].
    cov : (6, 6) covariance of its pose error [v; w], v along the axes of the features' frame, w along its own; None
        when all features are exact.
    """

    T: np.ndarray
    angle: float
    deviation: float
    cov: np.ndarray | None


def build(
    *,
    origin: ArrayLike | Sphere | Circle,
    origin_cov: ArrayLike | None = None,
    **axes: Line | Plane | Circle | ArrayLike,
) -> BuiltFrame:
    """Build a frame from two features and its origin.

    The feature given first is an axis exactly, the second is made orthogonal to it, the third axis is their product:
    a right-handed frame, whatever the features. ``build(z=line, y=-plane, origin=p)``: z along the line, y against the
    normal of the plane.

    With w_1 and w_2 the small turns of the features (axes of the frame: 1, 2, and 3 = 1 x 2) and a their angle, the
    frame turns by ``(w_2 . e_1 + cot(a) (w_1 - w_2) . e_2,  w_1 . e_2,  w_1 . e_3)``.

    Parameters
    ----------
    origin : (3,) point [m], or a `Sphere` or a `Circle` for its centre.
    origin_cov : (3, 3) covariance of a point [m^2].
    **axes : two of x, y and z, each a `Line` (its direction), a `Plane` or a `Circle` (its normal), or a vector (3,).
        A minus turns a feature round.

    Raises
    ------
    ShapeError : not two of x, y, z; features that are none of these, or less than 1e-6 rad from parallel.
    FrameError : letters other than x, y and z.

    Notes
    -----
    The errors of the features and of the origin count as independent of each other.
    """
    unknown = [name for name in axes if name not in LETTERS]
    if unknown:
        raise FrameError(f"Expected axes named x, y or z, got {', '.join(map(repr, unknown))}. A minus reverses one.")
    if len(axes) != 2:
        raise ShapeError(f"Expected exactly two of x, y and z, got {', '.join(axes) or 'none'}. The third follows.")
    (i, first), (j, second) = ((LETTERS.index(name), _direction(item, name)) for name, item in axes.items())
    f, g = first[0], second[0]
    across = g - f * (f @ g)
    sine, cosine = float(np.linalg.norm(across)), float(f @ g)
    angle = float(np.arctan2(sine, cosine))
    if min(angle, np.pi - angle) < LEAST_ANGLE:
        raise ShapeError(
            f"Expected two features that are not parallel, got an angle of {angle:.2g} rad between "
            f"{' and '.join(axes)}. Measure another feature."
        )
    e2 = across / sine
    e3 = np.cross(f, e2)
    k, sign = 3 - i - j, 1.0 if (j - i) % 3 == 1 else -1.0
    T = np.eye(4)
    T[:3, i], T[:3, j], T[:3, k] = f, e2, sign * e3
    T[:3, 3], place = _origin(origin, origin_cov)
    turns = np.zeros((3, 6))  # of the frame about its axes, from those of the features about the parent's
    slope = cosine / sine
    turns[i] = np.concatenate([slope * e2, f - slope * e2])
    turns[j, :3], turns[k, :3] = e2, sign * e3
    known = [one for one in (first[1], second[1], place) if one is not None]
    cov = _covariance(turns, first[1], second[1], place) if known else None
    for array in (T, cov):
        if array is not None:
            array.flags.writeable = False
    return BuiltFrame(T, angle, angle - 0.5 * np.pi, cov)


def _covariance(
    turns: np.ndarray, first: np.ndarray | None, second: np.ndarray | None, place: np.ndarray | None
) -> np.ndarray:
    """Return the covariance (6, 6) of the pose error; what is None is exact."""
    errors, cov = np.zeros((6, 6)), np.zeros((6, 6))
    errors[:3, :3] = 0.0 if first is None else first
    errors[3:, 3:] = 0.0 if second is None else second
    cov[:3, :3] = 0.0 if place is None else place
    C = turns @ errors @ turns.T
    cov[3:, 3:] = 0.5 * (C + C.T)
    return cov


def _direction(item: Any, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the unit direction (3,) of a feature and the covariance (3, 3) of its turn, in the axes of its frame."""
    if isinstance(item, Fit):
        raise ShapeError(f"Expected a feature or a vector for {name}, got a Fit. Give its value.")
    if isinstance(item, Circle):
        item = item.plane
    if isinstance(item, (Plane, Line)):
        v = item.n if isinstance(item, Plane) else item.v
        return v, None if item.cov is None else item.axes.T @ item.cov[:2, :2] @ item.axes
    return _check.direction(item, f"the vector for {name}"), None


def _origin(origin: Any, cov: ArrayLike | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the origin (3,) and its covariance."""
    if isinstance(origin, (Sphere, Circle)):
        if cov is not None:
            raise ShapeError("Expected origin_cov for a point, got it beside a feature that has its own. Leave it out.")
        return origin.centre, None if origin.cov is None else origin.cov[:3, :3]
    return _check.vector(origin, "origin"), _check.covariance(cov, 3, "origin_cov")
