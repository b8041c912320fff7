"""What is free at run time: duration, start, goal, amplitude; and how the forcing follows them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number, numbers
from armlab.errors import ConfigError, ShapeError
from armlab.lie import so3

if TYPE_CHECKING:
    from armlab.motion.dmp import Dmp

__all__ = ["Setting", "check_goal", "goal_scale", "rotation", "vector"]

UNSCALED = 0.05  # of the range of the demonstration: displacement below which the goal does not scale a coordinate
HALF_TURN = 1e-6  # sine and cosine of an angle that no rotation between two directions is told from


@dataclass(frozen=True)
class Setting:
    """One run, or K runs over one clock: arrays (n,) or (K, n), tau [s], and the primitive with its forcing."""

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
        duration: float | None = None,
        tau_d: float | None = None,
        y0: ArrayLike | None = None,
        v0: ArrayLike | None = None,
        g: ArrayLike | None = None,
        amplitude: ArrayLike | None = None,
    ) -> Setting:
        """Resolve what the caller has left out by the demonstration.

        Raises
        ------
        ConfigError : both duration and tau_d, or an amplitude that nothing scales.
        ShapeError : arrays of another shape, not finite; no positive time; a half turn.
        """
        tau = _tau(dmp, duration, tau_d)
        start = dmp.y0 if y0 is None else vector(y0, "y0", dmp.n)
        goal = dmp.g if g is None else vector(g, "g", dmp.n)
        if amplitude is not None and dmp.scaling != "amplitude":
            raise ConfigError(
                f"Expected an amplitude only with scaling 'amplitude', got one with {dmp.scaling!r}. Leave it out, or "
                "fit with scaling='amplitude'."
            )
        start, goal = np.broadcast_arrays(start, goal)
        check_goal(dmp, goal)
        scale, primitive, turn = np.ones(start.shape), dmp.primitive, None
        if dmp.scaling == "goal":
            scale = goal_scale(dmp, start, goal)
        elif amplitude is not None:
            scale = np.broadcast_to(vector(amplitude, "amplitude", dmp.n), start.shape)
        elif dmp.scaling == "rotate":
            turn = rotation(dmp.g - dmp.y0, goal - start)
            primitive = dmp.primitive_of(dmp.weights @ turn.T)
        if v0 is None:
            speed = scale * dmp.v0 if turn is None else turn @ dmp.v0
            speed = speed * (dmp.tau_d / tau)
        else:
            speed = np.broadcast_to(vector(v0, "v0", dmp.n), start.shape)
        return cls(primitive, tau, start, np.ascontiguousarray(speed), goal, np.ascontiguousarray(scale))


def _tau(dmp: Dmp, duration: float | None, tau_d: float | None) -> float:
    if duration is not None and tau_d is not None:
        raise ConfigError("Expected duration or tau_d, got both. Leave one out: their ratio belongs to the primitive.")
    if duration is None and tau_d is None:
        return dmp.tau_d
    name, given = ("duration [s]", duration) if tau_d is None else ("tau_d [s]", tau_d)
    value = number(given, name)
    if not 0.0 < value < np.inf:
        raise ShapeError(f"Expected a finite {name} above zero, got {value:g}. A second is a usual motion.")
    return value if tau_d is not None else value * dmp.tau_d / dmp.duration


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
    ShapeError : more than one run, no displacement, or a half turn, which no axis is nearest to.
    """
    if new.ndim != 1:
        raise ShapeError(f"Expected one start and goal with scaling 'rotate', got shape {new.shape}. Run one by one.")
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
