"""A movement primitive among obstacles sample by sample, and as a controller of the bridge."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ConfigError
from armlab.motion._setting import Setting, vector
from armlab.motion.control import Limits
from armlab.motion.controllers import DmpController
from armlab.motion.obstacles import AvoidingDmp, Capsule, rows_of
from armlab.motion.rollout import RunOptions
from armlab.motion.stepper import Stepper

if TYPE_CHECKING:
    from armlab.log import Column

__all__ = ["AvoidingController", "AvoidingStepper"]


class AvoidingStepper(Stepper):
    """One run of an `AvoidingDmp`, sample by sample; made by `AvoidingDmp.stepper`.

    Parameters
    ----------
    avoiding : what runs. run : start, goal and time of it. around : `armlab.kernels.Obstacles`, its own.
    """

    def __init__(self, avoiding: AvoidingDmp, run: Setting, around: Any) -> None:
        self._around, self._avoiding = around, avoiding
        super().__init__(run, around=around)

    def reset(self) -> None:
        """Go back to the start, with the first goal, duration and obstacles."""
        self.place(self._avoiding.obstacles)
        super().reset()

    def place(self, obstacles: Iterable[Capsule]) -> None:
        """Put obstacles where they are now; until the next time they go on with their velocity.

        Parameters
        ----------
        obstacles : all that there are.

        Raises
        ------
        ShapeError : of another space.
        """
        self._around.place(rows_of(obstacles, self._avoiding.axes))

    def change_goal(self, g: ArrayLike) -> None:
        """Go for another goal from now on.

        Parameters
        ----------
        g : (n,) goal, in the unit of y.

        Raises
        ------
        ShapeError : within the clearance of an obstacle where that is now, and as of `Stepper.change_goal`.
        """
        self._avoiding.check_clear("goal", vector(g, "g", self._avoiding.n), self._around)
        super().change_goal(g)

    @property
    def distance(self) -> float:
        """Least distance from the surface of any obstacle now [m]."""
        return float(self._around.distance(self.state[0]))


class AvoidingController(DmpController):
    """An `AvoidingDmp` of joints as a controller; made by `AvoidingDmp.controller`.

    It ends the run where the arm starts within the clearance.

    Parameters
    ----------
    avoiding : what runs, with its robot. settings : duration and g of its stepper. limits : as of `Controller`.

    Raises
    ------
    ConfigError : no robot. ShapeError : as of `AvoidingDmp.stepper` and `Controller`.
    """

    _dmp: AvoidingDmp
    _stepper: AvoidingStepper

    def __init__(
        self, avoiding: AvoidingDmp, settings: RunOptions, limits: Limits | Sequence[Limits] | None = None
    ) -> None:
        if avoiding.robot is None:
            raise ConfigError("Expected an AvoidingDmp of the joints of a robot, got one in space. Give robot=.")
        super().__init__(avoiding.robot, avoiding, settings, limits)

    def place(self, obstacles: Iterable[Capsule]) -> None:
        """Put obstacles where they are now, while it runs or before; see `AvoidingStepper.place`.

        Parameters
        ----------
        obstacles : all that there are.
        """
        self._dmp = replace(self._dmp, obstacles=tuple(obstacles))
        self._stepper.place(self._dmp.obstacles)

    def columns(self) -> dict[str, Column]:
        """Return what it records, for ``link.run(extra=...)``."""
        from armlab.log import Column

        return super().columns() | {"distance": Column((), unit="m")}

    def _record(self) -> dict[str, Any]:
        return {"distance": np.float64(self._stepper.distance)}
