"""Parts shared by the fits of all features: checked points and noise, inliers, the sign of a normal, the result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Excitation, Fit
from armlab.frames import inputs
from armlab.frames.features import Circle, Line, Plane, Sphere
from armlab.frames.ransac import Refit, Squares, inliers

Feature = TypeVar("Feature", Plane, Line, Circle, Sphere)

LIMIT = 0.2  # rad, the largest standard deviation of a tilt that is accepted
SURE = 3.0  # deviations from which a side is sure


class Cloud:
    """Points (N, 3) with their noise, checked: enough of them to fit a feature, and its noise where it is not given."""

    def __init__(self, p: ArrayLike, noise: Any, least: int, what: str) -> None:
        self.p = inputs.points(p)
        self.sigma, self.each = inputs.noises_of(noise, len(self.p))
        self.kept = np.ones(len(self.p), dtype=bool)
        self._needed, self._what = least + (self.sigma is None), what
        inputs.enough(len(self.p), self._needed, what)

    def choose(self, size: int, numbers: int, through: Squares, refit: Refit) -> None:
        """Keep the points that belong to the feature, see `ransac.inliers`."""
        self.kept = inliers(self.p, size, numbers, through, refit, self.sigma, self._what)
        inputs.enough(int(self.kept.sum()), self._needed, self._what)


def result(
    value: Feature,
    parameters: np.ndarray,
    cov: np.ndarray,
    sigma: np.ndarray,
    residuals: np.ndarray,
    kept: np.ndarray,
    excitation: Excitation,
    summary: Callable[[Fit[Any]], str],
) -> Fit[Feature]:
    """Return the fit of a feature, its residuals in metres, what is not kept as its outliers."""
    return Fit(
        value=value,
        names=value.names,
        units=value.units,
        parameters=parameters,
        cov=cov,
        sigma=sigma,
        residuals=residuals,
        n=int(kept.sum()),
        excitation=excitation,
        summary=summary,
        outliers=~kept,
        classes=("distance [m]",),
    )


def upward(
    n: np.ndarray, c: np.ndarray, reach: float, toward: ArrayLike | None, normal: ArrayLike | None, what: str
) -> np.ndarray:
    """Return a normal with the sign that the rule gives it.

    `reach` is the standard deviation of the plane's distance from the origin [m]; see `fit_plane` for the hints.
    """
    if toward is not None and normal is not None:
        raise ShapeError("Expected toward= or normal=, got both. Either says on which side the normal is.")
    if normal is not None:
        side, least = float(n @ inputs.direction(normal, "normal")), 1e-6
    elif toward is not None:
        side, least = float(n @ (inputs.vector(toward, "toward") - c)), SURE * reach
    else:
        side, least = float(n @ c), SURE * reach
        if not abs(side) > least:
            raise NotExcited(
                f"Expected the {what} away from the origin to tell its side, got it at {abs(side):.2g} m, uncertain by "
                f"{reach:.2g} m. Say the side by toward=, a point on it, or by normal=.",
                [f"side of the {what}"],
                [f"{abs(side):.2g} m from the origin"],
            )
    if not abs(side) > least:
        raise ShapeError(
            f"Expected a hint that tells the side of the {what}, got one that lies in it. Give another point or normal."
        )
    return n if side > 0 else -n


def text(v: np.ndarray) -> str:
    """Return a vector (3,) as a report shows it."""
    return "(" + ", ".join(f"{x:.4f}" for x in v) + ")"
