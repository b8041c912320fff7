"""How the loop waits for the next packet: block, poll just ahead of it, or poll always.

A loop that polls rehearses first, see `rehearsal`.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Sequence
from typing import Literal

from armlab.bridge.port import Arrival, Port

__all__ = ["Prediction", "Wait", "Waiting"]

Wait = Literal["block", "ahead", "spin"]
"""Ways of waiting."""

_AHEAD = 400_000  # ns before the predicted arrival at which rehearsing and polling begin
_AFTER = 600_000  # ns after it at which blocking begins
_LATE_SHARE = 0.02  # of a late arrival that moves the prediction
_LOST = 5  # periods: a prediction further off than this starts anew


class Prediction:
    """When the next packet will arrive: the phase of the robot's cycle on our clock.

    Early arrivals pull the phase fully, late ones by 2 %: a packet cannot be early, but it can be delayed on the way.
    """

    def __init__(self) -> None:
        self._last: float | None = None
        self._period = 0.0

    def add(self, arrival_ns: int, periods: int, period: float) -> None:
        """Take one arrival.

        Parameters
        ----------
        arrival_ns : kernel stamp on our monotonic clock. periods : cycles since the packet before.
        period : cycle time of the robot [s].
        """
        self._period = 1e9 * period
        if self._last is None:
            self._last = float(arrival_ns)
            return
        expected = self._last + periods * self._period
        error = arrival_ns - expected
        if abs(error) > _LOST * self._period:
            self._last = float(arrival_ns)
        else:
            self._last = expected + (error if error < 0.0 else _LATE_SHARE * error)

    @property
    def next_ns(self) -> float | None:
        """Predicted arrival of the next packet on our monotonic clock [ns], None before the first."""
        return None if self._last is None else self._last + self._period


class Waiting:
    """Waits for datagrams on the ports of a link.

    Parameters
    ----------
    ports : where they arrive; each is asked first in turn, so that a flood on one does not shut out the others.
    predictions : of the next arrival on each. mode : "block", "ahead" (sleep, poll around the predicted arrival,
        block) or "spin".

    Attributes
    ----------
    rehearse : called with the index of the port shortly before an arrival is predicted there; must change nothing.
    """

    def __init__(self, ports: Sequence[Port], predictions: Sequence[Prediction], mode: Wait) -> None:
        self._ports, self._predictions, self._mode = tuple(enumerate(ports)), predictions, mode
        self._poller, self._numbers = select.poll(), set[int]()
        self.rehearse: Callable[[int], None] = lambda index: None

    def next(self, seconds: float) -> tuple[int, Arrival] | None:
        """Return the next datagram with the index of its port, or None when none came in the time.

        Parameters
        ----------
        seconds : longest time to wait.
        """
        found = self._receive()
        if found is not None:
            return found
        end = time.monotonic_ns() + int(1e9 * seconds)
        while self._mode != "block":
            now = time.monotonic_ns()
            soonest = self._soonest(now)
            if soonest is None or soonest[0] + _AFTER >= end:
                break
            predicted, index = soonest
            if now < predicted - _AHEAD:
                found = self._idle(predicted - _AHEAD)
                if found is not None:
                    return found
                self.rehearse(index)
            found = self._poll(predicted + _AFTER)
            if found is not None:
                return found
        if self._mode == "spin":
            return self._poll(end)
        self._sleep(max(1e-6 * (end - time.monotonic_ns()), 0.0))
        return self._receive()

    def _sleep(self, milliseconds: float) -> bool:
        """Sleep until a datagram comes. Return whether one came in the time."""
        numbers = {port.fileno() for _, port in self._ports}
        if numbers != self._numbers:  # at first, and after a socket was bound again
            self._poller, self._numbers = select.poll(), numbers
            for number in numbers:
                self._poller.register(number, select.POLLIN)
        return bool(self._poller.poll(milliseconds))

    def _soonest(self, now: int) -> tuple[float, int] | None:
        """Return the first predicted arrival that is not over, and the index of its port."""
        times = [(p.next_ns, index) for index, p in enumerate(self._predictions) if p.next_ns is not None]
        return min(((ns, index) for ns, index in times if now < ns + _AFTER), default=None)

    def _receive(self) -> tuple[int, Arrival] | None:
        for index, port in self._ports:
            arrival = port.receive()
            if arrival is not None:
                if len(self._ports) > 1:
                    self._ports = (*self._ports[1:], self._ports[0])
                return index, arrival
        return None

    def _idle(self, until: float) -> tuple[int, Arrival] | None:
        if self._mode == "spin":
            return self._poll(until)
        whole = int(1e-6 * (until - time.monotonic_ns()))
        if len(self._ports) == 1 or not self._sleep(max(whole, 0)):  # another arm's packet does not wait
            time.sleep(1e-9 * max(until - time.monotonic_ns(), 0.0))
        return self._receive()

    def _poll(self, end: float) -> tuple[int, Arrival] | None:
        while True:
            found = self._receive()
            if found is not None or time.monotonic_ns() >= end:
                return found
