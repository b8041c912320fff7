"""Two-degree-of-freedom control sample by sample: `TwoDofStepper`."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ConfigError
from armlab.motion._setting import Setting
from armlab.motion.control import steps_in
from armlab.motion.two_dof_run import FULL_SPEED

if TYPE_CHECKING:
    from armlab.motion.two_dof import TwoDofDmp

__all__ = ["Reference", "TwoDofStepper", "starting"]


class Reference(NamedTuple):
    """What `TwoDofStepper.step` returns.

    Attributes
    ----------
    yc, ycd, ycdd : (n,) coupled path with velocity and acceleration. ydd_ref : (n,) acceleration to give the arm.
    """

    yc: np.ndarray
    ycd: np.ndarray
    ycdd: np.ndarray
    ydd_ref: np.ndarray


class TwoDofStepper:
    """One run of a `TwoDofDmp` with an arm that is measured; made by `TwoDofDmp.stepper`.

    Between two samples ya is taken to move with the velocity measured before, and the law is solved in steps of at most
    4 ms.

    Parameters
    ----------
    two_dof : gains and primitive. run : start, goal and duration.

    Attributes
    ----------
    goal : (n,) where it goes.
    """

    def __init__(self, two_dof: TwoDofDmp, run: Setting) -> None:
        self._two_dof, self._run = two_dof, run
        self.reset()

    def reset(self) -> None:
        """Go back to the start, with the first goal."""
        run = self._run
        self._law, self.goal = self._two_dof.law(run), run.g
        self._state = starting(run)

    def step(self, dt: float, ya: np.ndarray, yad: np.ndarray, speed: np.ndarray = FULL_SPEED) -> Reference:
        """Take a sample of the arm and return the reference of this instant.

        Parameters
        ----------
        dt : time since the last sample [s]; 0 at the first.
        ya, yad : (n,) measured position and velocity; a sample that is not finite is passed over.
        speed : (3,) speed of the primitive at the last sample and now, and its change per second from now.

        Raises
        ------
        ShapeError : another shape, or a dt that is negative or not finite.
        """
        found = self._law.follow(self._state, dt, steps_in(dt), speed, ya, yad)
        self._state, (ycd, ycdd, ydd_ref) = found
        return Reference(self._state[: self._law.n], ycd, ycdd, ydd_ref)

    def change_goal(self, g: ArrayLike) -> None:
        """Go for another goal from now on; with scaling "goal" the forcing is scaled with it.

        Parameters
        ----------
        g : (n,) goal, in the unit of y.

        Raises
        ------
        ShapeError : another shape, not finite, outside the limits of the primitive.
        ConfigError : scaling "rotate", which has no path to another goal.
        """
        scaling = self._two_dof.dmp.scaling
        if scaling == "rotate":
            raise ConfigError("Expected a goal that stays with scaling 'rotate', got another. Make another stepper.")
        run = self._run.towards(g, scaling == "goal")
        self._law, self.goal = self._two_dof.law(run), run.g

    @property
    def e(self) -> np.ndarray:
        """Filtered error (n,)."""
        return self._state[2 * self._law.n : 3 * self._law.n]

    @property
    def x(self) -> float:
        """Phase, which all coordinates share; with schedule "position" it only counts time."""
        return float(self._state[-2])

    @property
    def tau_a(self) -> float:
        """Time constant now [s]: that of the run where the arm follows, longer where it does not."""
        return self._law.time_constant(self._state)

    @property
    def frozen(self) -> bool:
        """Whether the path stands still because the arm is too far from it."""
        return bool(self._state[-1])

    @property
    def has_ended(self) -> bool:
        """Whether the phase has gone as far as in the demonstration."""
        x, dmp = self.x, self._two_dof.dmp
        if dmp.schedule == "time":
            return x >= 1.0
        return x <= np.exp(-dmp.alpha_x * dmp.duration / dmp.tau_d)


def starting(run: Setting) -> np.ndarray:
    """Return the state (5 n + 2,) at the start of a run, with the arm on the path.

    Parameters
    ----------
    run : start and duration.
    """
    x = 0.0 if run.dmp.schedule == "time" else 1.0
    return np.concatenate([run.y0, run.tau * run.v0, np.zeros(run.dmp.n), run.y0, run.v0, [x, 0.0]])
