"""What data a model was fitted to: ranges of position and speed, and how much the arm rested."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._numbers import still
from armlab.errors import ShapeError

__all__ = ["SPEED_EDGES", "Training"]

SPEED_EDGES = np.array([0.0, 0.01, 0.03, 0.1, 0.3, 1.0])
"""Lower edges of the bins of speed, as shares of the training's peak; the last bin is faster than anything trained."""
SPEED_EDGES.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Training:
    """Limits of the data behind a model; outside them its quality figures say nothing.

    Attributes
    ----------
    q_min, q_max : (n,) range of position [rad]. qd_peak : (n,) largest speed [rad/s].
    speed_share : (n, 12) share of samples per bin of `SPEED_EDGES`: six of negative velocity, then six of positive,
        slowest first.
    rest_share : share of samples at which every joint is slower than 1 % of its peak.
    longest_rest : longest stretch of such samples [s].
    """

    q_min: np.ndarray
    q_max: np.ndarray
    qd_peak: np.ndarray
    speed_share: np.ndarray
    rest_share: float
    longest_rest: float

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        n = len(self.q_min)
        shapes = {"q_min": (n,), "q_max": (n,), "qd_peak": (n,), "speed_share": (n, 2 * len(SPEED_EDGES))}
        for name, shape in shapes.items():
            values = still(getattr(self, name), f"{name} of the training")
            if values.shape != shape or not np.all(np.isfinite(values)):
                raise ShapeError(f"Expected finite {name} of shape {shape} of the training, got {values.shape}.")
            object.__setattr__(self, name, values)
        if not (0.0 <= self.rest_share <= 1.0 and 0.0 <= self.longest_rest < np.inf):
            raise ShapeError(
                f"Expected a share of rest from 0 to 1 and a length from 0 s, got {self.rest_share:g} and "
                f"{self.longest_rest:g} s. Identify again."
            )
