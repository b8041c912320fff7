"""Constructions from features with first-order covariance: frames, projections, intersections and distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only, numbers
from armlab.errors import FrameError, ShapeError
from armlab.estimation import Fit
from armlab.frames import inputs
from armlab.frames.features import Circle, Line, Plane, Sphere

LETTERS = ("x", "y", "z")
LEAST_ANGLE = 1e-6  # smallest angle between the features of a frame [rad]
PARALLEL = 1e-9  # sine of the angle below which directions are parallel


@dataclass(frozen=True, eq=False, repr=False)
class BuiltFrame(Shown):
    """Frame built from features.

    Attributes
    ----------
    T : (4, 4) pose in the frame of the features.
    angle : angle between the two features [rad].
    deviation : deviation of the angle from a right angle [rad].
    cov : (6, 6) covariance of the pose error [v; w], v along the axes of the features' frame [m], w along the axes of
        the built frame [rad]; None if all features are exact.
    """

    T: np.ndarray
    angle: float
    deviation: float
    cov: np.ndarray | None

    def __post_init__(self) -> None:
        make_read_only(self, "T", *(() if self.cov is None else ("cov",)))


def build(
    *,
    origin: ArrayLike | Sphere | Circle,
    origin_cov: ArrayLike | None = None,
    **axes: Line | Plane | Circle | ArrayLike,
) -> BuiltFrame:
    """Build a frame from two features and an origin.

    The first feature defines an axis exactly, the second is orthogonalised against it, and the third axis is their
    cross product. The frame is always right-handed. In ``build(z=line, y=-plane, origin=p)``, z points along the line,
    and y opposite to the normal of the plane.

    Let w_1 and w_2 be the small rotations of the features, a the angle between them, and e_1, e_2 and e_3 = e_1 x e_2
    the axes of the frame. Then the frame rotates by
    ``(w_2 . e_1 + cot(a) (w_1 - w_2) . e_2,  w_1 . e_2,  w_1 . e_3)``.

    Parameters
    ----------
    origin : (3,) point [m], or a `Sphere` or a `Circle` whose centre is the origin.
    origin_cov : (3, 3) covariance of the point `origin` [m^2].
    **axes : two of x, y and z: a `Line` (its direction), a `Plane` or a `Circle` (its normal), or a vector (3,). A
        minus sign reverses a feature.

    Raises
    ------
    ShapeError : not exactly two axes, an unknown type of feature, or features within 1e-6 rad of parallel.
    FrameError : axes with names other than x, y and z.

    Notes
    -----
    The errors of the features and of the origin are assumed to be independent.
    """
    unknown = [name for name in axes if name not in LETTERS]
    if unknown:
        raise FrameError(
            f"Expected axes named x, y or z, got {', '.join(map(repr, unknown))}. Use a minus sign to reverse an axis."
        )
    if len(axes) != 2:
        raise ShapeError(
            "Expected exactly two of x, y and z, got "
            f"{', '.join(axes) or 'none'}. The third axis follows from the two given axes."
        )
    (i, first), (j, second) = ((LETTERS.index(name), _direction(item, name)) for name, item in axes.items())
    f, g = first[0], second[0]
    across = g - f * (f @ g)
    sine, cosine = float(np.linalg.norm(across)), float(f @ g)
    angle = float(np.arctan2(sine, cosine))
    if min(angle, np.pi - angle) < LEAST_ANGLE:
        raise ShapeError(
            f"Expected two non-parallel features, got an angle of {angle:.2g} rad between {' and '.join(axes)}. "
            "Measure a different feature."
        )
    e2 = across / sine
    e3 = np.cross(f, e2)
    k, sign = 3 - i - j, 1.0 if (j - i) % 3 == 1 else -1.0
    T = np.eye(4)
    T[:3, i], T[:3, j], T[:3, k] = f, e2, sign * e3
    T[:3, 3], place = _origin(origin, origin_cov)
    turns = np.zeros((3, 6))  # rotation of the frame about its axes, from feature rotations about the parent's axes
    slope = cosine / sine
    turns[i] = np.concatenate([slope * e2, f - slope * e2])
    turns[j, :3], turns[k, :3] = e2, sign * e3
    errors, cov = _joint(first[1], second[1], 3, 3), None
    if errors is not None or place is not None:
        cov = np.zeros((6, 6))
        cov[:3, :3] = 0.0 if place is None else place
        C = np.zeros((3, 3)) if errors is None else turns @ errors @ turns.T
        cov[3:, 3:] = 0.5 * (C + C.T)
    return BuiltFrame(T, angle, angle - 0.5 * np.pi, cov)


def _direction(item: Any, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the unit direction (3,) of a feature, and the covariance (3, 3) of its rotation in the features' frame."""
    if isinstance(item, Fit):
        raise ShapeError(f"Expected a feature or a vector for {name}, got a Fit. Pass the value of the fit.")
    if isinstance(item, Circle):
        item = item.plane
    if isinstance(item, (Plane, Line)):
        v = item.n if isinstance(item, Plane) else item.v
        return v, None if item.cov is None else item.axes.T @ item.cov[:2, :2] @ item.axes
    return inputs.direction(item, f"the vector for {name}"), None


