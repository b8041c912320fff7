"""Maximum-likelihood planes and lines through measured points, with covariance and oriented direction.

With isotropic noise, the most likely plane is normal to the weakest principal direction of the centred points, and the
most likely line is parallel to the strongest. Let lambda_k be the sum of squares of N points along principal direction
k, and sigma the noise of a coordinate. The errors are uncorrelated and have the variances

    plane: tilt about axis 1  sigma^2 / lambda_2,  about axis 2  sigma^2 / lambda_1,  offset at centroid  sigma^2 / N
    line:  tilt about each axis  sigma^2 / lambda_1,  offset of the centroid along each axis  sigma^2 / N

If the points spread no more than the noise in a required direction, the fit raises NotExcited. If the noise differs
between directions or points, the cost is the sum of ``e^T S^-1 e`` with ``S = D C D^T``, where e are the distances of a
point, D (k, 3) their directions and C the covariance of the point. The Jacobian then uses the lever arm of a tilt at
the most likely point ``p - C D^T S^-1 e`` instead of p, which gives the gradient of this cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only
from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Fit, Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.linear_problem import check_spread
from armlab.estimation.nonlinear import NonlinearSolution
from armlab.frames import inputs
from armlab.frames.feature_fit import (
    LIMIT,
    SIDE_DEVIATIONS,
    Cloud,
    inliers,
    lines,
    planes,
    principal,
    result,
    rounding,
    text,
    upward,
)
from armlab.frames.features import Line, Plane
from armlab.lie import so3

PlaneOrLine = TypeVar("PlaneOrLine", Plane, Line)

P_VALUE = 1e-3  # significance level of the test that noise alone explains the spread of the points
JUDGED = 10  # minimum number of points for this test


def fit_plane(
    p: ArrayLike,
    *,
    noise: ArrayLike | None = None,
    robust: bool = False,
    toward: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    limit: float = LIMIT,
) -> Fit[Plane]:
    """Fit a plane ``n . x = d`` to points.

    The normal points away from the origin of the points' frame, unless `toward` or `normal` specifies the side.

    Parameters
    ----------
    p : (N, 3) points [m], N >= 4; N >= 3 if the noise is given, N >= 5 for outlier detection.
    noise : standard deviation of each coordinate [m], or covariance (3, 3) or (N, 3, 3) of the points [m^2]; default:
        estimated, and equal for all points.
    robust : detect points that do not belong to the plane; `outliers` marks them.
    toward : (3,) point on the side of the normal [m].
    normal : (3,) approximate normal.
    limit : largest accepted standard deviation of a tilt [rad].

    Returns
    -------
    Result of fitting a `Plane`
        `residuals` (N,) are signed distances [m]; `cov` (3, 3) is in the order of `Plane.names`.

    Raises
    ------
    ShapeError : points with the wrong shape or with NaN or infinity (the message lists the rows); both hints, or a hint
        that does not determine the side.
    NotExcited : too few points; collinear points (the message names their direction); a plane through the origin
        without a hint.
    """
    limit, cloud = inputs.limit_of(limit), Cloud(p, noise, 3, "plane")
    p, sigma = cloud.p, cloud.sigma
    if robust:
        cloud.choose(3, 1, planes, lambda which: _plane_distances(cloud.p, which))
    kept = cloud.kept
    c, axes, squares = principal(p[kept])
    freedom = int(kept.sum()) - 3
    found = float(np.sqrt(squares[2] / freedom)) if freedom else float(sigma or 0.0)
    used = max(sigma or found, rounding(p))
    n = axes[2]
    cov = used**2 * np.diag([1.0 / max(squares[1], 1e-300), 1.0 / max(squares[0], 1e-300), 1.0 / kept.sum()])
    precision = _precision(squares[1], squares[2], used, freedom), _precision(squares[0], squares[2], used, 0)
    names = (f"tilt about the long axis of the points, {text(axes[0])}", f"tilt about {text(axes[1])}")
    excitation = _check_excitation(precision, used, kept.sum(), squares, limit, Plane, names)
    reach = float(np.sqrt(cov[2, 2] + (axes[1] @ c) ** 2 * cov[0, 0] + (axes[0] @ c) ** 2 * cov[1, 1]))
    n = upward(n, c, reach, toward, normal, "plane")
    value = Plane(n, float(n @ c), c, axes[:2], cov)
    fit = result(value, _parameters(value), cov, np.array([found]), value.distance(p), kept, excitation, _report)
    return fit if cloud.each is None else _reweighted(fit, p, cloud.each, robust, limit)


def fit_line(
    p: ArrayLike,
    *,
    noise: ArrayLike | None = None,
    robust: bool = False,
    along: ArrayLike | None = None,
    limit: float = LIMIT,
) -> Fit[Line]:
    """Fit a line ``x = r + s v`` to points.

    The line is directed from the first to the last inlier, unless `along` specifies its direction.

    Parameters
    ----------
    p : (N, 3) points [m], N >= 3; N >= 2 if the noise is given, N >= 4 for outlier detection.
    noise : standard deviation of each coordinate [m], or covariance (3, 3) or (N, 3, 3) of the points [m^2]; default:
        estimated, and equal for all points.
    robust : detect points that do not belong to the line; `outliers` marks them.
    along : (3,) approximate direction.
    limit : largest accepted standard deviation of a tilt [rad].

    Returns
    -------
    Fit of a `Line`
        `residuals` (N, 3) are the vectors from the line to the points [m]; `cov` (4, 4) is in the order of
        `Line.names`.

    Raises
    ------
    ShapeError : points with the wrong shape or with NaN or infinity (the message lists the rows); `along` normal to
        the line.
    NotExcited : too few points; coincident points; coincident first and last points without `along`.
    """
    limit, cloud = inputs.limit_of(limit), Cloud(p, noise, 2, "line")
    if robust:
        cloud.choose(2, 2, lines, lambda which: _line_distances(cloud.p, which))
    p, sigma = cloud.p[cloud.kept], cloud.sigma
    c, axes, squares = principal(p)
    freedom = 2 * len(p) - 4
    found = float(np.sqrt((squares[1] + squares[2]) / freedom)) if freedom else float(sigma or 0.0)
    used = max(sigma or found, rounding(cloud.p))
    tilt, offset = used**2 / max(squares[0], 1e-300), used**2 / len(p)
    precision = _precision(squares[0], squares[1], used, len(p) - 2)
    names = ("direction of the line (its points coincide), tilt about axis 1", "tilt about axis 2")
    excitation = _check_excitation((precision, precision), used, len(p), squares, limit, Line, names)
    v = _oriented(axes[0], p[-1] - p[0], float(np.sqrt(2.0)) * used, along)
    cov = np.diag([tilt, tilt, offset, offset])
    value = Line(v, c - v * (v @ c), c, inputs.across(v), cov)
    away = value.offset(cloud.p)
    fit = result(value, _parameters(value), cov, np.array([found]), away, cloud.kept, excitation, _report)
    return fit if cloud.each is None else _reweighted(fit, cloud.p, cloud.each, robust, limit)


def _oriented(v: np.ndarray, step: np.ndarray, sigma: float, along: ArrayLike | None) -> np.ndarray:
    if along is not None:
        side = float(v @ inputs.direction(along, "along"))
        if abs(side) <= 1e-6:
            raise ShapeError(
                "Expected along= roughly parallel to the line, got a direction perpendicular to it. Correct along=."
            )
    elif abs(side := float(v @ step)) <= SIDE_DEVIATIONS * sigma:
        raise NotExcited(
            "Expected the last point to be far enough from the first to determine the direction of the line, got "
            f"{abs(side):.2g} m along the line. Pass the direction with along=.",
            ["direction of the line"],
            [f"{abs(side):.2g} m"],
        )
    return v if side > 0 else -v


def _precision(strong: float, weak: float, sigma: float, points: int) -> float:
    """Return the inverse standard deviation of the principal direction with the larger of two sums of squares.

    The standard deviation is ``sigma sqrt(strong) / (strong - weak)``. The probability that noise alone explains the
    ratio q of the two sums is ``(2 sqrt(q) / (1 + q))^points`` (sphericity test in two dimensions).
    """
    gap = strong - weak
    if points + 3 >= JUDGED:
        chance = (2.0 * np.sqrt(strong * weak) / max(strong + weak, 1e-300)) ** points
        gap = gap if chance < P_VALUE else 0.0
    return float(gap / (sigma * np.sqrt(max(strong, 1e-300))))


def _check_excitation(
    precision: tuple[float, float],
    sigma: float,
    count: int,
    squares: np.ndarray,
    limit: float,
    kind: type[Plane] | type[Line],
    words: Sequence[str],
) -> Any:
    """Return the excitation; raise an error if a tilt or an offset is beyond its limit."""
    names, tilts = kind.names, len(precision)
    offsets = len(names) - tilts
    size = 0.2 * max(float(np.sqrt(squares.sum() / count)), 1e-300)
    J = np.diag([*precision, *[np.sqrt(count) / sigma] * offsets])
    limits = np.array([limit] * tilts + [size] * offsets)

    def describe(reach: np.ndarray) -> str:
        i = int(np.argmax(np.abs(reach) / limits))
        return f"{words[i]} ({abs(reach[i]):.2g} rad)" if i < tilts else f"{names[i]} ({abs(reach[i]):.2g} m)"

    return check_spread(J, names, kind.units, limits, kind.__name__.lower(), describe=describe)


def _plane_distances(p: np.ndarray, kept: np.ndarray) -> tuple[float, np.ndarray]:
    c, axes, squares = principal(p[kept])
    return float(np.sqrt(squares[2] / max(kept.sum() - 3, 1))), ((p - c) @ axes[2]) ** 2


def _line_distances(p: np.ndarray, kept: np.ndarray) -> tuple[float, np.ndarray]:
    c, axes, squares = principal(p[kept])
    sigma = np.sqrt((squares[1] + squares[2]) / max(2 * kept.sum() - 4, 1))
    return float(sigma), np.sum(((p - c) @ axes[1:].T) ** 2, axis=1)


def _parameters(value: Plane | Line) -> np.ndarray:
    offsets = [value.d] if isinstance(value, Plane) else value.axes @ value.centroid
    return np.array([0.0, 0.0, *offsets])


def _reweighted(fit: Fit[PlaneOrLine], p: np.ndarray, cov: np.ndarray, robust: bool, limit: float) -> Fit[PlaneOrLine]:
    """Return the fit of points with covariances (N, 3, 3), starting from a fit with equal covariances."""
    solve: Any = weighted_plane if isinstance(fit.value, Plane) else weighted_line
    found = solve(p, cov, fit.value, robust)
    value = replace(found.value, cov=found.cov)
    kept = ~found.outliers
    size = 0.2 * float(np.linalg.norm(p[kept].std(axis=0)))
    limits = np.array([limit if unit == "rad" else size for unit in value.units])
    typical = float(np.sqrt(np.trace(cov, axis1=1, axis2=2).mean() / 3.0))
    return replace(
        fit,
        value=value,
        parameters=_parameters(value),
        cov=found.cov,
        sigma=found.sigma * typical,  # from units of the given noise to metres
        residuals=value.distance(p) if isinstance(value, Plane) else value.offset(p),
        n=int(kept.sum()),
        excitation=check_spread(found.rows.J, value.names, value.units, limits, type(value).__name__.lower()),
        outliers=found.outliers,
    )


def _report(fit: Fit[Any]) -> str:
    value = fit.value
    if isinstance(value, Plane):
        head = f"plane n . x = d with n = {text(value.n)}, d = {value.d:.6g} m"
    else:
        head = f"line x = r + s v with v = {text(value.v)}, r = {text(value.r)} m"
    head += f", centroid {text(value.centroid)} m\naxis 1 {text(value.axes[0])}, axis 2 {text(value.axes[1])}"
    return f"{head}\n{fit.table()}"


def weighted_plane(p: np.ndarray, cov: np.ndarray, start: Plane, robust: bool) -> NonlinearSolution[Plane]:
    """Return the most likely plane through points (N, 3) with covariances (N, 3, 3), starting from an initial guess."""

    def evaluate(value: Plane) -> list[Measurement]:
        e, root, away = _likely(p - value.centroid, value.n[None], cov)
        lift = away @ np.cross(value.axes, value.n).T
        J = np.concatenate([lift, np.full((len(p), 1), -1.0)], axis=1)[:, None]
        return [_whitened(e, J, root)]

    def step(value: Plane, x: np.ndarray) -> Plane:
        n, axes = inputs.turned(so3.exp(x[:2] @ value.axes), value.n, value.axes)
        c = value.centroid + x[2] * value.n
        return Plane(n, float(n @ c), c, axes)

    return nonlinear_least_squares(NonlinearProblem(evaluate, step, what="plane"), start, robust=robust)


def weighted_line(p: np.ndarray, cov: np.ndarray, start: Line, robust: bool) -> NonlinearSolution[Line]:
    """Return the most likely line through points (N, 3) with covariances (N, 3, 3), starting from an initial line."""

    def evaluate(value: Line) -> list[Measurement]:
        e, root, away = _likely(p - value.centroid, value.axes, cov)
        lever = away @ value.v
        J = np.zeros((len(p), 2, 4))
        J[:, 1, 0], J[:, 0, 1] = lever, -lever
        J[:, 0, 2] = J[:, 1, 3] = -1.0
        return [_whitened(e, J, root)]

    def step(value: Line, x: np.ndarray) -> Line:
        v, axes = inputs.turned(so3.exp(x[:2] @ value.axes), value.v, value.axes)
        c = value.centroid + x[2:] @ value.axes
        return Line(v, c - v * (v @ c), c, axes)

    return nonlinear_least_squares(NonlinearProblem(evaluate, step, what="line"), start, robust=robust)


def _likely(away: np.ndarray, D: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distances (N, k), the Cholesky factor of their covariance (N, k, k), and the most likely points (N,
    3)."""
    e, CD = away @ D.T, cov @ D.T
    S = D @ CD
    return e, np.linalg.cholesky(S), away - (CD @ np.linalg.solve(S, e[..., None]))[..., 0]


