"""A movement primitive of poses sample by sample, for a control loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import number
from armlab.errors import ConfigError
from armlab.motion._pose_run import PoseRun
from armlab.motion._poses import matrix

if TYPE_CHECKING:
    from armlab.motion.pose_dmp import PoseDmp

__all__ = ["PoseStepper"]

Sample = tuple[np.ndarray, np.ndarray, np.ndarray]


class PoseStepper:
    """One run of a `PoseDmp`, sample by sample; made by `PoseDmp.stepper`. The same numbers as `PoseDmp.rollout`."""

    def __init__(self, dmp: PoseDmp, run: PoseRun) -> None:
        self._dmp, self._first = dmp, run
        self._position = kernels.PrimitiveStepper(run.position.primitive)
        self._rotation = kernels.RotationStepper(dmp.rotation.primitive)
        self.reset()

    def reset(self) -> None:
        """Go back to the start, with the first goal."""
        at = self._first.position
        self._position.start(at.y0, at.v0, at.g, at.scale, at.tau)
        self._rotation.start(*self._first.turning[1:], at.tau)

    def change_goal(self, goal: ArrayLike) -> None:
        """Go for another pose from now on; both forcings are scaled as if it had been the goal from the start.

        Parameters
        ----------
        goal : pose (4, 4) or (7,).

        Raises
        ------
        ShapeError : no pose, half a turn from the start. ConfigError : a forcing in the axes of the goal.
        """
        if self._dmp.frame == "goal":
            raise ConfigError(
                "Expected a forcing in base axes for a goal that changes, got one in the axes of the goal. Start again "
                "from the pose of now, or use frame='base'."
            )
        first = self._first
        start = matrix(first.position.y0, first.q0)
        run = self._dmp.run_of(tau_d=first.position.tau, start=start, twist0=np.zeros(6), goal=goal)
        if run.position.primitive is not self._first.position.primitive:
            raise ConfigError(
                "Expected scaling 'goal' or 'none' for a goal that changes, got 'rotate'. Fit with another."
            )
        self._position.change_goal(run.position.g, run.position.scale)
        self._rotation.change_goal(run.q1, run.turning[4])

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one sample and return the pose (4, 4), the twist (6,) and its derivative (6,).

        Parameters
        ----------
        dt : time since the last sample [s], above zero.

        Raises
        ------
        ShapeError : no finite time above zero.
        """
        try:
            return self._told(self._position.step(dt), self._rotation.step(dt))
        except TypeError:
            number(dt, "dt [s]")  # says it in a sentence
            raise

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pose (4, 4), twist (6,) and its derivative (6,) now."""
        return self._told(self._position.outputs(), self._rotation.outputs())

    def _told(self, position: Sample, rotation: Sample) -> Sample:
        p, v, a = position if self._dmp.frame == "base" else np.array(position) @ self._first.A.T
        q, w, wd = rotation
        return matrix(p, q), np.concatenate((v, w)), np.concatenate((a, wd))