def _origin(origin: Any, cov: ArrayLike | None) -> tuple[np.ndarray, np.ndarray | None]:
    if isinstance(origin, (Sphere, Circle)):
        if cov is not None:
            raise ShapeError(
                "Expected origin_cov only for a point, got origin_cov for a feature with its own covariance. "
                "Omit origin_cov."
            )
        return origin.centre, None if origin.cov is None else origin.cov[:3, :3]
    return inputs.vector(origin, "origin"), inputs.covariance(cov, 3, "origin_cov")


@overload
def project(item: Line, onto: Plane) -> Line: ...
@overload
def project(item: ArrayLike, onto: Plane | Line) -> np.ndarray: ...


def project(item: ArrayLike | Line, onto: Plane | Line) -> np.ndarray | Line:
    """Return the nearest points on a plane or a line, or the projection of a line onto a plane.

    The projection of a point onto a plane is ``x - n (n . x - d)``, and onto a line ``c + v (v . (x - c))``. A line
    projected onto a plane has the direction ``v - n (n . v)``, normalised.

    Parameters
    ----------
    item : points (..., 3) [m], or a `Line`.
    onto : `Plane`; points may also be projected onto a `Line`.

    Returns
    -------
    (..., 3) points [m], or a `Line` with the covariance propagated from the line and the plane.

    Raises
    ------
    ShapeError : wrong shapes; a line normal to the plane; the projection of a line onto a line.
    """
    if isinstance(item, Line):
        if not isinstance(onto, Plane):
            raise ShapeError(
                f"Expected a Plane to project a line onto, got {type(onto).__name__}. Project points on the line "
                "instead."
            )
        return _projection(item, onto)
    p = numbers(item, "points", ShapeError)
    if p.shape[-1:] != (3,) or not np.isfinite(p).all():
        raise ShapeError(f"Expected finite points (..., 3) [m], got shape {p.shape}. Drop missing points.")
    if isinstance(onto, Plane):
        return p - ((p - onto.centroid) @ onto.n)[..., None] * onto.n
    if isinstance(onto, Line):
        return onto.centroid + ((p - onto.centroid) @ onto.v)[..., None] * onto.v
    raise ShapeError(
        f"Expected a Plane or a Line to project onto, got {type(onto).__name__}. If this is a fit, pass its value."
    )


@overload
def intersect(first: Plane, second: Plane) -> Line: ...
@overload
def intersect(first: Plane | Line, second: Line) -> np.ndarray: ...
@overload
def intersect(first: Line, second: Plane) -> np.ndarray: ...


def intersect(first: Plane | Line, second: Plane | Line) -> Line | np.ndarray:
    """Return the intersection line of two planes, or the intersection point of a line and a plane.

    The line has the direction ``n_1 x n_2``; its centroid is its point nearest to the centroid of the first plane.

    Parameters
    ----------
    first, second : two planes, or a plane and a line in either order.

    Returns
    -------
    `Line` with the covariance propagated from the planes, or a point (3,) [m].

    Raises
    ------
    ShapeError : features parallel within 1e-9 rad, or two lines.
    """
    if isinstance(first, Plane) and isinstance(second, Plane):
        return _intersection(first, second)
    if isinstance(first, Line) and isinstance(second, Plane):
        first, second = second, first
    if not isinstance(first, Plane) or not isinstance(second, Line):
        raise ShapeError(
            f"Expected two planes, or a plane and a line, got {type(first).__name__} and {type(second).__name__}. "
            "Use distance() for two lines."
        )
    across = float(first.n @ second.v)
    if abs(across) <= PARALLEL:
        raise ShapeError(f"Expected a line that intersects the plane, got a parallel line (sine {across:.2g}).")
    return second.centroid - second.v * (first.n @ (second.centroid - first.centroid)) / across


