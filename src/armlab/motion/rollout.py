"""What a movement primitive does over time."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import make_read_only

__all__ = ["Rollout", "RunOptions"]


class RunOptions(TypedDict, total=False):
    """What is free in a run of a `Dmp`, by name; what is left out or None is that of the demonstration.

    Attributes
    ----------
    duration, tau_d : of the run [s], at most one of them. y0, v0, g : (n,) start, velocity at it, goal.
    amplitude : (n,) factors on the forcing, with scaling "amplitude".
    """

    duration: float | None
    tau_d: float | None
    y0: ArrayLike | None
    v0: ArrayLike | None
    g: ArrayLike | None
    amplitude: ArrayLike | None


@dataclass(frozen=True, eq=False)
class Rollout:
    """A motion over N times; of K runs at once the arrays are (N, K, n).

    Attributes
    ----------
    t : (N,) times [s]. y, yd, ydd : (N, n) position, velocity, acceleration in the unit of the demonstration, per s and
        s^2.
    x : (N,) phase; (N, n) where every coordinate has its own. forcing : (N, n) the forcing term f, in the unit of y.
    """

    t: np.ndarray
    y: np.ndarray
    yd: np.ndarray
    ydd: np.ndarray
    x: np.ndarray
    forcing: np.ndarray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        make_read_only(self, *(field.name for field in fields(self)))
