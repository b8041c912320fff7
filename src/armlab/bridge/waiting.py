"""How the loop waits for the next packet: block, poll just ahead of it, or poll always.

A loop that polls rehearses first, see `rehearsal`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

from armlab.bridge.port import Arrival, Port

__all__ = ["Prediction", "Wait", "Waiting"]

Wait = Literal["block", "ahead", "spin"]
"""Ways of waiting."""

_AHEAD = 500_000  # ns before the predicted arrival at which rehearsing and polling begin
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
    """Waits for datagrams on a port.

    Parameters
    ----------
    port : where they arrive. mode : "block", "ahead" (sleep, poll around the predicted arrival, block) or "spin".

    Attributes
    ----------
    prediction : of the next arrival. rehearse : called shortly before it; must change nothing.
    """

    def __init__(self, port: Port, mode: Wait) -> None:
        self._port, self._mode = port, mode
        self.prediction = Prediction()
        self.rehearse: Callable[[], None] = lambda: None

    def next(self, seconds: float) -> Arrival | None:
        """Return the next datagram, or None when none came in the time.

        Parameters
        ----------
        seconds : longest time to wait.
        """
        arrival = self._port.receive()
        if arrival is not None:
            return arrival
        now = time.monotonic_ns()
        end = now + int(1e9 * seconds)
        predicted = self.prediction.next_ns
        if self._mode != "block" and predicted is not None and now < predicted + _AFTER < end:
            if now < predicted - _AHEAD:
                arrival = self._idle(predicted - _AHEAD)
                if arrival is not None:
                    return arrival
                self.rehearse()
            arrival = self._poll(predicted + _AFTER)
            if arrival is not None:
                return arrival
        if self._mode == "spin":
            return self._poll(end)
        self._port.wait(1e-9 * (end - time.monotonic_ns()))
        return self._port.receive()

    def _idle(self, until: float) -> Arrival | None:
        if self._mode == "spin":
            return self._poll(until)
        time.sleep(1e-9 * max(until - time.monotonic_ns(), 0.0))
        return self._port.receive()

    def _poll(self, end: float) -> Arrival | None:
        while True:
            arrival = self._port.receive()
            if arrival is not None or time.monotonic_ns() >= end:
                return arrival
