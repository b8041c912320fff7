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
    """Time base: in lockstep, each cycle waits for its reply, otherwise for the clock. All times are in s.

    `seconds`: robot time at which the run ends. `patience`: timeout of a lockstep reply, after which the session ends.
    `gone`: silence after which lockstep ends.
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
    """Run until all controllers are over, the time is up, or `alive` returns False; return the reason as text.

    `observe` is called with a channel after its packet is built. All controllers have the same period.
    """
    gc.collect()
    gc.freeze()  # excluded from collections, which would cost cycles
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
    """Send the packet of each arm in turn, move the arms while the peer computes, then wait for the replies."""
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
    """Keep the schedule ``t0 + k T + phase``; cycles missed by this process pass without packets, and are never sent in
    a burst.
    """
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
    """Let cycles pass without packets, and move the arm only in the first ones, because a long stall is not made up
    for.
    """
    for channel in channels:
        channel.controller.statistics.counts["skipped"] += cycles
        for _ in range(min(cycles, _CATCH_UP)):
            channel.controller.advance(takes=False)
        channel.controller.skip(max(0, cycles - _CATCH_UP))
