"""What a movement primitive of poses does over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import make_read_only

__all__ = ["PoseRollout", "PoseRunOptions"]


class PoseRunOptions(TypedDict, total=False):
    """What is free in a run of a `PoseDmp`, by name; what is left out or None is that of the demonstration.

    Attributes
    ----------
    duration, tau_d : of the run [s], at most one of them.
    start, goal : poses (4, 4), or (7,): position, quaternion wxyz of either sign.
    twist0 : (6,) velocity and angular velocity at the start, base axes.
    """

    duration: float | None
    tau_d: float | None
    start: ArrayLike | None
    twist0: ArrayLike | None
    goal: ArrayLike | None


@dataclass(frozen=True, eq=False)
class PoseRollout:
    """A motion of poses over N times.

    Attributes
    ----------
    t : (N,) times [s]. T : (N, 4, 4) poses. q : (N, 4) their quaternions wxyz, without a jump of sign.
    twist : (N, 6) velocity and angular velocity, base axes [m/s, rad/s]. twistd : (N, 6) their derivatives.
    x : (N,) phase.
    """

    t: np.ndarray
    T: np.ndarray
    q: np.ndarray
    twist: np.ndarray
    twistd: np.ndarray
    x: np.ndarray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        make_read_only(self, "t", "T", "q", "twist", "twistd", "x")
