"""`run`: the cycles of one or more simulated controllers, in real time or in lockstep."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from armlab.errors import ConfigError
from armlab.sim.controller.channel import UdpClient

_CATCH_UP = 25  # cycles in which the arm moves without packets after a stall


@dataclass(frozen=True)
class Timing:
    """Time base of a run: each cycle waits for its reply in lockstep, and for the clock in real time.

    `seconds`: robot time at which the run ends [s]. `patience`: reply timeout in lockstep, after which the session
    ends [s]. `gone`: duration of silence after which a lockstep run ends [s].
    """

    lockstep: bool = False
    seconds: float | None = None
    patience: float = 10.0
    gone: float = 120.0

    def __post_init__(self) -> None:
        """Validate the times."""
        for name in ("seconds", "patience", "gone"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ConfigError(f"Expected {name} of at least 0 s, got {value}.")


def run(
    channels: Sequence[UdpClient],
    pace: Timing,
    *,
    alive: Callable[[], bool] = lambda: True,
    observe: Callable[[UdpClient], None] | None = None,
) -> str:
    """Run until all controllers have ended, the time is up, or `alive` returns False; return the reason.

    `observe` is called with each channel after its packet is built. All controllers have the same period.
    """
    gc.collect()
    gc.freeze()  # exclude existing objects from garbage collection, whose pauses would cost cycles
    try:
        return (_lockstep if pace.lockstep else _real_time)(channels, pace, alive, observe or (lambda _: None))
    finally:
        gc.unfreeze()
        for channel in channels:
            channel.close()


def _prepare(channels: Sequence[UdpClient], observe: Callable[[UdpClient], None]) -> None:
    for channel in channels:
        if channel.prepare():
            observe(channel)


def _end(channels: Sequence[UdpClient], pace: Timing, alive: Callable[[], bool]) -> str:
    """Return the reason for ending, or an empty string."""
    tasks = [channel.controller for channel in channels]
    if all(task.phase == "over" for task in tasks):
        return "; ".join(task.reason for task in tasks)
    if pace.seconds is not None and min(task.uptime for task in tasks) >= pace.seconds - 1e-9:
        return "the time is up"
    return "" if alive() else "the process that started the simulator has ended"


def _lockstep(
    channels: Sequence[UdpClient], pace: Timing, alive: Callable[[], bool], observe: Callable[[UdpClient], None]
) -> str:
    """For each arm in turn, send its packet, move it while the peer computes, then wait for the reply."""
    while True:
        reason = _end(channels, pace, alive)
        if reason:
            return reason
        _prepare(channels, observe)
        for channel in channels:
            channel.send()
            channel.controller.advance()
            if not channel.wait(pace.patience, alive) and alive():
                channel.controller.lose_peer()
                if time.monotonic() - channel.last_reply > pace.gone:
                    return f"no reply for {pace.gone:g} s: the peer is gone"


def _real_time(
    channels: Sequence[UdpClient], pace: Timing, alive: Callable[[], bool], observe: Callable[[UdpClient], None]
) -> str:
    """Keep to the schedule ``t0 + k T + phase``; no packet is sent in a cycle that this process misses."""
    period = channels[0].controller.arm.period
    start = time.monotonic() + period
    due = {phase: start + phase for phase in sorted({channel.phase for channel in channels})}
    while True:
        reason = _end(channels, pace, alive)
        if reason:
            return reason
        phase = min(due, key=due.__getitem__)
        beat = [channel for channel in channels if channel.phase == phase]
        begun = time.thread_time()
        _prepare(beat, observe)
        left = due[phase] - time.monotonic()
        if left > 0:
            time.sleep(left)
        for channel in beat:
            channel.controller.statistics.late(time.monotonic() - due[phase], channel.controller.uptime)
        for channel in beat:
            channel.drain()  # before sending: a fast reply belongs to the next cycle
            channel.send()
        for channel in beat:
            channel.controller.advance()
        missed = int((time.monotonic() - due[phase]) / period)
        work = time.thread_time() - begun
        for channel in beat:
            channel.controller.statistics.worked(work, missed if work > period else 0, channel.controller.uptime)
        if missed:
            _miss(beat, missed)
        due[phase] += (1 + missed) * period


def _miss(channels: Sequence[UdpClient], cycles: int) -> None:
    """Skip cycles without sending packets; the arm moves only in the first `_CATCH_UP` cycles."""
    for channel in channels:
        channel.controller.statistics.counts["skipped"] += cycles
        for _ in range(min(cycles, _CATCH_UP)):
            channel.controller.advance(takes=False)
        channel.controller.skip(max(0, cycles - _CATCH_UP))
