"""Projections, intersections and distances of planes and lines; what is known of them goes along, to first order."""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.frames.features import Line, Plane

__all__ = ["distance", "intersect", "project"]

PARALLEL = 1e-9  # sine of the angle below which directions are parallel


@overload
def project(item: Line, onto: Plane) -> Line: ...
@overload
def project(item: ArrayLike, onto: Plane | Line) -> np.ndarray: ...


def project(item: ArrayLike | Line, onto: Plane | Line) -> np.ndarray | Line:
    """Return the nearest points of a plane or a line, or the shadow of a line on a plane.

    Point on plane ``x - n (n . x - d)``; point on line ``c + v (v . (x - c))``; line on plane: direction
    ``v - n (n . v)``, made unit, through the projected points.

    Parameters
    ----------
    item : points (..., 3) [m], or a `Line`. onto : `Plane`, or `Line` for points.

    Returns
    -------
    (..., 3) points [m], or a `Line` with the covariance that those of line and plane give it.

    Raises
    ------
    ShapeError : shapes; a line across the plane has no shadow; a line on a line.
    """
    if isinstance(item, Line):
        if not isinstance(onto, Plane):
            raise ShapeError(f"Expected a Plane to project a line onto, got {type(onto).__name__}. Project its points.")
        return _shadow(item, onto)
    p = numbers(item, "points", ShapeError)
    if p.shape[-1:] != (3,) or not np.isfinite(p).all():
        raise ShapeError(f"Expected finite points (..., 3) [m], got shape {p.shape}. Drop what is missing.")
    if isinstance(onto, Plane):
        return p - ((p - onto.centroid) @ onto.n)[..., None] * onto.n
    if isinstance(onto, Line):
        return onto.centroid + ((p - onto.centroid) @ onto.v)[..., None] * onto.v
    raise ShapeError(f"Expected a Plane or a Line to project onto, got {type(onto).__name__}. Take the value of a fit.")


@overload
def intersect(first: Plane, second: Plane) -> Line: ...
@overload
def intersect(first: Plane | Line, second: Line) -> np.ndarray: ...
@overload
def intersect(first: Line, second: Plane) -> np.ndarray: ...


def intersect(first: Plane | Line, second: Plane | Line) -> Line | np.ndarray:
    """Return the line that two planes share, or the point that a line and a plane share.

    The line of two planes has the direction ``n_1 x n_2`` and, as its centroid, its point nearest to that of the first.

    Parameters
    ----------
    first, second : two planes, or a plane and a line in either order.

    Returns
    -------
    `Line` with the covariance that those of the planes give it, or point (3,) [m].

    Raises
    ------
    ShapeError : they are parallel within 1e-9, or two lines, which need not meet.
    """
    if isinstance(first, Plane) and isinstance(second, Plane):
        return _edge(first, second)
    if isinstance(first, Line) and isinstance(second, Plane):
        first, second = second, first
    if not isinstance(first, Plane) or not isinstance(second, Line):
        raise ShapeError(
            f"Expected two planes, or a plane and a line, got {type(first).__name__} and {type(second).__name__}. "
            "Two lines have a distance() instead."
        )
    across = float(first.n @ second.v)
    if abs(across) <= PARALLEL:
        raise ShapeError(f"Expected a line that meets the plane, got one parallel to it (sine {across:.2g}).")
    return second.centroid - second.v * (first.n @ (second.centroid - first.centroid)) / across


def distance(first: Line, second: Line) -> float:
    """Return the least distance between two lines [m]: ``abs((c_2 - c_1) . (v_1 x v_2)) / abs(v_1 x v_2)``.

    Parameters
    ----------
    first, second : the lines; parallel ones too.
    """
    for one in (first, second):
        if not isinstance(one, Line):
            raise ShapeError(f"Expected two lines, got {type(one).__name__}. A plane has its own distance().")
    between, normal = second.centroid - first.centroid, np.cross(first.v, second.v)
    sine = float(np.linalg.norm(normal))
    if sine <= PARALLEL:
        return float(np.linalg.norm(between - first.v * (first.v @ between)))
    return float(abs(between @ normal) / sine)


