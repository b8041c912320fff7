"""A plain movement primitive, and one with two degrees of freedom, as controllers of the bridge."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import ShapeError
from armlab.motion.control import Arms, Controller, Limits, Pace, robots_of, steps_in
from armlab.state import State

if TYPE_CHECKING:
    from armlab.log import Column
    from armlab.motion.dmp import Dmp
    from armlab.motion.obstacles import AvoidingDmp
    from armlab.motion.pacing import PacedDmp
    from armlab.motion.two_dof import TwoDofDmp

__all__ = ["DmpController", "TwoDofController", "check_joints"]


def check_joints(robot: Arms, n: int) -> None:
    """Refuse a motion of another number of joints.

    Parameters
    ----------
    robot : the arm, or several. n : coordinates of the motion.

    Raises
    ------
    ShapeError : they do not fit.
    """
    arms = robots_of(robot)
    if n != sum(arm.n for arm in arms):
        names = " and ".join(arm.name for arm in arms)
        raise ShapeError(
            f"Expected a motion of {sum(arm.n for arm in arms)} joints for {names}, got one of {n} coordinates."
        )


class DmpController(Controller):
    """A plain `Dmp`: the arm is told the path and its velocity, whatever it does.

    Parameters
    ----------
    robot, limits : as of `Controller`. dmp : the primitive. settings : duration, g, amplitude of its stepper.

    Raises
    ------
    ShapeError : another number of joints, a goal outside the limits. ConfigError : as `Dmp.stepper`.
    """

    def __init__(
        self,
        robot: Arms,
        dmp: Dmp | AvoidingDmp | PacedDmp,
        settings: Mapping[str, Any],
        limits: Limits | Sequence[Limits] | None = None,
    ) -> None:
        check_joints(robot, dmp.n)
        self._dmp, self._settings = dmp, settings
        self._stepper: Any = dmp.stepper(**settings)
        super().__init__(robot, limits, self._stepper.goal)

    def _begin(self, state: State) -> None:
        given = {**self._settings, "g": self._goal, "y0": state.q, "v0": np.zeros_like(state.q)}
        self._stepper = self._dmp.stepper(**given)

    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        before, speed, change = pace
        parts, way = steps_in(dt), 0.5 * (before + speed) * dt
        for _ in range(parts if way > 0.0 else 0):
            self._stepper.step(way / parts)
        y, yd, ydd = self._stepper.state
        return y, speed * yd, speed**2 * ydd + change * yd, y

    def _change_goal(self, g: np.ndarray) -> None:
        self._stepper.change_goal(g)

    @property
    def _is_over(self) -> bool:
        return self._stepper.t >= self._stepper.duration


class TwoDofController(Controller):
    """A `TwoDofDmp`: the reference is the twice integrated acceleration of its law, with the arm as measured.

    Parameters
    ----------
    robot, limits : as of `Controller`. two_dof : the law. settings : duration, g, amplitude of its stepper.
    give_way : acceleration (n,) that a contact adds.

    Raises
    ------
    ShapeError : another number of joints, a goal outside the limits. ConfigError : as `Dmp.stepper`.
    """

    def __init__(
        self,
        robot: Arms,
        two_dof: TwoDofDmp,
        settings: Mapping[str, Any],
        limits: Limits | Sequence[Limits] | None = None,
        give_way: Callable[[State], np.ndarray] | None = None,
    ) -> None:
        check_joints(robot, two_dof.dmp.n)
        self._two_dof, self._settings, self._give_way = two_dof, settings, give_way
        self.stepper = two_dof.stepper(**settings)
        super().__init__(robot, limits, self.stepper.goal)

    def columns(self) -> dict[str, Column]:
        """Return what it records, for ``link.run(extra=...)`` and `TwoDofDmp.recorded`."""
        from armlab.log import Column

        own = {"path_qd": Column((self._n,), unit="rad/s"), "path_qdd": Column((self._n,), unit="rad/s^2")}
        own |= {"path_error": Column((self._n,), unit="rad"), "phase": Column((), unit="1")}
        return super().columns() | own | {"tau_a": Column((), unit="s")}

    def _begin(self, state: State) -> None:
        given = {**self._settings, "g": self._goal, "y0": state.q, "v0": np.zeros_like(state.q)}
        self.stepper = self._two_dof.stepper(**given)
        self._qdd = np.zeros_like(state.q)

    def _next(self, state: State, dt: float, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        found = self.stepper.step(dt, state.q, state.qd, np.array(pace))
        q, _, qd = self._sent
        if dt > 0.0:
            gained = dt * self._qdd
            q, qd = q + dt * qd + (0.5 * dt) * gained, qd + gained
        self._qdd = found.ydd_ref if self._give_way is None else found.ydd_ref + self._give_way(state)
        self.frozen = self.stepper.frozen
        self._found = found
        return q, qd, self._qdd, found.yc

    def _record(self) -> dict[str, Any]:
        found, stepper = self._found, self.stepper
        of_path = {"path_qd": found.ycd, "path_qdd": found.ycdd, "path_error": stepper.e}
        return of_path | {"phase": stepper.x, "tau_a": stepper.tau_a}

    def _change_goal(self, g: np.ndarray) -> None:
        self.stepper.change_goal(g)

    @property
    def _is_over(self) -> bool:
        return self.stepper.has_ended