def _whitened(e: np.ndarray, J: np.ndarray, root: np.ndarray) -> Measurement:
    """Return distances (N, k) in standard deviations, so that the optimiser evaluates its steps by the total cost."""
    k, r = e.shape[1], np.linalg.solve(root, e[..., None])[..., 0]
    return Measurement(r, np.linalg.solve(root, J), np.eye(k), ("distance",) * k)


@dataclass(frozen=True, eq=False, repr=False)
class OffsetCheck(Shown):
    """Distances of points from a known plane, and their common offset.

    Attributes
    ----------
    offset : mean distance of the inliers [m].
    sd : standard deviation of the offset [m].
    sigma : standard deviation of a distance [m].
    distances : (N,) signed distances of the points from the plane [m].
    outliers : (N,) mask of the points at a different distance.
    """

    offset: float
    sd: float
    sigma: float
    distances: np.ndarray
    outliers: np.ndarray

    def __post_init__(self) -> None:
        make_read_only(self, "distances", "outliers")

    def text(self) -> str:
        """Return a line of text with the offset, and a line per outlier."""
        lines = [f"offset {self.offset:.6g} +- {self.sd:.2g} m, noise {self.sigma:.2g} m"]
        lines += [f"point {i}: {self.distances[i] - self.offset:+.6g} m off" for i in np.flatnonzero(self.outliers)]
        return "\n".join(lines)