def _shadow(line: Line, plane: Plane) -> Line:
    """Return the projection of a line on a plane with its covariance."""
    n, v = plane.n, line.v
    along = v - n * (n @ v)
    if np.linalg.norm(along) <= PARALLEL:
        raise ShapeError("Expected a line with a shadow on the plane, got one along its normal. A point is its shadow.")
    away = line.centroid - plane.centroid
    height = float(n @ away)
    dv, dc = _errors(line)
    dn, do = _errors(plane)
    turn = np.hstack([dv - np.outer(n, n @ dv), -(n @ v) * dn - np.outer(n, v @ dn)])
    shift = np.hstack([dc - np.outer(n, n @ dc), -height * dn - np.outer(n, away @ dn - do)])
    return _line(along, line.centroid - n * height, turn, shift, _joint(line.cov, plane.cov, 4, 3))


def _edge(first: Plane, second: Plane) -> Line:
    """Return the line that two planes share with its covariance."""
    along = np.cross(first.n, second.n)
    if np.linalg.norm(along) <= PARALLEL:
        raise ShapeError(
            "Expected planes that meet, got parallel ones (within 1e-9 rad). Their distance is all there is."
        )
    rows = np.stack([first.n, second.n, along / np.linalg.norm(along)])
    step = np.linalg.solve(rows, np.array([0.0, float(second.n @ (second.centroid - first.centroid)), 0.0]))
    point = first.centroid + step
    (dn, do), (dm, dp) = _errors(first), _errors(second)
    turn = np.hstack([-np.cross(second.n, dn.T).T, np.cross(first.n, dm.T).T])
    still = np.zeros(3)
    moved = np.stack(
        [
            np.concatenate([do - step @ dn, still]),
            np.concatenate([still, dp - (point - second.centroid) @ dm]),
            np.zeros(6),
        ]
    )
    return _line(along, point, turn, np.linalg.solve(rows, moved), _joint(first.cov, second.cov, 3, 3))


def _errors(item: Plane | Line) -> tuple[np.ndarray, np.ndarray]:
    """Return how direction (3, m) and place move with each of the m errors of a feature.

    The place of a line is its centroid (3, m), that of a plane its offset along the normal (m,).
    """
    if isinstance(item, Plane):
        return np.column_stack([np.cross(item.axes, item.n).T, np.zeros(3)]), np.array([0.0, 0.0, 1.0])
    tilts = np.cross(item.axes, item.v).T
    return np.hstack([tilts, np.zeros((3, 2))]), np.hstack([np.zeros((3, 2)), item.axes.T])


def _line(along: np.ndarray, point: np.ndarray, turn: np.ndarray, shift: np.ndarray, cov: np.ndarray | None) -> Line:
    """Return a line whose direction and point move by `turn` and `shift` (3, m) with errors of covariance (m, m)."""
    plain = Line.of(along, point)
    if cov is None:
        return plain
    across = plain.axes
    tilts = np.stack([-across[1], across[0]]) @ turn / np.linalg.norm(along)  # about axis 1: v moves against axis 2
    J = np.vstack([tilts, across @ shift])
    C = J @ cov @ J.T
    return Line(plain.v, plain.r, plain.centroid, across, 0.5 * (C + C.T))


def _joint(a: np.ndarray | None, b: np.ndarray | None, m: int, k: int) -> np.ndarray | None:
    """Return the covariance of the errors of two features, independent of each other; None when both are exact."""
    if a is None and b is None:
        return None
    C = np.zeros((m + k, m + k))
    C[:m, :m] = 0.0 if a is None else a
    C[m:, m:] = 0.0 if b is None else b
    return C
