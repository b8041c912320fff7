"""`StandingQueue`: a receive queue that a robot does not empty.

The controller takes one message per cycle, first in, first out. Each message that stays delays every later reference
by one cycle.
"""

from __future__ import annotations

__all__ = ["StandingQueue"]

_SECONDS = 1.0  # shorter queues are replies on their way


class StandingQueue:
    """Detector of messages that wait in every cycle for 1 s."""

    def __init__(self) -> None:
        self._seconds, self._least = 0.0, 0

    def after(self, depth: int, period: float) -> str:
        """Return a sentence in the cycle in which the queue has not been empty for 1 s, else "".

        Parameters
        ----------
        depth : messages left after the controller took one; not above 0 also when it is unknown.
        period : cycle time of the robot [s].
        """
        if depth <= 0:
            self._seconds = 0.0
            return ""
        self._least = min(self._least, depth) if self._seconds else depth
        before, self._seconds = self._seconds, self._seconds + period
        if not before < _SECONDS <= self._seconds:
            return ""
        wait = "messages have waited" if self._least > 1 else "message has waited"
        late = f"so each reference acts {1e3 * self._least * period:.0f} ms late"
        return f"{self._least} {wait} in the controller's receive queue for 1 s, {late}."
