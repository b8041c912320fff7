"""Planes, lines, circles and spheres as values with unit directions.

A fitted feature has the covariance of its small errors, in the order of its `names`. A constructed feature is treated
as exact and has no covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import number, positive
from armlab.errors import ShapeError
from armlab.frames import inputs
from armlab.lie import so3

__all__ = ["Circle", "Line", "Plane", "Sphere"]

TILTS, CENTRE = ("tilt about axis 1", "tilt about axis 2"), ("centre x", "centre y", "centre z")


@dataclass(frozen=True, eq=False, repr=False)
class Plane(Shown):
    """Oriented plane: ``n . x = d``.

    Attributes
    ----------
    n : (3,) unit normal.
    d : distance of the plane from the origin along n [m]; negative if n points towards the origin.
    centroid : (3,) centroid of the measured points [m], or the given point of a constructed plane.
    axes : (2, 3) unit vectors in the plane, the first along the largest extent of the measured points.
    cov : (3, 3) covariance of the errors in `names`: tilt about each axis [rad], offset at the centroid along n [m];
        None if the plane is exact.
    """

    n: np.ndarray
    d: float
    centroid: np.ndarray
    axes: np.ndarray
    cov: np.ndarray | None = field(default=None, repr=False)

    names: ClassVar[tuple[str, ...]] = (*TILTS, "offset at the centroid")
    units: ClassVar[tuple[str, ...]] = ("rad", "rad", "m")

    def __post_init__(self) -> None:
        n, c = inputs.unit(self.n, "the normal of a plane"), inputs.vector(self.centroid, "the centroid of a plane")
        d = number(self.d, "the distance from the origin to a plane [m]")
        if not abs(n @ c - d) <= inputs.UNIT * (1.0 + np.linalg.norm(c)):
            raise ShapeError(
                f"Expected a centroid in the plane, got a distance of {n @ c - d:.2g} m. Use Plane.of for any normal "
                "and point."
            )
        _freeze(self, n=n, d=d, centroid=c, axes=_axes(self.axes, n), cov=inputs.covariance(self.cov, 3, "cov"))

    @classmethod
    def of(cls, normal: ArrayLike, point: ArrayLike) -> Plane:
        """Return the plane through a point.

        Parameters
        ----------
        normal : (3,) normal of any non-zero length.
        point : (3,) point on the plane [m], which becomes its centroid.
        """
        n, p = inputs.direction(normal, "normal"), inputs.vector(point, "point")
        return cls(n, float(n @ p), p, inputs.across(n))

    def __neg__(self) -> Plane:
        """Return the same plane with the normal reversed."""
        cov = None if self.cov is None else self.cov * np.outer([1, 1, -1], [1, 1, -1])
        return replace(self, n=-self.n, d=-self.d, cov=cov)

    def moved(self, T_a_b: ArrayLike) -> Plane:
        """Transform the plane from frame b to frame a.

        Parameters
        ----------
        T_a_b : (4, 4) pose of b in a.
        """
        R, c = _moved(T_a_b, self.centroid)
        n, axes = inputs.turned(R, self.n, self.axes)
        return Plane(n, float(n @ c), c, axes, self.cov)

    def distance(self, p: ArrayLike) -> np.ndarray:
        """Return the signed distance (N,) of points (N, 3) [m]: ``n . x - d``.

        Parameters
        ----------
        p : (N, 3) points [m].
        """
        return (inputs.points(p) - self.centroid) @ self.n


@dataclass(frozen=True, eq=False, repr=False)
class Line(Shown):
    """Directed line: ``x = r + s v``.

    Attributes
    ----------
    v : (3,) unit direction.
    r : (3,) foot of the line [m], which is its point closest to the origin.
    centroid : (3,) centroid of the measured points [m], or the given point of a constructed line.
    axes : (2, 3) unit vectors normal to the line; axis 1, axis 2 and v form a right-handed triad.
    cov : (4, 4) covariance of the errors in `names`: tilt about each axis [rad], offset of the centroid along each axis
        [m]; None if the line is exact.
    """

    v: np.ndarray
    r: np.ndarray
    centroid: np.ndarray
    axes: np.ndarray
    cov: np.ndarray | None = field(default=None, repr=False)

    names: ClassVar[tuple[str, ...]] = (*TILTS, "offset along axis 1", "offset along axis 2")
    units: ClassVar[tuple[str, ...]] = ("rad", "rad", "m", "m")

    def __post_init__(self) -> None:
        v, c = inputs.unit(self.v, "the direction of a line"), inputs.vector(self.centroid, "the centroid of a line")
        r = inputs.vector(self.r, "the foot of a line")
        off = np.linalg.norm(np.cross(v, c - r))
        if not off + abs(r @ v) <= inputs.UNIT * (1.0 + np.linalg.norm(c)):
            raise ShapeError(
                f"Expected the foot of a line to be the point of the line closest to the origin, got a point "
                f"{off:.2g} m off the line and {r @ v:.2g} m along it. Use Line.of for any direction and point."
            )
        _freeze(self, v=v, r=r, centroid=c, axes=_axes(self.axes, v), cov=inputs.covariance(self.cov, 4, "cov"))

    @classmethod
    def of(cls, direction: ArrayLike, point: ArrayLike) -> Line:
        """Return the line through a point.

        Parameters
        ----------
        direction : (3,) direction of any non-zero length.
        point : (3,) point on the line [m], which becomes its centroid.
        """
        v, p = inputs.direction(direction, "direction"), inputs.vector(point, "point")
        return cls(v, _foot(v, p), p, inputs.across(v))

    def __neg__(self) -> Line:
        """Return the same line with the direction reversed."""
        flip = np.array([-1.0, 1.0])
        signs = np.array([-1.0, 1.0, -1.0, 1.0])  # reversing axis 1 keeps the axes right-handed
        cov = None if self.cov is None else self.cov * np.outer(signs, signs)
        return replace(self, v=-self.v, axes=self.axes * flip[:, None], cov=cov)

    def moved(self, T_a_b: ArrayLike) -> Line:
        """Transform the line from frame b to frame a, and recompute its point nearest to the origin.

        Parameters
        ----------
        T_a_b : (4, 4) pose of b in a.
        """
        R, c = _moved(T_a_b, self.centroid)
        v, axes = inputs.turned(R, self.v, self.axes)
        return Line(v, _foot(v, c), c, axes, self.cov)

    def offset(self, p: ArrayLike) -> np.ndarray:
        """Return the vectors (N, 3) [m] from the line to points, normal to the line.

        Parameters
        ----------
        p : (N, 3) points [m].
        """
        away = inputs.points(p) - self.centroid
        return away - np.outer(away @ self.v, self.v)


@dataclass(frozen=True, eq=False, repr=False)
class Circle(Shown):
    """Circle in space: the points at distance `radius` from `centre` in the plane normal to `n`.

    Attributes
    ----------
    centre : (3,) centre [m].
    n : (3,) unit normal.
    radius : radius [m].
    axes : (2, 3) unit vectors in the plane of the circle.
    cov : (6, 6) covariance of the errors in `names`; None if the circle is exact.
    """

    centre: np.ndarray
    n: np.ndarray
    radius: float
    axes: np.ndarray
    cov: np.ndarray | None = field(default=None, repr=False)

    names: ClassVar[tuple[str, ...]] = (*CENTRE, *TILTS, "radius")
    units: ClassVar[tuple[str, ...]] = ("m", "m", "m", "rad", "rad", "m")

    def __post_init__(self) -> None:
        n = inputs.unit(self.n, "the normal of a circle")
        centre, radius = inputs.vector(self.centre, "the centre of a circle"), _radius(self.radius, "circle")
        cov = inputs.covariance(self.cov, 6, "cov")
        _freeze(self, centre=centre, n=n, radius=radius, axes=_axes(self.axes, n), cov=cov)

    @property
    def plane(self) -> Plane:
        """Plane of the circle, with the covariance of the tilts and of the offset at the centre."""
        n, cov = self.n, self.cov
        if cov is not None:
            S = np.zeros((3, 6))
            S[0, 3] = S[1, 4] = 1.0
            S[2, :3] = n
            cov = S @ cov @ S.T
            cov = 0.5 * (cov + cov.T)
        return Plane(n, float(n @ self.centre), self.centre, self.axes, cov)


@dataclass(frozen=True, eq=False, repr=False)
class Sphere(Shown):
    """Sphere: the points at distance `radius` from `centre`.

    Attributes
    ----------
    centre : (3,) centre [m].
    radius : radius [m].
    cov : (4, 4) covariance of the errors in `names`; None if the sphere is exact.
    """

    centre: np.ndarray
    radius: float
    cov: np.ndarray | None = field(default=None, repr=False)

    names: ClassVar[tuple[str, ...]] = (*CENTRE, "radius")
    units: ClassVar[tuple[str, ...]] = ("m", "m", "m", "m")

    def __post_init__(self) -> None:
        centre = inputs.vector(self.centre, "the centre of a sphere")
        cov = inputs.covariance(self.cov, 4, "cov")
        _freeze(self, centre=centre, radius=_radius(self.radius, "sphere"), cov=cov)


def _freeze(value: object, **fields: object) -> None:
    for name, content in fields.items():
        object.__setattr__(value, name, content)


def _radius(radius: object, what: str) -> float:
    return positive(radius, f"radius of a {what} [m]")


def _axes(axes: np.ndarray, third: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) as a read-only copy, after checking that they are normal to the third axis."""
    axes = np.array(axes, dtype=float)
    whole = np.vstack([axes, third]) if axes.shape == (2, 3) else np.zeros((3, 3))
    if not np.allclose(whole @ whole.T, np.eye(3), rtol=0.0, atol=inputs.UNIT):
        raise ShapeError(
            f"Expected axes of a feature to be unit vectors (2, 3) normal to its direction, got shape {axes.shape}. "
            "Use of() to create a consistent feature."
        )
    axes.flags.writeable = False
    return axes


def _moved(T_a_b: ArrayLike, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the orthonormalised rotation of a pose, and a point transformed to frame a."""
    T = inputs.pose(T_a_b, "T_a_b")
    return so3.project(T[:3, :3])[0], T[:3, :3] @ p + T[:3, 3]


def _foot(v: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the point closest to the origin on the line along v through p."""
    return p - v * (v @ p)
