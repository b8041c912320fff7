"""`LaggingArm`: an arm without masses that follows its reference late, for robots of which no masses are assumed.

A dead time of two cycles and a first-order lag of 8 ms, together within ABB's 10 to 20 ms::

    q += (1 - exp(-T / 8 ms)) (q_ref[k - 2] - q)
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from armlab.robots import Robot
from armlab.sim.arm import Sample
from armlab.sim.sensors import Measurement

__all__ = ["LaggingArm"]

_DEAD_CYCLES = 2
_LAG = 8e-3  # s


class LaggingArm:
    """The kinematic stand-in of `Arm`: same reports, no torques (NaN), no noise; nobody can push it.

    Parameters
    ----------
    robot : the description. period : time between two packets [s]. q : (n,) start; the home posture by default.

    Attributes
    ----------
    robot, period : as given. sample : the state. has_torque : False.
    """

    has_torque = False

    def __init__(self, robot: Robot, period: float = 0.004032, q: np.ndarray | None = None) -> None:
        self.robot, self.period = robot, period
        self._share = 1.0 - math.exp(-period / _LAG)
        self._unknown = np.full(robot.n, np.nan)
        self._unknown.setflags(write=False)
        self._calm = np.zeros(6)
        self.place(robot.q_home if q is None else q)

    def place(self, q: np.ndarray) -> None:
        """Put the arm at rest at `q`.

        Parameters
        ----------
        q : (n,) posture.
        """
        self._q = np.array(q, dtype=np.float64)
        self._under_way = deque([self._q] * _DEAD_CYCLES)
        self._report(np.zeros_like(self._q), self._q)

    def step(self, q_ref: np.ndarray, qd_ref: np.ndarray, wrench: np.ndarray | None) -> None:
        """Advance by one period.

        Parameters
        ----------
        q_ref : (n,) reference. qd_ref, wrench : as for `Arm`; without effect.
        """
        self._under_way.append(np.array(q_ref))
        moved = self._share * (self._under_way.popleft() - self._q)
        self._q = self._q + moved
        self._report(moved / self.period, q_ref)

    def measure(self) -> Measurement:
        """Return position and velocity; the torque is NaN."""
        return Measurement(self._q, self.sample.qd, self._unknown)

    def _report(self, qd: np.ndarray, q_ref: np.ndarray) -> None:
        none = self._unknown
        self.sample = Sample(self._q, qd, none, none, none, none, q_ref, self._calm, self.robot.chain.forward(self._q))