def check_offset(plane: Plane, p: ArrayLike, *, noise: float | None = None) -> OffsetCheck:
    """Check that points lie at a common, unknown distance from a known plane.

    The distance is the radius or the length of the probe tip. Fewer than half of the points may be outliers.

    Parameters
    ----------
    plane : known plane, for example from the file of a tracker.
    p : (N, 3) points, N >= 3 [m].
    noise : standard deviation of each distance [m]; default: estimated.

    Raises
    ------
    ShapeError : points with the wrong shape or with NaN or infinity.
    NotExcited : fewer than three points.
    """
    if not isinstance(plane, Plane):
        raise ShapeError(f"Expected a Plane, got {type(plane).__name__}. Use Plane.of for a normal and a point.")
    p, sigma = inputs.points(p), inputs.noise_of(noise)
    heights = plane.distance(p)

    def through(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
        return (plane.distance(p) - plane.distance(sets[:, 0])[:, None]) ** 2

    def refit(kept: np.ndarray) -> tuple[float, np.ndarray]:
        away = heights - heights[kept].mean()
        return float(np.sqrt(np.sum(away[kept] ** 2) / max(kept.sum() - 1, 1))), away**2

    kept = inliers(p, 1, 1, through, refit, sigma, "distance")
    if kept.sum() < 2:
        raise NotExcited(
            "Expected at least 2 points at a common distance from "
            f"the plane, got {int(kept.sum())}. Measure more points.",
            ["offset"],
            [f"{int(kept.sum())} points"],
        )
    found, _ = refit(kept)
    sd = max(sigma or found, rounding(p)) / float(np.sqrt(kept.sum()))
    return OffsetCheck(float(heights[kept].mean()), sd, found, heights, ~kept)
