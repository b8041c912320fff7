"""`run`: the cycles of one or more simulated controllers, in real time or in lockstep."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from armlab.errors import ConfigError
from armlab.sim.controller.channel import UdpClient

_CATCH_UP = 25  # cycles in which the arm moves on without packets after this process was held up


@dataclass(frozen=True)
class Timing:
    """How time passes: in lockstep each cycle waits for its reply; otherwise by the clock. All times in s.

    `seconds`: robot time after which to end. `patience`: of lockstep for one reply, before the session times out.
    `gone`: silence after which lockstep gives its peer up and ends.
    """

    lockstep: bool = False
    seconds: float | None = None
    patience: float = 10.0
    gone: float = 120.0

    def __post_init__(self) -> None:
        """Check the times."""
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
    """Run until all controllers, of one period, are over, the time is up, or `alive` says no. Return why, in words.

    `observe` is called with a channel whenever its packet has been built.
    """
    gc.collect()
    gc.freeze()  # what exists now is not searched again: a full collection would cost cycles
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
    """Return why to end, or nothing."""
    tasks = [channel.controller for channel in channels]
    if all(task.phase == "over" for task in tasks):
        return "; ".join(task.reason for task in tasks)
    if pace.seconds is not None and min(task.uptime for task in tasks) >= pace.seconds - 1e-9:
        return "the time is up"
    return "" if alive() else "the process that started the simulator has ended"


def _lockstep(
    channels: Sequence[UdpClient], pace: Timing, alive: Callable[[], bool], observe: Callable[[UdpClient], None]
) -> str:
    """Send, move while the peer computes, then wait for its reply: it acts in the next cycle, as in real time.

    One arm after another, so that a peer of several hears them in the same order in every run.
    """
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
                if time.monotonic() - channel.heard > pace.gone:
                    return f"no reply for {pace.gone:g} s: the peer is gone"


def _real_time(
    channels: Sequence[UdpClient], pace: Timing, alive: Callable[[], bool], observe: Callable[[UdpClient], None]
) -> str:
    """Keep the schedule ``t0 + k T + phase``; cycles missed by this process pass without packets, never in a burst."""
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
            channel.drain()  # first, or a fast reply to the packet that leaves now would count for this cycle
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
    """Let cycles pass without packets. The arm moves in the first of them only: a long stall is not made up."""
    for channel in channels:
        channel.controller.statistics.counts["skipped"] += cycles
        for _ in range(min(cycles, _CATCH_UP)):
            channel.controller.advance(takes=False)
        channel.controller.skip(max(0, cycles - _CATCH_UP))
