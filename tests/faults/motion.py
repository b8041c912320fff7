"""What the controller of these tests does: hold for a time, sway, stop."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armlab.state import Command, State

__all__ = ["Motion"]

AMPLITUDE, RATE = 0.1, 4.0  # rad, rad/s


@dataclass
class Motion:
    """Sways from where the last reference left the arm; positions, so that time that was lost would be a jump.

    Attributes
    ----------
    holds : virtual time in which it holds, as (begin, end) [s]. stops : from when on it ends the run [s].
    """

    holds: tuple[float, float] = (0.0, 0.0)
    stops: float = math.inf
    _from: tuple[int, float, np.ndarray] | None = None

    def begin_anew(self) -> None:
        """Sway from where the arm is then: another controller was in charge."""
        self._from = None

    def __call__(self, t: float, state: State) -> Command | None:
        if t >= self.stops:
            return Command.stop()
        if self.holds[0] <= t < self.holds[1]:
            self.begin_anew()
            return None
        if self._from is None or self._from[0] != state.session:
            self._from = state.session, state.t, state.q_sent
        _, since, q = self._from
        return Command(q + AMPLITUDE * (1.0 - math.cos(RATE * (state.t - since))))
