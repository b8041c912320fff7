"""What is free at run time: duration, start, goal, amplitude; and how the forcing follows them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers, positive
from armlab.errors import ConfigError, ShapeError
from armlab.lie import so3
from armlab.motion._arguments import MOST_SAMPLES

if TYPE_CHECKING:
    from armlab.motion.dmp import Dmp

__all__ = ["Setting", "check_goal", "clock", "coordinates", "goal_scale", "rotation", "vector"]

UNSCALED = 0.05  # of the range of the demonstration: displacement below which the goal does not scale a coordinate
HALF_TURN = 1e-6  # sine and cosine of an angle that no rotation between two directions is told from


@dataclass(frozen=True)
class Setting:
    """One run of a primitive, or K over one clock: arrays (n,) or (K, n), tau [s], and the kernel of its forcing."""

    dmp: Dmp
    primitive: Any
    tau: float
    y0: np.ndarray
    v0: np.ndarray
    g: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(
        cls,
        dmp: Dmp,
        runs: int | None = None,
        /,
        duration: float | None = None,
        tau_d: float | None = None,
        y0: ArrayLike | None = None,
        v0: ArrayLike | None = None,
        g: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> Setting:
        """Resolve what the caller has left out by the demonstration.

        Parameters
        ----------
        dmp : the primitive.
        runs : number of them, or 1 for as many as there are starts; None for one run of arrays (n,).
        duration, tau_d, y0, v0, g, amplitude : `RunOptions`.

        Raises
        ------
        ConfigError : both duration and tau_d; an amplitude that nothing scales; many runs with scaling "rotate".
        ShapeError : arrays of another shape, not finite; no positive time; a half turn.
        """
        tau = _tau(dmp, duration, tau_d)
        given = {"y0": y0, "v0": v0, "g": g, "amplitude": amplitude}
        parts = {name: vector(a, name, dmp.n) for name, a in given.items() if a is not None}
        if amplitude is not None and dmp.scaling != "amplitude":
            raise ConfigError(
                f"Expected an amplitude only with scaling 'amplitude', got one with {dmp.scaling!r}. Leave it out, or "
                "fit with scaling='amplitude'."
            )
        shape = (dmp.n,) if runs is None else (runs, dmp.n)
        whole = _one_run(parts, shape) if runs is None else _many_runs(dmp, parts, shape)
        start, goal = (np.broadcast_to(parts.get(name, own), whole) for name, own in (("y0", dmp.y0), ("g", dmp.g)))
        check_goal(dmp, goal)
        scale, primitive, turn = np.ones(whole), dmp.primitive, None
        if dmp.scaling == "goal":
            scale = goal_scale(dmp, start, goal)
        elif amplitude is not None:
            scale = np.broadcast_to(parts["amplitude"], whole)
        elif dmp.scaling == "rotate":
            turn = rotation(dmp.g - dmp.y0, goal - start)
            primitive = dmp.primitive_of(dmp.weights @ turn.T)
        if v0 is None:
            speed = scale * dmp.v0 if turn is None else turn @ dmp.v0
            speed = speed * (dmp.tau_d / tau)
        else:
            speed = np.broadcast_to(parts["v0"], whole)
        return cls(dmp, primitive, tau, start, np.ascontiguousarray(speed), goal, np.ascontiguousarray(scale))

    def times(self, t: ArrayLike) -> np.ndarray:
        """Return times (N,) as they are given, or from 0 in steps of t to the end of the motion [s].

        Raises
        ------
        ShapeError : no finite step above zero.
        """
        return clock(t, self.tau * self.dmp.duration / self.dmp.tau_d)

    def towards(self, g: ArrayLike, scaled: bool) -> Setting:
        """Return the run as it is with another goal (n,), its forcing scaled with the displacement or as it was.

        Raises
        ------
        ShapeError : another shape, not finite, outside the limits of the primitive.
        """
        goal = np.array(vector(g, "g", self.dmp.n))
        _one_run({"g": goal}, (self.dmp.n,))
        check_goal(self.dmp, goal)
        return replace(self, g=goal, scale=goal_scale(self.dmp, self.y0, goal) if scaled else self.scale)


def clock(t: ArrayLike, end: float) -> np.ndarray:
    """Return times (N,) as they are given, or from 0 in steps of t to the end [s].

    Raises
    ------
    ShapeError : no finite step above zero; one that is longer than the motion, or far too short.
    """
    times = numbers(t, "t", ShapeError)
    if times.ndim:
        return times
    step = positive(times, "dt", "At 250 Hz it is 0.004.")
    if not end / MOST_SAMPLES <= step <= end * (1 + 1e-12):
        raise ShapeError(
            f"Expected a dt [s] from {end / MOST_SAMPLES:.2g} to {end:g}, that of the motion, got {step:g}. At 250 Hz "
            "it is 0.004."
        )
    return step * np.arange(int(np.floor(end / step * (1 + 1e-12))) + 1)


def _tau(dmp: Dmp, duration: float | None, tau_d: float | None) -> float:
    if duration is not None and tau_d is not None:
        raise ConfigError("Expected duration or tau_d, got both. Leave one out: their ratio belongs to the primitive.")
    if tau_d is not None:
        return positive(tau_d, "tau_d [s]", "A second is a usual motion.")
    if duration is None:
        return dmp.tau_d
    return positive(duration, "duration [s]", "A second is a usual motion.") * dmp.tau_d / dmp.duration


def _one_run(parts: dict[str, np.ndarray], shape: tuple[int, ...]) -> tuple[int, ...]:
    for name, part in parts.items():
        if part.shape != shape:
            raise ShapeError(
                f"Expected {name} of shape {shape} for one run, got {part.shape}. Use rollout_batch for many, or a "
                "stepper for each run."
            )
    return shape


def _many_runs(dmp: Dmp, parts: dict[str, np.ndarray], shape: tuple[int, ...]) -> tuple[int, ...]:
    if dmp.scaling == "rotate":
        raise ConfigError("Expected another scaling than 'rotate' for many runs, got it. Use rollout one by one.")
    try:
        return np.broadcast_shapes(shape, *(part.shape for part in parts.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {part.shape}" for name, part in parts.items())
        raise ShapeError(f"Expected arrays of one number K of runs, got {shapes}. Give (K, n) or (n,).") from None


def vector(value: ArrayLike, what: str, n: int) -> np.ndarray:
    """Return finite numbers (..., n), one per coordinate.

    Raises
    ------
    ShapeError : another shape, or not finite.
    """
    array = numbers(value, what, ShapeError)
    if array.ndim < 1 or array.shape[-1] != n:
        raise ShapeError(f"Expected {what} with {n} coordinates on its last axis, got shape {array.shape}.")
    if not np.isfinite(array).all():
        raise ShapeError(f"Expected a finite {what}, got {array}. Leave it out to take that of the demonstration.")
    return array


def coordinates(value: ArrayLike, what: str, n: int) -> np.ndarray:
    """Return finite numbers (n,), one per coordinate.

    Raises
    ------
    ShapeError : another shape, or not finite.
    """
    array = vector(value, what, n)
    if array.ndim != 1:
        raise ShapeError(f"Expected {what} of shape ({n},), got {array.shape}. Give one number per coordinate.")
    return array


def check_goal(dmp: Dmp, g: np.ndarray) -> None:
    """Refuse a goal outside the limits of the primitive.

    Raises
    ------
    ShapeError : it is, with its coordinates.
    """
    if dmp.limits is None:
        return
    low, high = dmp.limits
    outside = np.unique(np.nonzero((g < low) | (g > high))[-1])
    if len(outside):
        raise ShapeError(
            f"Expected a goal within limits, got coordinates {outside.tolist()} of {g} outside {low[outside]} to "
            f"{high[outside]}. Choose another goal."
        )


def goal_scale(dmp: Dmp, y0: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return displacement over that of the demonstration (..., n), 1 where the latter is too small."""
    way = dmp.g - dmp.y0
    still = np.zeros(dmp.n, dtype=bool)
    still[list(dmp.unscaled)] = True
    return np.where(still, 1.0, (g - y0) / np.where(still, 1.0, way))


def rotation(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Return the smallest rotation, times the ratio of lengths, that maps one displacement to another (3, 3).

    Raises
    ------
    ShapeError : no displacement, or a half turn, which no axis is nearest to.
    """
    a, b = np.linalg.norm(old), np.linalg.norm(new)
    if not (a > 0 and b > 0):
        raise ShapeError("Expected a goal apart from the start with scaling 'rotate', got none. Use scaling 'none'.")
    u, v = old / a, new / b
    axis, cosine = np.cross(u, v), float(u @ v)
    if cosine < 0 and np.linalg.norm(axis) < HALF_TURN:
        raise ShapeError(
            "Expected a displacement that is not opposite to that of the demonstration, got half a turn: every axis "
            "across would do. Go by way of another goal."
        )
    skew = so3.hat(axis)
    return b / a * (np.eye(3) + skew + skew @ skew / (1.0 + cosine))
