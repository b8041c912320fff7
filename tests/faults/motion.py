"""What the controller of these tests does: hold for a time, sway, stop."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armlab.state import Command, State

__all__ = ["Motion"]


@dataclass
class Motion:
    """Sways from where the last reference left the arm; positions, so that time that was lost would be a jump.

    Attributes
    ----------
    holds : virtual time in which it holds, as (begin, end) [s]. stops : from when on it ends the run [s].
    amplitude, rate : of the sway [rad, rad/s].
    """

    holds: tuple[float, float] = (0.0, 0.0)
    stops: float = math.inf
    amplitude: float = 0.1
    rate: float = 4.0
    _from: tuple[int, float, np.ndarray] | None = None

    @classmethod
    def that_stops(cls, at: float) -> Motion:
        """Be fast at a time, and stop half a cycle before: the arm needs eight more to come to rest."""
        return cls(stops=at - 0.002, amplitude=0.18, rate=6.0)

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
        return Command(q + self.amplitude * (1.0 - math.cos(self.rate * (state.t - since))))
