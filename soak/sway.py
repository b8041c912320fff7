"""A controller that sways all joints for ever: `armlab run yumi_left soak/sway.py`."""

from __future__ import annotations

import numpy as np

from armlab.state import Command, State

SPEED = 0.1  # rad/s at most
SLOWEST = 0.05  # Hz, of the first joint; each further one sways faster
RETURN = 0.2  # 1/s: what was not obeyed, as somebody else had the arm, is not left to add up


class Sway:
    """Velocities whose integral stays within 0.7 rad of where the joints were first."""

    def __init__(self) -> None:
        self._middle: np.ndarray | None = None

    def __call__(self, state: State) -> Command:
        """Return the velocities at the time of a state."""
        if self._middle is None:
            self._middle = state.q.copy()
        pace = 2.0 * np.pi * SLOWEST * (1.0 + 0.1 * np.arange(len(state.q)))
        wanted = SPEED / pace * np.sin(pace * state.t)
        return Command(qd=SPEED * np.cos(pace * state.t) + RETURN * (self._middle + wanted - state.q))


controller = Sway()
