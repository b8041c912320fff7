"""Maximum-likelihood circles and spheres through measured points, by least squares on geometric distances.

    sphere: e = |p - c| - r                          circle: e = (|q| - r, z),  z = n . (p - c),  q = p - c - n z

The linear equation ``|p|^2 = 2 c . p + (r^2 - |c|^2)`` gives the initial guess for Gauss-Newton steps. Short arcs and
flat caps do not determine the centre; the error names the undetermined direction.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import NotConverged, NotExcited
from armlab.estimation import Excitation, Fit, Measurement, NonlinearProblem
from armlab.estimation import nonlinear_least_squares as solve
from armlab.estimation.linear_problem import check_spread
from armlab.estimation.nonlinear import NonlinearSolution
from armlab.frames import inputs
from armlab.frames.feature_fit import LIMIT, Cloud, circles, principal, result, rounding, spheres, text, upward
from armlab.frames.features import Circle, Sphere
from armlab.lie import so3

MAX_RELATIVE_SD = 0.3  # largest accepted standard deviation of centre and radius, relative to the radius
CircleOrSphere = TypeVar("CircleOrSphere", Circle, Sphere)


def fit_circle(
    p: ArrayLike,
    *,
    noise: ArrayLike | None = None,
    robust: bool = False,
    toward: ArrayLike | None = None,
    normal: ArrayLike | None = None,
) -> Fit[Circle]:
    """Fit a circle in space to points.

    The normal points away from the origin of the points' frame, unless `toward` or `normal` specifies the side.

    Parameters
    ----------
    p : (N, 3) points [m], N >= 4; N >= 3 if the noise is given, N >= 5 for outlier detection.
    noise : standard deviation of each coordinate [m], or covariance (3, 3) or (N, 3, 3) of the points [m^2]; default:
        estimated, and equal for all points.
    robust : detect points that do not belong to the circle; `outliers` marks them.
    toward : (3,) point on the side to which the normal points [m].
    normal : (3,) approximate normal.

    Returns
    -------
    Fit of a `Circle`
        `residuals` (N, 2) are the distances from the circle within its plane and from the plane [m]; `cov` (6, 6) is in
        the order of `Circle.names`.

    Raises
    ------
    ShapeError : points with the wrong shape or with NaN or infinity (the message lists the rows); hints that do not
        determine the side.
    NotExcited : too few points; points on a short arc or a line; a plane through the origin without a hint.
    """
    cloud = Cloud(p, noise, 3, "circle")

    def fit(which: np.ndarray) -> NonlinearSolution[Circle]:
        return _refine(cloud, which, _circle_start(cloud.p[which]), _circle_residuals, _circle_step)

    if robust:
        cloud.choose(3, 2, circles, lambda which: _refit(cloud, 4, fit, _circle_residuals, which))
    found = fit(cloud.kept)
    value = found.value
    excitation = _check_excitation(found, value)
    slope = np.concatenate([value.n, np.cross(value.axes, value.n) @ value.centre, [0.0]])
    n = upward(value.n, value.centre, float(np.sqrt(slope @ found.cov @ slope)), toward, normal, "circle")
    value = Circle(value.centre, n, value.radius, value.axes, found.cov)
    parameters = np.array([*value.centre, 0.0, 0.0, value.radius])
    residuals = _circle_residuals(value, cloud.p)[0]
    return result(value, parameters, found.cov, found.sigma, residuals, cloud.kept, excitation, _report)


def fit_sphere(p: ArrayLike, *, noise: ArrayLike | None = None, robust: bool = False) -> Fit[Sphere]:
    """Fit a sphere to points.

    Parameters
    ----------
    p : (N, 3) points [m], N >= 5; N >= 4 if the noise is given, N >= 6 for outlier detection.
    noise : standard deviation of each coordinate [m], or covariance (3, 3) or (N, 3, 3) of the points [m^2]; default:
        estimated, and equal for all points.
    robust : detect points that do not belong to the sphere; `outliers` marks them.

    Returns
    -------
    Fit of a `Sphere`
        `residuals` (N, 1) are signed distances [m], positive outside; `cov` (4, 4) is in the order of `Sphere.names`.

    Raises
    ------
    ShapeError : points with the wrong shape or with NaN or infinity (the message lists the rows).
    NotExcited : too few points, or points in a plane or on a small cap.
    """
    cloud = Cloud(p, noise, 4, "sphere")

    def fit(which: np.ndarray) -> NonlinearSolution[Sphere]:
        start = Sphere(*_linear_fit(cloud.p[which], np.eye(3)))
        return _refine(cloud, which, start, _sphere_residuals, _sphere_step)

    if robust:
        cloud.choose(4, 1, spheres, lambda which: _refit(cloud, 5, fit, _sphere_residuals, which))
    found = fit(cloud.kept)
    excitation = _check_excitation(found, found.value)
    value = Sphere(found.value.centre, found.value.radius, found.cov)
    parameters = np.array([*value.centre, value.radius])
    residuals = _sphere_residuals(value, cloud.p)[0]
    return result(value, parameters, found.cov, found.sigma, residuals, cloud.kept, excitation, _report)


def _refine(
    cloud: Cloud,
    which: np.ndarray,
    start: CircleOrSphere,
    residuals: Callable[[CircleOrSphere, np.ndarray], tuple[np.ndarray, np.ndarray]],
    step: Callable[[CircleOrSphere, np.ndarray], CircleOrSphere],
) -> NonlinearSolution[CircleOrSphere]:
    """Return the maximum-likelihood circle or sphere of the selected points."""
    what, p = type(start).__name__.lower(), cloud.p[which]
    each = None if cloud.each is None else cloud.each[which]
    k = residuals(start, p)[0].shape[1]
    cov = None if cloud.sigma is None else np.eye(k) * cloud.sigma**2

    def evaluate(value: CircleOrSphere) -> list[Measurement]:
        r, J = residuals(value, p)
        if each is not None:
            D = J[:, :, :3]  # moving a point is equivalent to moving the centre in the opposite direction
            return [Measurement(r, J, D @ each @ np.swapaxes(D, 1, 2), ("distance",) * k)]
        return [Measurement(r, J, cov, ("distance",) * k)]

    try:
        return solve(NonlinearProblem(evaluate, step, what=what), start)
    except NotConverged:
        raise NotExcited(
            f"Expected points that determine the {what}, but the fit did not converge because the points cover too "
            f"little of the {what}. Measure points on a larger part of the {what}.",
            ["centre and radius"],
            ["no minimum"],
        ) from None


def _check_excitation(found: NonlinearSolution[Any], value: Circle | Sphere) -> Excitation:
    """Return the excitation; raise an error if the standard deviation of the centre, radius or tilt exceeds its
    limit."""
    limits = np.array([LIMIT if unit == "rad" else MAX_RELATIVE_SD * value.radius for unit in value.units])
    what = type(value).__name__.lower()

    def describe(reach: np.ndarray) -> str:
        share = np.abs(reach) / limits
        if isinstance(value, Circle) and share[3:5].max() > max(share[:3].max(), share[5]):
            return f"tilt of the circle about {text(reach[3:5] @ value.axes / np.linalg.norm(reach[3:5]))}"
        along = text(reach[:3] / max(float(np.linalg.norm(reach[:3])), 1e-300))
        return f"centre along {along} with the radius: the points cover too little of the {what}"

    return check_spread(found.rows.J, value.names, value.units, limits, what, describe=describe)


def _refit(
    cloud: Cloud,
    least: int,
    fit: Callable[[np.ndarray], NonlinearSolution[CircleOrSphere]],
    residuals: Callable[[CircleOrSphere, np.ndarray], tuple[np.ndarray, np.ndarray]],
    which: np.ndarray,
) -> tuple[float, np.ndarray]:
    """Fit the selected points; return their noise, and the squared distances (N,) of all points from the feature."""
    inputs.check_count(int(which.sum()), least, "circle or sphere")
    found = fit(which)
    return float(found.sigma[0]), np.sum(residuals(found.value, cloud.p)[0] ** 2, axis=1)


def _circle_residuals(value: Circle, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    away = p - value.centre
    z = away @ value.n
    q = away - np.outer(z, value.n)
    rho = np.maximum(np.linalg.norm(q, axis=1), 1e-300)
    lift = away @ np.cross(value.axes, value.n).T  # out-of-plane displacement of a point per unit tilt
    J = np.zeros((len(p), 2, 6))
    J[:, 0, :3], J[:, 1, :3] = -q / rho[:, None], -value.n
    J[:, 0, 3:5], J[:, 1, 3:5] = -(z / rho)[:, None] * lift, lift
    J[:, 0, 5] = -1.0
    return np.stack([rho - value.radius, z], axis=1), J


def _circle_step(value: Circle, x: np.ndarray) -> Circle:
    n, axes = inputs.turned(so3.exp(x[3:5] @ value.axes), value.n, value.axes)
    return Circle(value.centre + x[:3], n, max(value.radius + x[5], 1e-3 * value.radius), axes)


def _sphere_residuals(value: Sphere, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    away = p - value.centre
    rho = np.maximum(np.linalg.norm(away, axis=1), 1e-300)
    J = np.hstack([-away / rho[:, None], -np.ones((len(p), 1))])
    return (rho - value.radius)[:, None], J[:, None]


def _sphere_step(value: Sphere, x: np.ndarray) -> Sphere:
    return Sphere(value.centre + x[:3], max(value.radius + x[3], 1e-3 * value.radius))


def _linear_fit(p: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the centre and the radius by linear least squares within the span of the axes (k, 3)."""
    middle = p.mean(axis=0)
    q = (p - middle) @ axes.T
    size = max(float(np.sqrt(np.mean(np.sum(q**2, axis=1)))), 1e-300)
    q = q / size
    A = np.column_stack([2.0 * q, np.ones(len(q))])
    x = np.linalg.lstsq(A, np.sum(q**2, axis=1), rcond=1e-12)[0]
    return middle + size * x[:-1] @ axes, size * float(np.sqrt(max(x[-1] + x[:-1] @ x[:-1], 1e-300)))


def _circle_start(p: np.ndarray) -> Circle:
    _, axes, squares = principal(p)
    if not squares[1] > max(1e-18 * squares[0], rounding(p) ** 2):
        raise NotExcited(
            "Expected points around a circle, got collinear or coincident points. Measure more of the circle.",
            ["centre and radius: the points are collinear"],
            ["no spread"],
        )
    centre, radius = _linear_fit(p, axes[:2])
    return Circle(centre, axes[2], radius, axes[:2])


def _report(fit: Fit[Any]) -> str:
    value = fit.value
    head = f"{type(value).__name__.lower()} of radius {value.radius:.6g} m about {text(value.centre)} m"
    if isinstance(value, Circle):
        head += f", normal {text(value.n)}\naxis 1 {text(value.axes[0])}, axis 2 {text(value.axes[1])}"
    return f"{head}\n{fit.table()}"
