"""Real-time support: garbage collection, thread switching, priority, interrupts, waiting and the watchdog."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Literal

from armlab import kernels
from armlab._interrupts import handling
from armlab.bridge.net.events import Tell, nobody
from armlab.bridge.net.sockets import Arrival, Port

LOOP_PRIORITY, GUARD_PRIORITY = 50, 55
_NOT_INHERITED = getattr(os, "SCHED_RESET_ON_FORK", 0)  # only CAP_SYS_NICE may clear this flag, so it stays set
_SWITCH_INTERVAL = 5e-4  # s; with Python's default of 5 ms, a busy controller would delay the watchdog by a cycle
_DUE = 700  # number of new objects after which the youngest generation is collected


@contextmanager
def quiet_memory() -> Iterator[None]:
    """Run one full garbage collection, then disable the collector, which can block the loop for thirty cycles."""
    was_enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.collect()  # only objects of the loop, while older objects are still frozen
        gc.unfreeze()
        if was_enabled:
            gc.enable()


def collect_if_due() -> None:
    """Garbage-collect the youngest generation of objects if it is large; called when no packet is due."""
    if gc.get_count()[0] > _DUE:
        gc.collect(0)


@contextmanager
def short_switches() -> Iterator[None]:
    """Switch threads every 0.5 ms, so the watchdog acts in time even if the controller is busy."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, _SWITCH_INTERVAL))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def priority(level: int, on_event: Tell = nobody) -> Iterator[bool]:
    """Run the calling thread under SCHED_FIFO if permitted; child processes do not inherit this priority."""
    try:
        before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        set_priority(level)
    except (OSError, AttributeError) as error:
        on_event(
            f"The loop runs at normal priority, because real-time scheduling is not permitted ({error}). On a busy "
            "computer, more replies will be late. Set an rtprio limit in /etc/security/limits.d, or grant CAP_SYS_NICE."
        )
        yield False
        return
    try:
        yield True
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, before | _NOT_INHERITED, parameters)


def set_priority(level: int) -> None:
    """Run the calling thread under SCHED_FIFO, or with normal priority if the level is 0."""
    policy = os.SCHED_FIFO if level else os.SCHED_OTHER
    os.sched_setscheduler(0, policy | _NOT_INHERITED, os.sched_param(level))


