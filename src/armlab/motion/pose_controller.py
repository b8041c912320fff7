"""A movement primitive of poses as a controller of the bridge, through inverse kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from math import dist
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ShapeError
from armlab.kinematics import forward, inverse
from armlab.lie import so3
from armlab.motion._poses import matrix, pose
from armlab.motion.control import NEAR, Controller, Limits, Pace, steps_in
from armlab.robots import Robot
from armlab.state import State

if TYPE_CHECKING:
    from armlab.motion.pose_dmp import PoseDmp

__all__ = ["PoseDmpController"]


class PoseDmpController(Controller):
    """A `PoseDmp`: the tool is led along the path of poses, in base axes, whatever the arm does.

    The joints are those nearest to the ones before. `goal` is a pose (4, 4). A pose on the way that the arm does not
    reach ends the run; `reason` says so.

    Parameters
    ----------
    robot, limits : as of `Controller`. dmp : the primitive. settings : duration and goal of its stepper.

    Raises
    ------
    ShapeError : a goal that the arm does not reach within its limits. ConfigError : as `PoseDmp.stepper`.
    """

    def __init__(self, robot: Robot, dmp: PoseDmp, settings: Mapping[str, Any], limits: Limits | None = None) -> None:
        self._robot, self._dmp, self._duration = robot, dmp, settings["duration"]
        dmp.stepper(**settings)
        super().__init__(robot, limits, dmp.T_goal if settings["goal"] is None else settings["goal"])

    def _checked(self, g: ArrayLike) -> np.ndarray:
        goal = matrix(*pose(g, "goal"))
        if not inverse(self._robot, goal).success:
            raise ShapeError(
                f"Expected a goal that {self._robot.name} reaches within its limits, got one out of reach."
            )
        return goal

    def _begin(self, state: State) -> None:
        start = forward(self._robot, state.q)
        self._stepper = self._dmp.stepper(duration=self._duration, start=start, twist0=np.zeros(6), goal=self._goal)
        self._T_base_tool, self._elapsed = start, 0.0
        self._q, self._qd = state.q, np.zeros_like(state.q)

    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        parts, way = steps_in(dt), 0.5 * (pace[0] + pace[1]) * dt
        for _ in range(parts if way > 0.0 else 0):
            self._T_base_tool = self._stepper.step(way / parts)[0]
        self._elapsed += way
        if dt == 0.0:
            return self._q, self._qd, np.zeros_like(self._q), self._q
        found = inverse(self._robot, self._T_base_tool, self._q, starts=1)
        if not found.success:
            raise ShapeError(
                f"Expected a path that {self._robot.name} reaches, got one that it leaves: {found.reason}."
            )
        qd = (found.q - self._q) / dt
        qdd = (qd - self._qd) / dt
        self._q, self._qd = found.q, qd
        return found.q, qd, qdd, found.q

    def _change_goal(self, g: np.ndarray) -> None:
        self._stepper.change_goal(g)

    def _is_near(self, state: State) -> bool:
        T_base_tool = forward(self._robot, state.q)
        turned = so3.angle(T_base_tool[:3, :3], self._goal[:3, :3])
        return bool(turned < NEAR) and dist(T_base_tool[:3, 3], self._goal[:3, 3]) < NEAR

    @property
    def _is_over(self) -> bool:
        return self._elapsed >= (self._dmp.duration if self._duration is None else self._duration)
