"""Limits of a robot whose axes are not its joints, where they belong: on ABB's axes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from armlab.bridge.limits import Limiter, Limits, Reply
from armlab.robots import Robot
from armlab.wire.egm.axes import Linkage

__all__ = ["LinkedLimiter", "axes_of", "limiter_of"]


class LinkedLimiter(Limiter):
    """A `Limiter` of axes: ABB limits positions, speeds and accelerations of axes, the controller speaks of joints.

    Parameters
    ----------
    limits : of the axes. linkage : between the two. reach : see `Limiter`.
    """

    def __init__(self, limits: Limits, linkage: Linkage, reach: tuple[Any, Any] = (-np.inf, np.inf)) -> None:
        super().__init__(limits, reach)
        self._linkage = linkage

    @property
    def q(self) -> np.ndarray:
        """(n,) position sent last, of the joints."""
        return self._linkage.joints(super().q)

    def rest(self, q: np.ndarray) -> Reply:
        """Stand still at `q` (n,), as `Limiter.rest`."""
        return self._linkage.heard(super().rest(self._linkage.axes(q)))

    def follow(self, q: np.ndarray, qd: np.ndarray) -> Reply:
        """Go along with an arm at `q` and `qd` (n,), as `Limiter.follow`."""
        return self._linkage.heard(super().follow(self._linkage.axes(q), self._linkage.axes(qd)))

    def step(self, q: np.ndarray | None, qd: np.ndarray | None, dt: float, longest: float = np.inf) -> Reply:
        """Return the reference for `q` and `qd` (n,) of the joints, as `Limiter.step`."""
        wanted, speed = (None if values is None else self._linkage.axes(values) for values in (q, qd))
        return self._linkage.heard(super().step(wanted, speed, dt, longest))


def limiter_of(limits: Limits, robot: Robot) -> Limiter:
    """Return the limiter of a robot: of its joints, or of its axes where they differ.

    Parameters
    ----------
    limits : of the robot. robot : the arm.

    Raises
    ------
    RobotError : see `Linkage.of`.
    """
    linkage, reach = Linkage.of(robot), (robot.q_min, robot.q_max)
    return Limiter(limits, reach) if linkage is None else LinkedLimiter(limits, linkage, reach)


def axes_of(robot: Robot) -> Callable[[np.ndarray], np.ndarray]:
    """Return what makes positions (n,) of a robot's joints those that its limits are about: of ABB's axes.

    Parameters
    ----------
    robot : the arm; one whose axes are its joints gives them back as they are.

    Raises
    ------
    RobotError : see `Linkage.of`.
    """
    linkage = Linkage.of(robot)
    return _same if linkage is None else linkage.axes


def _same(joints: np.ndarray) -> np.ndarray:
    return joints
