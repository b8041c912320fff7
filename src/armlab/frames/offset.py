"""Points against a known plane: the tip of a probe holds all of them at one distance, but for outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import NotExcited, ShapeError
from armlab.frames import _check
from armlab.frames._cloud import rounding
from armlab.frames._consensus import chosen
from armlab.frames.features import Plane

__all__ = ["OffsetCheck", "check_offset"]


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
    p, sigma = _check.points(p), _check.noise_of(noise)
    heights = plane.distance(p)

    def through(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
        return (plane.distance(p) - plane.distance(sets[:, 0])[:, None]) ** 2

    def refit(kept: np.ndarray) -> tuple[float, np.ndarray]:
        away = heights - heights[kept].mean()
        return float(np.sqrt(np.sum(away[kept] ** 2) / max(kept.sum() - 1, 1))), away**2

    kept = chosen(p, 1, 1, through, refit, sigma, "distance")
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
