"""What a loop needs around it: garbage collected at the right moment, short thread switches, priority, interrupts."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from armlab._interrupts import handling
from armlab.bridge.events import Tell, nobody

__all__ = [
    "GUARD_PRIORITY",
    "LOOP_PRIORITY",
    "collect_if_due",
    "interrupts",
    "priority",
    "quiet_memory",
    "short_switches",
]

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
    """Run the calling thread under SCHED_FIFO where that is permitted; what it starts does not inherit that.

    Parameters
    ----------
    level : 1 to 99. on_event : told once, with the remedy, when it is not permitted.
    """
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

    Parameters
    ----------
    stop : called in the main thread between two instructions; what it raises is raised there.
    """
    came: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        again = number == signal.SIGHUP and bool(came)
        came.append(number)
        if not again:
            stop()

    with handling(handle):
        yield