def distance(first: Line, second: Line) -> float:
    """Return the smallest distance between two lines [m]: ``abs((c_2 - c_1) . (v_1 x v_2)) / abs(v_1 x v_2)``.

    Parameters
    ----------
    first, second : two lines, which may be parallel.
    """
    for one in (first, second):
        if not isinstance(one, Line):
            raise ShapeError(f"Expected two lines, got {type(one).__name__}. Use Plane.distance for points.")
    between, normal = second.centroid - first.centroid, np.cross(first.v, second.v)
    sine = float(np.linalg.norm(normal))
    if sine <= PARALLEL:
        return float(np.linalg.norm(between - first.v * (first.v @ between)))
    return float(abs(between @ normal) / sine)


def _projection(line: Line, plane: Plane) -> Line:
    """Return the projection of a line onto a plane with its covariance."""
    n, v = plane.n, line.v
    along = v - n * (n @ v)
    if np.linalg.norm(along) <= PARALLEL:
        raise ShapeError(
            "Expected a line that is not normal to the plane, got a normal line. Project a point on the line instead."
        )
    away = line.centroid - plane.centroid
    height = float(n @ away)
    dv, dc = _errors(line)
    dn, do = _errors(plane)
    turn = np.hstack([dv - np.outer(n, n @ dv), -(n @ v) * dn - np.outer(n, v @ dn)])
    shift = np.hstack([dc - np.outer(n, n @ dc), -height * dn - np.outer(n, away @ dn - do)])
    return _line(along, line.centroid - n * height, turn, shift, _joint(line.cov, plane.cov, 4, 3))


def _intersection(first: Plane, second: Plane) -> Line:
    """Return the intersection line of two planes with its covariance."""
    along = np.cross(first.n, second.n)
    if np.linalg.norm(along) <= PARALLEL:
        raise ShapeError(
            "Expected intersecting planes, got parallel planes (within 1e-9 rad). Use the distance between the planes."
        )
    rows = np.stack([first.n, second.n, along / np.linalg.norm(along)])
    step = np.linalg.solve(rows, np.array([0.0, float(second.n @ (second.centroid - first.centroid)), 0.0]))
    point = first.centroid + step
    (dn, do), (dm, dp) = _errors(first), _errors(second)
    turn = np.hstack([-np.cross(second.n, dn.T).T, np.cross(first.n, dm.T).T])
    moved = np.zeros((3, 6))
    moved[0, :3], moved[1, 3:] = do - step @ dn, dp - (point - second.centroid) @ dm
    return _line(along, point, turn, np.linalg.solve(rows, moved), _joint(first.cov, second.cov, 3, 3))


def _errors(item: Plane | Line) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of the direction (3, m), and of a line's centroid (3, m) or a plane's offset (m,), with
    respect to its errors."""
    if isinstance(item, Plane):
        return np.column_stack([np.cross(item.axes, item.n).T, np.zeros(3)]), np.array([0.0, 0.0, 1.0])
    tilts = np.cross(item.axes, item.v).T
    return np.hstack([tilts, np.zeros((3, 2))]), np.hstack([np.zeros((3, 2)), item.axes.T])


def _line(along: np.ndarray, point: np.ndarray, turn: np.ndarray, shift: np.ndarray, cov: np.ndarray | None) -> Line:
    """Return a line; `turn` and `shift` (3, m) are the derivatives of its direction and point with respect to errors
    with covariance (m, m)."""
    plain = Line.of(along, point)
    if cov is None:
        return plain
    across = plain.axes
    tilts = np.stack([-across[1], across[0]]) @ turn / np.linalg.norm(along)  # tilt about axis 1 moves v against axis 2
    J = np.vstack([tilts, across @ shift])
    C = J @ cov @ J.T
    return Line(plain.v, plain.r, plain.centroid, across, 0.5 * (C + C.T))


def _joint(a: np.ndarray | None, b: np.ndarray | None, m: int, k: int) -> np.ndarray | None:
    """Return the covariance of the errors of two independent features, or None if both are exact."""
    if a is None and b is None:
        return None
    C = np.zeros((m + k, m + k))
    C[:m, :m] = 0.0 if a is None else a
    C[m:, m:] = 0.0 if b is None else b
    return C
