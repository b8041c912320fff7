"""What a loop needs around it: garbage collected at the right moment, short thread switches, priority, interrupts."""

from __future__ import annotations

import gc
import os
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Literal

from armlab._interrupts import handling
from armlab.bridge.net.events import Tell, nobody
from armlab.bridge.net.sockets import Arrival, Port

LOOP_PRIORITY, GUARD_PRIORITY = 50, 55
_SWITCH_INTERVAL = 5e-4  # s; with Python's 5 ms the guard comes a cycle late against a busy controller
_DUE = 700  # new objects after which the youngest generation is collected


@contextmanager
def quiet_memory() -> Iterator[None]:
    """Collect garbage, then switch the collector off: a full collection can cost thirty cycles."""
    was_enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.collect()  # what the loop made, before what was there already is searched again
        gc.unfreeze()
        if was_enabled:
            gc.enable()


def collect_if_due() -> None:
    """Collect the youngest objects when there are many. Call it when there is time to spare."""
    if gc.get_count()[0] > _DUE:
        gc.collect(0)


@contextmanager
def short_switches() -> Iterator[None]:
    """Let threads take turns every half millisecond, so that the guard comes in time against a busy controller."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, _SWITCH_INTERVAL))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def priority(level: int, on_event: Tell = nobody) -> Iterator[bool]:
    """Run the calling thread under SCHED_FIFO where that is permitted; what it starts does not inherit that."""
    try:
        before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(level))
    except (OSError, AttributeError) as error:
        on_event(
            f"Running at normal priority: real-time scheduling is not permitted ({error}). Replies will be late more "
            "often on a busy computer. Remedy: an rtprio limit in /etc/security/limits.d, or CAP_SYS_NICE."
        )
        yield False
        return
    try:
        yield True
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, before, parameters)


@contextmanager
def interrupts(stop: Callable[[], None]) -> Iterator[None]:
    """Turn Ctrl-C, SIGTERM and a terminal that is closed into a call. Only the main thread can.

    A closed terminal may send SIGHUP twice and more: it counts once, and not after another signal, so that it never
    cuts a stop short. Where it is ignored (nohup) it stays so.
    """
    came: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        again = number == signal.SIGHUP and bool(came)
        came.append(number)
        if not again:
            stop()

    with handling(handle):
        yield


Wait = Literal["block", "ahead", "spin"]
"""Ways of waiting."""

_AHEAD = 400_000  # ns before the predicted arrival at which polling begins
_AFTER = 600_000  # ns after it at which blocking begins
_LATE_SHARE = 0.02  # of a late arrival that moves the prediction
_LOST = 5  # periods: a prediction further off than this starts anew


class Prediction:
    """When the next packet will arrive: the phase of the robot's cycle on our clock.

    Early arrivals pull the phase fully, late ones by 2 %: a packet cannot be early, but it can be delayed on the way.
    """

    def __init__(self) -> None:
        self._last: float | None = None
        self.next_ns: float | None = None  # on our monotonic clock, None before the first

    def add(self, arrival_ns: int, periods: int, period: float) -> None:
        last, period_ns = float(arrival_ns), 1e9 * period
        if self._last is not None:
            expected = self._last + periods * period_ns
            error = arrival_ns - expected
            if abs(error) <= _LOST * period_ns:
                last = expected + (error if error < 0.0 else _LATE_SHARE * error)
        self._last, self.next_ns = last, last + period_ns


class Waiting:
    """Waits for datagrams on the ports of a link."""

    def __init__(self, ports: Sequence[Port], predictions: Sequence[Prediction], mode: Wait) -> None:
        self._ports, self._predictions, self._mode = tuple(enumerate(ports)), predictions, mode
        self._poller, self._numbers = select.poll(), set[int]()

    def next(self, seconds: float = 0.0) -> tuple[int, Arrival] | None:
        for index, port in self._ports:
            arrival = port.receive()
            if arrival is not None:
                if len(self._ports) > 1:
                    self._ports = (*self._ports[1:], self._ports[0])
                return index, arrival
        return self._wait(seconds) if seconds > 0.0 else None

    def _wait(self, seconds: float) -> tuple[int, Arrival] | None:
        end = time.monotonic_ns() + int(1e9 * seconds)
        while self._mode != "block":
            now = time.monotonic_ns()
            soonest = self._soonest(now)
            if soonest is None or soonest + _AFTER >= end:
                break
            if now < soonest - _AHEAD:
                found = self._idle(soonest - _AHEAD)
                if found is not None:
                    return found
            found = self._poll(soonest + _AFTER)
            if found is not None:
                return found
        if self._mode == "spin":
            return self._poll(end)
        self._sleep(max(1e-6 * (end - time.monotonic_ns()), 0.0))
        return self.next()

    def _sleep(self, milliseconds: float) -> bool:
        """Sleep until a datagram comes. Return whether one came in the time."""
        numbers = {port.fileno() for _, port in self._ports}
        if numbers != self._numbers:  # at first, and after a socket was bound again
            self._poller, self._numbers = select.poll(), numbers
            for number in numbers:
                self._poller.register(number, select.POLLIN)
        return bool(self._poller.poll(milliseconds))

    def _soonest(self, now: int) -> float | None:
        """Return the first predicted arrival that is not over."""
        times = [prediction.next_ns for prediction in self._predictions]
        return min((ns for ns in times if ns is not None and now < ns + _AFTER), default=None)

    def _idle(self, until: float) -> tuple[int, Arrival] | None:
        if self._mode == "spin":
            return self._poll(until)
        whole = int(1e-6 * (until - time.monotonic_ns()))
        if len(self._ports) == 1 or not self._sleep(max(whole, 0)):  # another arm's packet does not wait
            time.sleep(1e-9 * max(until - time.monotonic_ns(), 0.0))
        return self.next()

    def _poll(self, end: float) -> tuple[int, Arrival] | None:
        while True:
            found = self.next()
            if found is not None or time.monotonic_ns() >= end:
                return found


_ROW = 5  # late cycles in a row
_SHARE = 0.05  # of the cycles of one second
_WINDOW = 1_000_000_000  # ns
_LONGEST_CALL = 250_000_000  # ns
_PAUSE = 250_000_000  # ns without a call: the share counts from then on
_NAP = 2e-3  # s between two looks of the guard


class Lateness:
    """Says when late cycles are too many: 5 in a row, 5 % in 1 s, or one call above 0.25 s."""

    def __init__(self) -> None:
        self._row = self._recent_late = 0
        self._recent: deque[tuple[int, bool]] = deque()

    def add(self, now_ns: int, late: bool, call_ns: int) -> str:
        """Take one cycle and return why the controller must stop, "" when it need not."""
        self._row = self._row + 1 if late else 0
        if self._recent and now_ns - call_ns - self._recent[-1][0] > _PAUSE:
            self._recent.clear()  # a second of which most was a pause holds few cycles: one of them is not 5 %
            self._recent_late = 0
        self._recent.append((now_ns, late))
        self._recent_late += late
        while self._recent[0][0] < now_ns - _WINDOW:
            self._recent_late -= self._recent.popleft()[1]
        full = now_ns - self._recent[0][0] > 0.9 * _WINDOW
        if call_ns > _LONGEST_CALL:
            return f"one call took {1e-9 * call_ns:.2f} s, allowed are {1e-9 * _LONGEST_CALL:.2f} s"
        if self._row >= _ROW:
            return f"{self._row} cycles in a row were late"
        if full and self._recent_late > _SHARE * len(self._recent):
            return f"{self._recent_late} of {len(self._recent)} cycles within one second were late"
        return ""


class Guard:
    """Thread that wakes at the deadline of each cycle and acts only when the loop is overdue."""

    def __init__(self, overdue: Callable[[], float], act: Callable[[], None]) -> None:
        self._overdue, self._act = overdue, act
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="armlab guard", daemon=True)

    def __enter__(self) -> Guard:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        with priority(GUARD_PRIORITY):
            while not self._stop.is_set():
                left = self._overdue()
                if left > 0.0:
                    time.sleep(min(left, _NAP))
                else:
                    self._act()
