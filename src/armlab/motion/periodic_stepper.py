"""A rhythmic movement primitive sample by sample, for a control loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import number
from armlab.errors import ShapeError
from armlab.motion._setting import vector

if TYPE_CHECKING:
    from armlab.motion.periodic_dmp import PeriodicDmp

__all__ = ["PeriodicStepper"]


class PeriodicStepper:
    """One run of a `PeriodicDmp`, sample by sample; made by `PeriodicDmp.stepper`. The numbers of its rollout."""

    def __init__(
        self, dmp: PeriodicDmp, start: tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray], phase: float
    ):
        self._n, self._first, self._phase = dmp.n, start, phase
        self._kernel = kernels.PrimitiveStepper(dmp.primitive_from(phase))
        self.reset()

    def reset(self) -> None:
        """Go back to the start, with the first baseline, amplitude and period."""
        tau, y0, v0, g, scale = self._first
        self._g, self._scale = g, scale
        self._kernel.start(y0, v0, g, scale, tau)

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
            return self._kernel.step(dt)
        except TypeError:
            number(dt, "dt [s]")  # says it in a sentence
            raise

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and acceleration now, each (n,)."""
        return self._kernel.outputs()

    @property
    def phase(self) -> float:
        """Phase phi now [rad], growing."""
        return self._phase + self._kernel.elapsed

    def change(self, *, g: ArrayLike | None = None, r: float | None = None, period: float | None = None) -> None:
        """Go on with another baseline, amplitude or period; position and velocity do not jump.

        Parameters
        ----------
        g : (n,) baseline. r : factor on the motion around it. period : [s].

        Raises
        ------
        ShapeError : another shape, not finite, no positive period.
        """
        goal = self._g if g is None else vector(g, "g", self._n)
        amplitude = self._scale[0] if r is None else number(r, "r")
        seconds = self._kernel.tau * 2 * np.pi if period is None else number(period, "period [s]")
        if not np.isfinite(amplitude) or not 0.0 < seconds < np.inf:
            raise ShapeError(
                f"Expected a finite r and a period above zero, got {amplitude:g} and {seconds:g} s. Correct them."
            )
        self._g, self._scale = goal, np.full(self._n, amplitude)
        self._kernel.change_tau(seconds / (2 * np.pi))
        self._kernel.change_goal(self._g, self._scale)