@contextmanager
def interrupts(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on Ctrl-C, SIGTERM and SIGHUP (closed terminal); effective only in the main thread.

    A closed terminal may send SIGHUP repeatedly. A SIGHUP after any earlier signal is ignored, so it never
    interrupts a stop. SIGHUP stays ignored if it was ignored before (nohup).
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
"""Methods of waiting for a packet."""

_AHEAD = 400_000  # ns from the start of polling to the predicted arrival
_AFTER = 600_000  # ns from the predicted arrival to the end of polling
_LATE_SHARE = 0.02  # fraction of a late arrival's delay used to correct the prediction
_LOST = 5  # periods; a larger prediction error restarts the prediction


class Prediction:
    """Predicts the next arrival from the phase of the robot's cycle on the local clock.

    Early arrivals correct the phase fully, late arrivals only by 2 %, because the network can only delay packets.
    """

    def __init__(self) -> None:
        self._last: float | None = None
        self.next_ns: float | None = None  # on the local monotonic clock; None before the first packet

    def add(self, arrival_ns: int, periods: int, period: float) -> None:
        last, period_ns = float(arrival_ns), 1e9 * period
        if self._last is not None:
            expected = self._last + periods * period_ns
            error = arrival_ns - expected
            if abs(error) <= _LOST * period_ns:
                last = expected + (error if error < 0.0 else _LATE_SHARE * error)
        self._last, self.next_ns = last, last + period_ns


class Waiting:
    """Waits for datagrams on all ports of a link and calls `dry_run` before each predicted arrival.

    If real-time priority `is_permitted`, a thread that polls all the time ("spin") has it only from shortly before a
    predicted arrival until it waits for the next one, because it would otherwise never yield its core.
    """

    def __init__(
        self,
        ports: Sequence[Port],
        predictions: Sequence[Prediction],
        mode: Wait,
        dry_run: Callable[[], None] | None = None,
    ) -> None:
        self._ports, self._predictions, self._mode = tuple(enumerate(ports)), predictions, mode
        self._dry_run, self._dry_for = dry_run, 0.0
        self.is_permitted, self._is_urgent = False, True

    def next(self, seconds: float = 0.0) -> tuple[int, Arrival] | None:
        end = time.monotonic_ns() + int(1e9 * seconds)
        while True:
            for index, port in self._ports:
                arrival = port.receive()
                if arrival is not None:
                    if len(self._ports) > 1:
                        self._ports = (*self._ports[1:], self._ports[0])
                    return index, arrival
            now = time.monotonic_ns()
            if now >= end:
                return None
            poll, until = (now if self._mode == "spin" else end), end
            soonest = None if self._mode == "block" else self._soonest(now)
            if self.is_permitted and self._mode == "spin":
                self._prioritise(soonest is not None and now >= soonest - _AHEAD)
            if soonest is not None and soonest + _AFTER < end:
                begin = soonest - _AHEAD
                poll, until = min(poll, begin), soonest + _AFTER
                if now < begin:
                    until = begin
                elif self._dry_run is not None and self._dry_for != soonest:
                    self._dry_for = soonest
                    self._dry_run()
            kernels.await_datagram([port.fileno() for _, port in self._ports], int(poll), int(until))

    def _prioritise(self, urgent: bool) -> None:
        if urgent != self._is_urgent:
            self._is_urgent = urgent
            set_priority(LOOP_PRIORITY if urgent else 0)

    def _soonest(self, now: int) -> float | None:
        """Return the earliest predicted arrival that has not yet passed."""
        times = [prediction.next_ns for prediction in self._predictions]
        return min((ns for ns in times if ns is not None and now < ns + _AFTER), default=None)


_ROW = 5  # consecutive late cycles
_SHARE = 0.05  # fraction of late cycles within one second
_WINDOW = 1_000_000_000  # ns
_LONGEST_CALL = 250_000_000  # ns
_PAUSE = 250_000_000  # ns without a call, after which the window restarts
_NAP = 2e-3  # s between watchdog checks


class Lateness:
    """Limit on late cycles: 5 consecutive cycles, 5 % within 1 s, or one call above 0.25 s."""

    def __init__(self) -> None:
        self._row = self._recent_late = 0
        self._recent: deque[tuple[int, bool]] = deque()

    def add(self, now_ns: int, late: bool, call_ns: int) -> str:
        """Add one cycle; return the reason for stopping the controller, or "" if it may continue."""
        self._row = self._row + 1 if late else 0
        if self._recent and now_ns - call_ns - self._recent[-1][0] > _PAUSE:
            self._recent.clear()  # a second with a long pause has so few cycles that one late cycle exceeds 5 %
            self._recent_late = 0
        self._recent.append((now_ns, late))
        self._recent_late += late
        while self._recent[0][0] < now_ns - _WINDOW:
            self._recent_late -= self._recent.popleft()[1]
        full = now_ns - self._recent[0][0] > 0.9 * _WINDOW
        if call_ns > _LONGEST_CALL:
            return f"one call took {1e-9 * call_ns:.2f} s, more than {1e-9 * _LONGEST_CALL:.2f} s"
        if self._row >= _ROW:
            return f"{self._row} consecutive cycles were late"
        if full and self._recent_late > _SHARE * len(self._recent):
            return f"{self._recent_late} of {len(self._recent)} cycles within one second were late"
        return ""


class Guard:
    """Watchdog thread, which wakes at the deadline of each cycle and acts only if the loop is overdue."""

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
