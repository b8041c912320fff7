"""A rhythmic movement primitive as a controller of the bridge: the motion grows from rest, and fades to rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab._numbers import number
from armlab.errors import ShapeError
from armlab.motion.control import Arms, Controller, Limits, Pace, steps_in
from armlab.motion.controllers import check_joints
from armlab.state import State

if TYPE_CHECKING:
    from armlab.motion.periodic_dmp import PeriodicDmp

__all__ = ["PeriodicController"]


class PeriodicController(Controller):
    """A `PeriodicDmp`: from rest at the baseline the motion grows over a turn, and over the last one it fades.

    `goal` is the baseline; it may be set while it runs.

    Parameters
    ----------
    robot, limits : as of `Controller`. dmp : the primitive.
    settings : period, g and r of its stepper; turns, infinity for ever.

    Raises
    ------
    ShapeError : another number of joints, a baseline outside the limits, no turns above zero, as `PeriodicDmp.stepper`.
    """

    def __init__(
        self,
        robot: Arms,
        dmp: PeriodicDmp,
        settings: Mapping[str, Any],
        limits: Limits | Sequence[Limits] | None = None,
    ) -> None:
        check_joints(robot, dmp.n)
        period, self._r, self._turns = settings["period"], settings["r"], number(settings["turns"], "turns")
        if not self._turns > 0.0:
            raise ShapeError(f"Expected turns above zero, got {self._turns:g}. Infinity goes on for ever.")
        dmp.stepper(period=period, r=self._r)
        self._dmp, self._period = dmp, dmp.period if period is None else float(period)
        super().__init__(robot, limits, dmp.g if settings["g"] is None else settings["g"])

    def _begin(self, state: State) -> None:
        self._elapsed = 0.0
        self._stepper = self._dmp.stepper(
            period=self._period, g=self._goal, r=0.0, y0=state.q, v0=np.zeros_like(state.q)
        )

    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        before, speed, change = pace
        parts, way = steps_in(dt), 0.5 * (before + speed) * dt
        for _ in range(parts if way > 0.0 else 0):
            self._elapsed += way / parts
            self._stepper.change(r=self._r * self._share())
            self._stepper.step(way / parts)
        y, yd, ydd = self._stepper.state
        return y, speed * yd, speed**2 * ydd + change * yd, y

    def _share(self) -> float:
        """Return how much of the amplitude there is now: a smooth step up over the first turn, down over the last."""
        turn = self._elapsed / self._period
        u = min(max(min(turn, self._turns - turn), 0.0), 1.0)
        return u * u * (3.0 - 2.0 * u)

    def _change_goal(self, g: np.ndarray) -> None:
        self._stepper.change(g=g)

    @property
    def _is_over(self) -> bool:
        return self._elapsed >= self._turns * self._period
