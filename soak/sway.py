"""Controller that sways all joints indefinitely: `armlab run yumi_left soak/sway.py`."""

from __future__ import annotations

import numpy as np

from armlab.state import Command, State

SPEED = 0.1  # rad/s, largest speed
SLOWEST = 0.05  # Hz, frequency of the first joint; each further joint sways faster
RETURN = 0.2  # 1/s, rate that removes the deviation caused by other commanding clients


class Sway:
    """Velocities whose integral stays within 0.7 rad of the initial joint positions."""

    def __init__(self) -> None:
        self._middle: np.ndarray | None = None

    def __call__(self, state: State) -> Command:
        """Return the velocities for a state."""
        if self._middle is None:
            self._middle = state.q.copy()
        pace = 2.0 * np.pi * SLOWEST * (1.0 + 0.1 * np.arange(len(state.q)))
        wanted = SPEED / pace * np.sin(pace * state.t)
        return Command(qd=SPEED * np.cos(pace * state.t) + RETURN * (self._middle + wanted - state.q))


controller = Sway()
