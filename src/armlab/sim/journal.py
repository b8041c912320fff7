"""`Journal`: the event log of one motion task."""

from __future__ import annotations

from collections.abc import Callable

from armlab.sim.statistics import Event, Statistics
from armlab.wire.egm import Drop

__all__ = ["Journal"]


class Journal:
    """Tells events, and each kind of dropped datagram once per session.

    Parameters
    ----------
    task : name of the robot. statistics : keeps events and counts drops. on_event : called with each event, or None.
    """

    def __init__(self, task: str, statistics: Statistics, on_event: Callable[[Event], None] | None) -> None:
        self._task, self._statistics, self._on_event = task, statistics, on_event
        self.begin()

    def begin(self) -> None:
        """Begin a session: every kind of drop is worth a line again."""
        self._told: set[str] = set()

    def tell(self, uptime: float, number: int, text: str) -> None:
        """Keep and pass on one event.

        Parameters
        ----------
        uptime : robot time [s]. number : ABB's, or 0. text : in words.
        """
        event = Event(round(uptime, 6), self._task, number, text)
        self._statistics.events.append(event)
        if self._on_event:
            self._on_event(event)

    def drop(self, uptime: float, drop: Drop, data: bytes) -> None:
        """Count what is no message.

        Parameters
        ----------
        uptime : robot time [s]. drop : the reason. data : the datagram.
        """
        self._statistics.drops[drop.reason] += 1
        if drop.reason not in self._told:
            self._told.add(drop.reason)
            begin = data[:32].hex(" ")
            self.tell(uptime, 0, f"dropped a datagram, {drop.reason}: {drop.detail}; first bytes {begin}")
