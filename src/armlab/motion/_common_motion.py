"""What several demonstrations have in common: the size, start and goal that the weights are stored for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.errors import ConfigError, ShapeError
from armlab.motion._demos import Demo
from armlab.motion._setting import UNSCALED, rotation

__all__ = ["Reference", "aligned"]


@dataclass(frozen=True)
class Reference:
    """Means over the demonstrations, and the factors s (M, n) from the reference to each."""

    duration: float
    y0: np.ndarray
    g: np.ndarray
    extent: np.ndarray
    scales: np.ndarray

    @classmethod
    def of(cls, demos: list[Demo], scaling: str, starts: np.ndarray, goals: np.ndarray) -> Reference:
        """Average demonstrations.

        Parameters
        ----------
        demos : M of them. scaling : of the primitive. starts, goals : (M, n).
        """
        y0, g = starts.mean(axis=0), goals.mean(axis=0)
        extent = np.mean([np.ptp(demo.y, axis=0) for demo in demos], axis=0)
        scales = np.ones_like(starts)
        if scaling == "goal" and len(demos) > 1:
            way, told = g - y0, abs(g - y0) > UNSCALED * extent
            scales = np.where(told, (goals - starts) / np.where(told, way, 1.0), 1.0)
        return cls(float(np.mean([demo.duration for demo in demos])), y0, g, extent, scales)


def aligned(demos: list[Demo], scaling: str) -> list[Demo]:
    """Return demonstrations turned and scaled to the mean displacement, where the scaling is "rotate".

    Raises
    ------
    ConfigError : not three coordinates. ShapeError : no displacement, or half a turn.
    """
    if scaling != "rotate":
        return demos
    if demos[0].y.shape[1] != 3:
        raise ConfigError(f"Expected three coordinates for scaling 'rotate', got {demos[0].y.shape[1]}. Use 'goal'.")
    ways = [demo.y[-1] - demo.y[0] for demo in demos]
    mean, start = np.mean(ways, axis=0), np.mean([demo.y[0] for demo in demos], axis=0)
    if not np.linalg.norm(mean) > UNSCALED * max(np.ptp(demo.y, axis=0).max() for demo in demos):
        raise ShapeError(
            "Expected demonstrations that end away from their start for scaling 'rotate', got hardly any displacement. "
            "Use scaling 'none' or 'amplitude'."
        )
    if len(demos) == 1:
        return demos
    turns = [rotation(way, mean) for way in ways]
    return [Demo(demo.t, start + (demo.y - demo.y[0]) @ turn.T, demo.weights) for demo, turn in zip(demos, turns)]
