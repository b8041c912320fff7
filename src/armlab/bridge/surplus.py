"""`Surplus`: replies left out when the robot's queue holds more than it should.

The controller takes one message per cycle, first in, first out. A surplus message makes every later reference one cycle
older, for ever, until one reply is left out. Only the research extension reports the queue's length (``queueDepth``).
"""

from __future__ import annotations

from armlab.bridge.events import Tell, nobody
from armlab.wire.egm.types import StandingQueue

__all__ = ["Surplus"]

_CYCLES = 3  # in a row with messages left: fewer are replies on their way
_REMEDY = "End other programs that send to this robot, then restart its EGM session."
_MOST = 16  # replies left out in a row: whatever it tells, a robot gets one long before its time-out


class Surplus:
    """Decides packet by packet whether its reply is left out. A queue that stays deep all the same is an event.

    Parameters
    ----------
    on_event : receives the event.

    Attributes
    ----------
    left_out : replies so far.
    """

    def __init__(self, on_event: Tell = nobody) -> None:
        self._on_event, self._standing = on_event, StandingQueue()
        self.left_out = 0
        self._owed = 0
        self._depths: list[int] = []

    def leaves_out(self, depth: int, period: float) -> bool:
        """Return whether the reply to this packet is left out: one for each message that was left in three cycles.

        Parameters
        ----------
        depth : messages left in the queue after the controller took one; not above 0 also when it is unknown.
        period : cycle time of the robot [s].
        """
        if standing := self._standing.after(depth, period):
            self._on_event(f"{standing} Skipping {self.left_out} replies did not empty the queue. {_REMEDY}", warn=True)
        self._owed = min(self._owed, max(depth, 0))  # a queue that is shorter, or another session's, owes no more
        if not self._owed:
            self._depths = [*self._depths, depth] if depth > 0 else []
            if len(self._depths) < _CYCLES:
                return False
            self._owed = min(*self._depths, _MOST)
            self._depths = []  # look anew afterwards: the next two packets still count what was left out
        self._owed -= 1
        self.left_out += 1
        return True
