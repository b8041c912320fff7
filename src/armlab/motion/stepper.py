"""A movement primitive sample by sample, for a control loop."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name, number, positive
from armlab.errors import ConfigError
from armlab.motion._setting import Setting
from armlab.motion._solving import progress

__all__ = ["Stepper"]

FORCINGS = ("shift", "scale")
BRAKE = 1.05  # of the largest acceleration of the demonstration


class Stepper:
    """One run of a `Dmp`, sample by sample; made by `Dmp.stepper`.

    The same numbers as `Dmp.rollout`, with steps that may differ and a goal and duration that may change. A filtered
    goal follows ``g' = rate (goal - g) / tau_d``, and the forcing is scaled by it. A brake keeps
    ``v^2 <= 2 a |goal - y|`` after a change of goal where that can still be kept, and y on its side of the goal.

    Parameters
    ----------
    run : what runs, with start, goal and time. goal_forcing : "shift" or "scale", None for that of the scaling.
    goal_rate : of the filter, times tau_d. brake : in monotone coordinates. around : `armlab.kernels.Obstacles`.

    Raises
    ------
    UnknownName : another goal_forcing. ConfigError : "scale" without scaling "goal", a goal_rate below 0.
    """

    def __init__(
        self,
        run: Setting,
        goal_forcing: str | None = None,
        goal_rate: float = 0.0,
        brake: bool = False,
        around: Any = None,
    ) -> None:
        dmp = run.dmp
        if goal_forcing is None:
            goal_forcing = "scale" if dmp.scaling == "goal" else "shift"
        check_name(goal_forcing, "goal_forcing", FORCINGS)
        if goal_forcing == "scale" and dmp.scaling != "goal":
            raise ConfigError(
                f"Expected goal_forcing 'shift' with scaling {dmp.scaling!r}, got 'scale'. Fit with scaling='goal'."
            )
        if not 0.0 <= number(goal_rate, "goal_rate", ConfigError) < np.inf:
            raise ConfigError(f"Expected a goal_rate of at least 0, got {goal_rate:g}. 12.5 follows the spring.")
        self._dmp, self._run, self._scales = dmp, run, goal_forcing == "scale"
        self._limit = np.where(dmp.monotone, BRAKE * dmp.peak_acceleration, 0.0) if brake else None
        self._kernel = kernels.PrimitiveStepper(run.primitive, float(goal_rate), around)
        self.reset()

    def reset(self) -> None:
        """Go back to the start, with the first goal and duration."""
        run = self._run
        self._t, self._goal = 0.0, run.g
        self._kernel.start(run.y0, run.v0, run.g, run.scale, run.tau)

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one sample and return y, yd, ydd, each (n,).

        Parameters
        ----------
        dt : time since the last sample [s], above zero.

        Raises
        ------
        ShapeError : no finite time above zero.
        """
        try:
            state = self._kernel.step(dt)
        except TypeError:
            number(dt, "dt [s]")  # says it in a sentence
            raise
        self._t += dt
        return state

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and acceleration now, each (n,)."""
        return self._kernel.outputs()

    @property
    def t(self) -> float:
        """Time since the start [s]."""
        return self._t

    @property
    def x(self) -> np.ndarray:
        """Phase now; (n,) where every coordinate has its own."""
        if self._dmp.schedule == "position":
            return progress(self.state[0], self._run.y0, self._goal)
        return self._dmp.phase(self._kernel.elapsed * self._dmp.tau_d)

    @property
    def goal(self) -> np.ndarray:
        """Goal now (n,), before the filter."""
        return self._goal

    @property
    def duration(self) -> float:
        """Duration of the whole motion at the pace of now [s]."""
        return self._kernel.tau * self._dmp.duration / self._dmp.tau_d

    def change_goal(self, g: ArrayLike) -> None:
        """Go for another goal from now on.

        Parameters
        ----------
        g : (n,) goal, in the unit of y.

        Raises
        ------
        ShapeError : another shape, not finite, outside the limits of the primitive.
        """
        run = self._run.towards(g, self._scales)
        self._kernel.change_goal(run.g, run.scale, self._limit)
        self._goal = run.g

    def change_duration(self, duration: float) -> None:
        """Go on faster or slower from now on; the velocity does not jump.

        Parameters
        ----------
        duration : that the whole motion would take at this pace [s].

        Raises
        ------
        ShapeError : no finite time above zero.
        """
        value = positive(duration, "duration [s]", "A second is a usual motion.")
        self._kernel.change_tau(value * self._dmp.tau_d / self._dmp.duration)
