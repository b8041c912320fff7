"""Maximum-likelihood planes and lines through measured points, with covariance and a rule for their direction.

The noise of a point is the same in all directions, so the most likely plane is across the weakest principal direction
of the centred points, the most likely line along the strongest. With lambda_k the sum of squares along principal
direction k of N points and sigma the noise of a coordinate,

    plane: tilt about axis 1  sigma^2 / lambda_2,  about axis 2  sigma^2 / lambda_1,  offset at centroid  sigma^2 / N
    line:  tilt about each axis  sigma^2 / lambda_1,  offset of the centroid along each axis  sigma^2 / N

and no two of them are correlated. A direction whose spread is no larger than the noise is refused. Where noise differs
between directions or points, with e the distances of a point, D their directions (k, 3) and C its covariance, the cost
is the sum of ``e^T S^-1 e``, ``S = D C D^T``. Its gradient is that of plain residuals when the lever of a tilt is taken
at the most likely place ``p - C D^T S^-1 e``, not at p.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Fit, Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.linear_problem import check_spread
from armlab.estimation.nonlinear import NonlinearSolution
from armlab.frames import inputs
from armlab.frames.feature_fit import (
    LIMIT,
    SURE,
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

Flat = TypeVar("Flat", Plane, Line)

CHANCE = 1e-3  # of a spread that noise alone would show
JUDGED = 10  # points from which the spread is held against that chance; fewer cannot decide


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

    The normal points away from the origin of the frame of the points, unless `toward` or `normal` says otherwise.

    Parameters
    ----------
    p : (N, 3) points [m], N >= 4; 3 are enough where the noise is known, 5 are needed to find an outlier.
    noise : standard deviation of each coordinate [m], or covariance (3, 3) or (N, 3, 3) of the points [m^2]; one
        deviation for all is estimated when left out.
    robust : find points that do not belong to the plane; `outliers` marks them.
    toward : (3,) a point on the side that the normal points to [m].
    normal : (3,) roughly the normal.
    limit : largest standard deviation of a tilt that is accepted [rad].

    Returns
    -------
    Fit of a `Plane`: `residuals` (N,) are signed distances, `cov` (3, 3) that of `Plane.names`.

    Raises
    ------
    ShapeError : points are no (N, 3) or not finite, with their rows; both hints are given, or one that does not decide
        the side.
    NotExcited : too few points; points along a line, with its direction; a plane through the origin without a hint.
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
    spare = int(kept.sum()) - 3
    precision = _precision(squares[1], squares[2], used, spare), _precision(squares[0], squares[2], used, 0)
    names = (f"tilt about the long axis of the points, {text(axes[0])}", f"tilt about {text(axes[1])}")
    excitation = _judge(precision, used, kept.sum(), squares, limit, Plane, names)
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

    It points from the first to the last point (that is no outlier), unless `along` says otherwise.

    Parameters
    ----------
    p : (N, 3) points [m], N >= 3; 2 are enough where the noise is known, 4 are needed to find an outlier.
    noise : standard deviation of each coordinate [m], or covariance (3, 3) or (N, 3, 3) of the points [m^2]; one
        deviation for all is estimated when left out.
    robust : find points that do not belong to the line; `outliers` marks them.
    along : (3,) roughly its direction.
    limit : largest standard deviation of a tilt that is accepted [rad].

    Returns
    -------
    Fit of a `Line`: `residuals` (N, 3) are vectors from the line to the points, `cov` (4, 4) that of `Line.names`.

    Raises
    ------
    ShapeError : points are no (N, 3) or not finite, with their rows; `along` is across the line.
    NotExcited : too few points; points in one place; a first and a last point in one place without a hint.
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
    names = ("direction of the line: its points are in one place, tilt about axis 1", "tilt about axis 2")
    excitation = _judge((precision, precision), used, len(p), squares, limit, Line, names)
    v = _forward(axes[0], p[-1] - p[0], float(np.sqrt(2.0)) * used, along)
    cov = np.diag([tilt, tilt, offset, offset])
    value = Line(v, c - v * (v @ c), c, inputs.across(v), cov)
    away = value.offset(cloud.p)
    fit = result(value, _parameters(value), cov, np.array([found]), away, cloud.kept, excitation, _report)
    return fit if cloud.each is None else _reweighted(fit, cloud.p, cloud.each, robust, limit)


def _forward(v: np.ndarray, step: np.ndarray, sigma: float, along: ArrayLike | None) -> np.ndarray:
    if along is not None:
        side = float(v @ inputs.direction(along, "along"))
        if abs(side) <= 1e-6:
            raise ShapeError("Expected along= roughly along the line, got a direction across it. Give another one.")
    elif abs(side := float(v @ step)) <= SURE * sigma:
        raise NotExcited(
            f"Expected the last point away from the first to tell the direction of the line, got them {abs(side):.2g} "
            "m apart along it. Say the direction by along=.",
            ["sense of the line"],
            [f"{abs(side):.2g} m"],
        )
    return v if side > 0 else -v


def _precision(strong: float, weak: float, sigma: float, points: int) -> float:
    """Return 1 over the standard deviation of the direction of the larger of two sums of squares.

    The deviation is ``sigma sqrt(strong) / (strong - weak)``, which is ``sigma / sqrt(strong)`` for a clear one. Noise
    alone shows a ratio q with the chance ``(2 sqrt(q) / (1 + q))^points``, the test of sphericity in two dimensions.
    """
    gap = strong - weak
    if points + 3 >= JUDGED:
        chance = (2.0 * np.sqrt(strong * weak) / max(strong + weak, 1e-300)) ** points
        gap = gap if chance < CHANCE else 0.0
    return float(gap / (sigma * np.sqrt(max(strong, 1e-300))))


def _judge(
    precision: tuple[float, float],
    sigma: float,
    count: int,
    squares: np.ndarray,
    limit: float,
    kind: type[Plane] | type[Line],
    words: Sequence[str],
) -> Any:
    """Return the excitation, refusing tilts beyond the limit by name."""
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


def _reweighted(fit: Fit[Flat], p: np.ndarray, cov: np.ndarray, robust: bool, limit: float) -> Fit[Flat]:
    """Return the fit of points with covariances (N, 3, 3), starting at one that takes them for equal."""
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
        sigma=found.sigma * typical,  # what was found, in deviations, times the typical one
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
    """Return the most likely plane of points (N, 3) with covariances (N, 3, 3), near a start."""

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
    """Return the most likely line of points (N, 3) with covariances (N, 3, 3), near a start."""

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
    """Return distances (N, k), the root of their covariance (N, k, k), and where the points (N, 3) most likely are."""
    e, CD = away @ D.T, cov @ D.T
    S = D @ CD
    return e, np.linalg.cholesky(S), away - (CD @ np.linalg.solve(S, e[..., None]))[..., 0]


def _whitened(e: np.ndarray, J: np.ndarray, root: np.ndarray) -> Measurement:
    """Return distances (N, k) in deviations: the descent then judges its steps by the whole cost."""
    k = e.shape[1]
    return Measurement(
        np.linalg.solve(root, e[..., None])[..., 0], np.linalg.solve(root, J), np.eye(k), ("distance",) * k
    )


@dataclass(frozen=True, eq=False)
class OffsetCheck:
    """Distances of points from a known plane, up to one constant.

    Attributes
    ----------
    offset : the constant, mean of the points that agree [m]. sd : its standard deviation [m].
    sigma : noise of a distance [m].
    distances : (N,) signed, from the plane [m]. outliers : (N,) points that are not at the common distance.
    """

    offset: float
    sd: float
    sigma: float
    distances: np.ndarray
    outliers: np.ndarray

    def text(self) -> str:
        """Return a line on the constant, and one per outlier."""
        lines = [f"offset {self.offset:.6g} +- {self.sd:.2g} m, noise {self.sigma:.2g} m"]
        lines += [f"point {i}: {self.distances[i] - self.offset:+.6g} m off" for i in np.flatnonzero(self.outliers)]
        return "\n".join(lines)


def check_offset(plane: Plane, p: ArrayLike, *, noise: float | None = None) -> OffsetCheck:
    """Check that points lie at one distance from a known plane, whatever that distance is.

    Half of the points but one may be anywhere. The constant is that of the probe's tip: its radius, or its length.

    Parameters
    ----------
    plane : known, as from a file of a tracker. p : (N, 3) points, N >= 3 [m].
    noise : standard deviation of each distance [m]; estimated when left out.

    Raises
    ------
    ShapeError : points are no (N, 3) or not finite. NotExcited : fewer than three points.
    """
    if not isinstance(plane, Plane):
        raise ShapeError(f"Expected a Plane, got {type(plane).__name__}. Plane.of makes one from a normal and a point.")
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
            f"Expected at least 2 points that agree on a distance, got {int(kept.sum())}. Measure more points.",
            ["offset"],
            [f"{int(kept.sum())} points"],
        )
    found, _ = refit(kept)
    sd = max(sigma or found, rounding(p)) / float(np.sqrt(kept.sum()))
    outliers = ~kept
    for array in (heights, outliers):
        array.flags.writeable = False
    return OffsetCheck(float(heights[kept].mean()), sd, found, heights, outliers)
