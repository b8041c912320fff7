"""`Grip`: a hand that takes the tool of the simulated arm, holds it where it is, and lets go."""

from __future__ import annotations

import numpy as np

from armlab.errors import ConfigError
from armlab.lie import so3

__all__ = ["Grip"]

STIFFNESS = np.array([800.0, 800.0, 800.0, 15.0, 15.0, 15.0])  # N/m, N m/rad
DAMPING = np.array([60.0, 60.0, 60.0, 1.0, 1.0, 1.0])  # N s/m, N m s/rad
STRENGTH = np.repeat([80.0, 8.0], 3)  # N, N m


class Grip:
    """A hand on the tool: a spring of 800 N/m and 15 N m/rad with a damper, of at most 80 N and 8 N m along each axis.

    Parameters
    ----------
    start, end : seconds of guidance time from and to which it holds.

    Raises
    ------
    ConfigError : times that are not finite, or an end that is not after the start.
    """

    def __init__(self, start: float, end: float) -> None:
        if not -np.inf < start < end < np.inf:
            raise ConfigError(f"Expected a grip from a time to a later one, got {start} to {end} s.")
        self._start, self._end = float(start), float(end)
        self._T_base_tool: np.ndarray | None = None
        self._before: tuple[float, np.ndarray] | None = None

    def at(self, t: float, T_base_tool: np.ndarray) -> np.ndarray | None:
        """Return its wrench (6,) on the robot in base axes at the tool point, None while it does not hold.

        Parameters
        ----------
        t : seconds since guidance began. T_base_tool : (4, 4) pose of the tool now.
        """
        if not self._start <= t < self._end:
            self._T_base_tool = self._before = None
            return None
        if self._T_base_tool is None:
            self._T_base_tool = T_base_tool
        held, tool = self._T_base_tool, T_base_tool
        away = np.concatenate([tool[:3, 3] - held[:3, 3], so3.log(tool[:3, :3] @ held[:3, :3].T)])
        speed = np.zeros(6)
        if self._before is not None and t > self._before[0]:
            speed = (away - self._before[1]) / (t - self._before[0])
        self._before = (t, away)
        return np.clip(-STIFFNESS * away - DAMPING * speed, -STRENGTH, STRENGTH)
