"""Demonstrations: validation, mean displacement, start and goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ConfigError, ShapeError
from armlab.motion.primitive.equation import UNSCALED
from armlab.motion.primitive.run import rotation

FEWEST = 3  # minimum number of samples
LISTED = 10  # largest number of row numbers in a message
REVERSAL = 1e-3  # fraction of the displacement above which a step back is a reversal
PAUSE = 0.05  # fraction of the duration above which a standstill is a pause


@dataclass(frozen=True)
class Demo:
    """One demonstration: t (N,) from 0 [s], y (N, n), and sample weights (N,) with mean 1.

    Coordinates are contiguous in memory, because most operations on y run along time.
    """

    t: np.ndarray
    y: np.ndarray
    weights: np.ndarray

    @property
    def duration(self) -> float:
        return float(self.t[-1])

    @cached_property
    def velocity(self) -> np.ndarray:
        """Central differences at the actual time stamps (N, n), one-sided at the ends."""
        return np.gradient(self.y, self.t, axis=0)

    @cached_property
    def acceleration(self) -> np.ndarray:
        """Finite differences of the velocity (N, n)."""
        return np.gradient(self.velocity, self.t, axis=0)

    @cached_property
    def behind(self) -> np.ndarray:
        """Whether each coordinate is behind its maximum by more than REVERSAL (N, n); all True if the coordinate has no
        displacement."""
        way = self.y[-1] - self.y[0]
        forward = self.y * np.sign(way)
        return np.maximum.accumulate(forward, axis=0) - forward > np.where(way != 0, REVERSAL * abs(way), -1.0)

    def steps_back(self, i: int) -> int | None:
        """Return the first sample at which coordinate i moves backwards, or None."""
        back = np.flatnonzero(self.behind[:, i])
        return int(back[0]) if len(back) else None

    def pauses(self, i: int) -> int | None:
        """Return the first sample of a pause of coordinate i, or None."""
        p = np.maximum.accumulate((self.y[:, i] - self.y[0, i]) / (self.y[-1, i] - self.y[0, i]))
        inside = np.flatnonzero((p > REVERSAL) & (p < 1.0 - REVERSAL))
        later = np.searchsorted(self.t, self.t[inside] + PAUSE * self.duration).clip(max=len(p) - 1)
        still = np.flatnonzero(p[later] - p[inside] < REVERSAL)
        return int(inside[still[0]]) if len(still) else None


def read_demos(t: Any, y: Any, sample_weights: Any) -> list[Demo]:
    """Return the demonstrations given as a pair of arrays or as lists of arrays."""
    many = isinstance(t, Sequence) and len(t) > 0 and np.ndim(t[0]) == 1
    if not many:
        return [_demo(t, y, sample_weights, "")]
    weights = [None] * len(t) if sample_weights is None else sample_weights
    if not (isinstance(y, Sequence) and isinstance(weights, Sequence) and len(y) == len(weights) == len(t)):
        raise ShapeError(
            f"Expected {len(t)} arrays in y and sample_weights, as in t, got different lengths. Pass lists of equal "
            "length."
        )
    demos = [_demo(*parts, f" of demonstration {k}") for k, parts in enumerate(zip(t, y, weights))]
    widths = {demo.y.shape[1] for demo in demos}
    if len(widths) > 1:
        raise ShapeError(
            f"Expected demonstrations with equal numbers of coordinates, got {sorted(widths)}. Fit them separately."
        )
    return demos


def _demo(t: ArrayLike, y: ArrayLike, weights: ArrayLike | None, which: str) -> Demo:
    times, values = numbers(t, f"t{which}", ShapeError), numbers(y, f"y{which}", ShapeError)
    values = values[:, None] if values.ndim == 1 else values
    if times.ndim != 1 or values.ndim != 2 or len(values) != len(times) or not values.shape[1]:
        raise ShapeError(
            f"Expected t (N,) and y (N, n){which}, got shapes {times.shape} and {np.shape(y)}. Put time on axis 0."
        )
    if len(times) < FEWEST:
        raise ShapeError(f"Expected at least {FEWEST} samples{which}, got {len(times)}. Record the whole motion.")
    if not (np.isfinite(times).all() and np.isfinite(values).all()):
        rows = np.flatnonzero(~(np.isfinite(times) & np.isfinite(values).all(axis=1)))
        raise ShapeError(f"Expected finite t and y{which}, got NaN or Inf in rows {_listed(rows)}. Drop these rows.")
    rows = np.flatnonzero(np.diff(times) <= 0) + 1
    if len(rows):
        raise ShapeError(
            f"Expected increasing times{which}, got repeated or earlier times in rows {_listed(rows)}. Drop these rows."
        )
    given = np.ones(len(times)) if weights is None else numbers(weights, f"sample_weights{which}", ShapeError)
    if given.shape != times.shape or not np.isfinite(given).all() or given.min() < 0 or not given.any():
        raise ShapeError(
            f"Expected sample_weights (N,){which}, finite, >= 0 and not all 0, got shape {given.shape}. Correct them."
        )
    return Demo(times - times[0], np.asfortranarray(values), given / given.mean())


def _listed(rows: np.ndarray) -> str:
    text = ", ".join(map(str, rows[:LISTED]))
    return text if len(rows) <= LISTED else f"{text} and {len(rows) - LISTED} more"


@dataclass(frozen=True)
class ReferenceMotion:
    """Means over the demonstrations, and the scale factors s (M, n) from the reference to each demonstration."""

    duration: float
    y0: np.ndarray
    g: np.ndarray
    extent: np.ndarray
    scales: np.ndarray

    @classmethod
    def of(cls, demos: list[Demo], scaling: str, starts: np.ndarray, goals: np.ndarray) -> ReferenceMotion:
        """Average demonstrations with starts and goals (M, n)."""
        y0, g = starts.mean(axis=0), goals.mean(axis=0)
        extent = np.mean([np.ptp(demo.y, axis=0) for demo in demos], axis=0)
        scales = np.ones_like(starts)
        if scaling == "goal" and len(demos) > 1:
            way, moves = g - y0, abs(g - y0) > UNSCALED * extent
            scales = np.where(moves, (goals - starts) / np.where(moves, way, 1.0), 1.0)
        return cls(float(np.mean([demo.duration for demo in demos])), y0, g, extent, scales)


def aligned(demos: list[Demo], scaling: str) -> list[Demo]:
    """Return demonstrations rotated and scaled to the mean displacement if the scaling is "rotate"."""
    if scaling != "rotate":
        return demos
    if demos[0].y.shape[1] != 3:
        raise ConfigError(f"Expected three coordinates for scaling 'rotate', got {demos[0].y.shape[1]}. Use 'goal'.")
    ways = [demo.y[-1] - demo.y[0] for demo in demos]
    mean, start = np.mean(ways, axis=0), np.mean([demo.y[0] for demo in demos], axis=0)
    if not np.linalg.norm(mean) > UNSCALED * max(np.ptp(demo.y, axis=0).max() for demo in demos):
        raise ShapeError(
            "Expected demonstrations with a displacement for scaling 'rotate', got demonstrations that end close to "
            "their start. Use scaling 'none' or 'amplitude'."
        )
    if len(demos) == 1:
        return demos
    turns = [rotation(way, mean) for way in ways]
    return [Demo(demo.t, start + (demo.y - demo.y[0]) @ turn.T, demo.weights) for demo, turn in zip(demos, turns)]
