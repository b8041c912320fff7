"""`Session`: sequence numbers, dropped packets, start and end of EGM sessions; `Sample`: one valid packet."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from armlab import kernels
from armlab.bridge.control.limits import Reply
from armlab.bridge.net.events import Tell, nobody
from armlab.bridge.net.sockets import Arrival
from armlab.state import Command, State
from armlab.wire.egm import Codec, Drop, Packet

NOMINAL_PERIOD = 0.004
"""EGM cycle time assumed before the first measurement [s]; a real controller uses 4.032 ms."""

_LONGEST = 1.0  # s between packets; a longer step means that the clock was set
_WINDOW = 9  # samples of the median
_TRUSTED = 1.5 * NOMINAL_PERIOD  # s, upper bound until the first window is complete, because a gap is not a cycle
_GAIN = 0.02  # gain of the slow average
_NEAR = 0.4  # share of the period: more than one tick of a millisecond clock, less than one skipped cycle
_WRAP_MS = 2**32
_SHORTEST = 2e-4  # s between packets; shorter steps are caused by a burst or a wrong clock
_AHEAD, _BEHIND = 1e-3, 0.5  # s by which robot time may lead arrivals (jitter) or trail them (network stall)
_STAYS = 10.0  # s; a longer lag of robot time means a longer network route or a slow clock, not a burst
_DRIFT = 1e-4  # relative drift of crystal oscillators
_WRONG, _WRONG_SHARE = 0.02, 0.01  # s and fraction: rejected robot time above what a delayed first packet can cause


class Period:
    """Estimate of the robot's cycle time: median of nine samples, then a slow running average; restarted after a
    change."""

    seconds: float

    def __init__(self) -> None:
        self.seconds = NOMINAL_PERIOD
        self._recent: deque[float] = deque(maxlen=_WINDOW)
        self._learnt = False

    def add(self, sample: float) -> bool:
        """Add a cycle time [s], the packet interval per sequence number; return whether the estimate restarted."""
        if sample < _SHORTEST:
            return False
        self._recent.append(sample)
        near = _NEAR * self.seconds
        if self._learnt and abs(sample - self.seconds) < near:
            self.seconds += _GAIN * (sample - self.seconds)
            return False
        middle = median(self._recent)
        if not self._learnt:
            self._learnt = len(self._recent) == _WINDOW
            self.seconds = middle if self._learnt else min(middle, _TRUSTED)
            return False
        if abs(middle - self.seconds) < near:
            return False
        self.seconds = middle
        return True


class RobotClock:
    """Increments of robot time: from feedBack.time if valid, else from tm in the header, else from arrival times.

    A clock that steps back, stops or jumps by more than 1 s is ignored for the current time step. A clock whose tm
    repeats is too coarse for the cycle time; tm is ignored from then on, because its next increment would count twice.
    `believed` bounds the step of a reference: robot time may lead the arrivals of the fastest packets by up to 1 ms or
    trail them by up to 0.5 s, for example after a network stall.
    """

    exact: bool
    believed: float

    def __init__(self, checks_arrival: bool = True, on_event: Tell = nobody) -> None:
        self._checks_arrival, self._on_event = checks_arrival, on_event
        self.exact = self._is_coarse = False
        self.believed = 0.0
        self._lead = self._cut_off = 0.0  # s: lead of robot time over arrivals, and rejected robot time
        self._trails = 0.0  # s since robot time began to trail arrivals
        self._trailed = False
        self._reported: set[str] = set()
        self._last: tuple[int, int | None, int] | None = None  # robot ns, tm ms, arrival ns

    def step(self, packet: Packet, arrival_ns: int) -> float | None:
        last, self._last = self._last, (packet.robot_ns, packet.tm_ms, arrival_ns)
        if last is None:
            return None
        robot_ns, tm_ms, last_ns = last
        self.exact, claimed = False, None
        arrived = max(1e-9 * (arrival_ns - last_ns), 1e-6)
        if packet.robot_ns and robot_ns:
            dt = 1e-9 * (packet.robot_ns - robot_ns)
            if 0.0 < dt <= _LONGEST:
                self.exact, claimed = True, dt
            else:
                what = "has stopped" if dt == 0.0 else f"jumped by {dt:+.3f} s"
                self._report_once(
                    "set" if dt else "still",
                    f"The robot's clock {what}. This time step is "
                    "computed from tm in the header or from arrival times.",
                )
        if claimed is None and packet.tm_ms is not None and tm_ms is not None and not self._is_coarse:
            dt = 1e-3 * ((packet.tm_ms - tm_ms) % _WRAP_MS)
            self._is_coarse = dt == 0.0
            claimed = dt if 0.0 < dt <= _LONGEST else None
        if claimed is None or not self._checks_arrival:
            self.believed = arrived if claimed is None else claimed
            return self.believed
        self.believed = dt = min(claimed, max(arrived + _AHEAD - self._lead, 1e-6))
        self._cut_off = max(self._cut_off + claimed - dt - _WRONG_SHARE * arrived, 0.0)
        if self._cut_off > _WRONG:
            self._report_once(
                "fast",
                f"The robot's clock runs faster than the local clock: it reports {1e3 * claimed:.1f} ms between "
                f"packets that arrived {1e3 * arrived:.1f} ms apart. The time step is "
                "limited to the interval between arrivals.",
            )
        forgotten = min(abs(self._lead), _DRIFT * arrived)
        self._lead -= forgotten if self._lead > 0.0 else -forgotten
        self._lead = max(self._lead + dt - arrived, -_BEHIND)
        self._trails = self._trails + arrived if self._lead < -_WRONG else 0.0
        if self._trails > _STAYS:  # the current arrivals become the new reference
            if self._trailed:
                self._report_once(
                    "slow",
                    "The robot's clock runs slower than the local clock. The time steps follow the robot's clock.",
                )
            self._lead, self._trails, self._trailed = 0.0, 0.0, True
        return claimed

    def _report_once(self, kind: str, text: str) -> None:
        if kind not in self._reported:
            self._reported.add(kind)
            self._on_event(text, warn=True)


EGM_ERROR = "the controller reported an EGM error"
"""Reason for the end of a session after an error report from the robot controller."""

_SEQUENCES = 2**32
_HALF = 2**31  # ms; a tm further ahead counts as past
_FAR = 2**16  # packets ahead, more than are sent during the silence that ends a session
_FILTER = 30.0  # Hz, low-pass filter for velocities computed from differences
_OVERTAKEN_MS = 100  # a first packet that is older by less than this was overtaken in transit and begins no session
_SILENT_PERIODS = 5  # periods of silence before another port of the same host may begin a session
_FOLLOWERS = 3  # consecutive out-of-order packets that begin a new session
_REMEMBERED = 8  # previous sessions whose repeated first packet is recognised
_OWN_SILENCE = 150_000_000  # ns without a reply, shorter than any usual CommTimeout
_FOREIGN = Drop(
    "foreign source", "only the first sender of a session gets replies; each motion task needs its own port"
)
_MOTORS_OFF, _RAPID_STOPPED, _MCI_ERROR, _MCI_RUNNING = 2, 1, 1, 3


@dataclass(slots=True, eq=False)
class Sample:
    """Valid packet and its reply; a packet without a reply was overtaken by a newer packet."""

    packet: Packet
    arrival_ns: int
    dt: float
    missed: int
    session: int
    fresh: bool
    qd: np.ndarray
    qd_source: str
    step: float  # s by which a reference may advance
    state: State = field(init=False)
    stamp_ns: int = 0  # of the row
    deadline_ns: float = 0.0  # of the reply, on the local monotonic clock
    wake_ns: int = 0  # from arrival to the loop
    command: Command | None = None
    reply: Reply | None = None
    seq: int = -1
    send_ns: int = -1
    call_ns: int = 0
    late: bool = False


class Session:
    """Tracks the sequence numbers, sources and sessions of one robot controller.

    Sequence numbers are compared modulo 2**32. Each of the following packets begins a session, in which replies are
    numbered from 0:

    - the first packet, and the first packet after a silence;
    - a packet with number 0, even if its clock is earlier (after a restart of the robot), but not a late duplicate,
      whose `tm` equals that of the first packet of this or a previous session;
    - the third consecutive out-of-order packet, after five periods without a packet in order: the first packet of its
      session was lost.
    """

    number: int
    active: bool
    received: int
    missed: int
    skipped: int
    seq: int
    total_drops: int
    period: Period
    reason: str

    def __init__(self, codec: Codec, timeout: float = 0.5, on_event: Tell = nobody) -> None:
        self._codec, self._timeout_ns, self._on_event = codec, 1e9 * timeout, on_event
        self.number, self.active = 0, False
        self.source: tuple[str, int] | None = None
        self.received = self.missed = self.skipped = self.seq = self.total_drops = 0
        self.drops: Counter[str] = Counter()
        self.period = Period()
        self.reason = ""
        self._reported: set[str] = set()
        self._clock = self._new_clock()
        self._last: Sample | None = None
        self._first_tm: int | None = None
        self._past_tms: deque[int | None] = deque(maxlen=_REMEMBERED)
        self._stray: tuple[Packet, int, int] | None = None  # newest out-of-order packet, their count, start [ns]
        self._begun_ns = self._replied_ns = 0

    def accept(self, arrival: Arrival) -> Sample | None:
        last = self._last
        if last is not None and arrival.ns - last.arrival_ns >= self._timeout_ns:
            self.end()
        foreign = self.active and arrival.source != self.source
        if foreign and not (self.source and arrival.source[0] == self.source[0] and self._is_quiet(arrival)):
            # RAPID restarts fast: the same host may reappear on another port once the old port is silent
            return self._drop(_FOREIGN, arrival)
        packet = self._codec.decode(arrival.data)
        if isinstance(packet, Drop):
            return self._drop(packet, arrival)
        if foreign and packet.seqno != 0:
            return self._drop(_FOREIGN, arrival)
        missed = -1 if foreign or not self.active or last is None else self._count(packet, last.packet)
        if isinstance(missed, Drop):
            if not self._goes_on(packet, arrival):
                return self._drop(missed, arrival)
            missed = -1
        return self._begin(arrival) if missed < 0 else self._sample(packet, arrival, missed)

    def silent(self, now_ns: int) -> bool:
        """Return whether the robot has been silent for longer than the timeout."""
        return self.active and self._last is not None and now_ns - self._last.arrival_ns >= self._timeout_ns

    def replied(self, now_ns: int) -> None:
        """Count a sent reply."""
        self.seq += 1
        self._replied_ns = now_ns

    def end(self) -> str:
        """End the session; return the reason: the first cause consistent with the last packet."""
        if self.active and self._last is not None:
            self.reason = self._why(self._last)
            self._on_event(f"Session {self.number} ended: {self.reason}.", warn=True)
        self.active = False
        return self.reason

    def _why(self, last: Sample) -> str:
        packet = last.packet
        own = last.arrival_ns - max(self._replied_ns, self._begun_ns)
        causes = (
            (packet.converged, "the convergence condition of EGMAct was met (a window of zero prevents this)"),
            (packet.motors == _MOTORS_OFF, "the motors were switched off"),
            (packet.rapid == _RAPID_STOPPED, "RAPID was stopped"),
            (packet.mci == _MCI_ERROR, EGM_ERROR),
            (
                packet.mci == _MCI_RUNNING and own > _OWN_SILENCE,
                f"armlab sent no reply for {1e-9 * own:.2f} s (event 41822 is likely)",
            ),
        )
        return next((text for holds, text in causes if holds), "the controller stopped sending")

    def _count(self, packet: Packet, last: Packet) -> int | Drop:
        """Return the number of packets lost before this packet, -1 for a new session, or the reason for dropping it."""
        now, then = packet.tm_ms, last.tm_ms
        is_late = now is not None and then is not None and (now - then) % _SEQUENCES >= _HALF  # of an earlier session
        ahead = (packet.seqno - last.seqno) % _SEQUENCES
        if packet.seqno == 0 and ahead != 1:
            same_tm = now == self._first_tm if now is not None else last.seqno == 0
            if same_tm:
                return Drop("duplicate", "repeated first packet of the session")
            is_own = now is not None and self._first_tm is not None and 0 < self._first_tm - now < _OVERTAKEN_MS
            if not is_own and (now is None or now not in self._past_tms):
                return -1
        if ahead == 0:
            return Drop("duplicate", f"repeated packet {packet.seqno}")
        if is_late or ahead > _FAR:
            return Drop("old", f"packet {packet.seqno} after {last.seqno}, at {now} after {then} ms")
        return ahead - 1

    def _goes_on(self, packet: Packet, arrival: Arrival) -> bool:
        """Return whether out-of-order packets belong to a new session whose first packet was lost."""
        before, count, since_ns = self._stray or (None, 0, 0)
        follows = before is not None and packet.seqno == (before.seqno + 1) % _SEQUENCES
        if before is not None and packet.tm_ms is not None and before.tm_ms is not None:
            follows = follows and 0 < (packet.tm_ms - before.tm_ms) % _SEQUENCES < _HALF
        count, since_ns = (count + 1, since_ns) if follows else (1, arrival.ns)
        self._stray = packet, count, since_ns
        in_time = arrival.ns - since_ns > 0.5e9 * (_FOLLOWERS - 1) * self.period.seconds  # else a delayed burst
        return count >= _FOLLOWERS and in_time and self._is_quiet(arrival)

    def _is_quiet(self, arrival: Arrival) -> bool:
        """Return whether the session has been silent long enough for another source to replace it."""
        last = self._last
        return last is not None and arrival.ns - last.arrival_ns > _SILENT_PERIODS * 1e9 * self.period.seconds

    def _begin(self, arrival: Arrival) -> Sample | None:
        self.end()
        self._codec.reset()
        packet = self._codec.decode(arrival.data)
        if isinstance(packet, Drop):
            return self._drop(packet, arrival)
        self.number, self.active, self.source, self.seq = self.number + 1, True, arrival.source, 0
        self.period, self._clock, self._last = Period(), self._new_clock(), None
        self._past_tms.append(self._first_tm)
        self._first_tm, self._begun_ns = packet.tm_ms, arrival.ns
        self._reported.clear()
        host, port = arrival.source
        self._on_event(
            f"Session {self.number} began: RobotWare {packet.robotware}, {len(packet.q)} joints, {host}:{port}."
        )
        return self._sample(packet, arrival, 0)

    def _new_clock(self) -> RobotClock:
        return RobotClock(math.isfinite(self._timeout_ns), self._on_event)  # arrival times are meaningless in lockstep

    def _sample(self, packet: Packet, arrival: Arrival, missed: int) -> Sample:
        last = self._last
        dt = self._clock.step(packet, arrival.ns)
        if dt is None:
            dt = believed = self.period.seconds
        else:
            before, believed = self.period.seconds, self._clock.believed
            if self._clock.exact:
                self.skipped += max(round(dt / before) - 1 - missed, 0)
            if self.period.add(believed / (missed + 1)):
                change = f"from {1e3 * before:.2f} to {1e3 * self.period.seconds:.2f} ms"
                self._on_event(f"The cycle time of the robot changed {change}.", warn=True)
        if packet.qd is not None:
            qd, source = packet.qd, "measured"
        elif last is None:
            qd, source = np.zeros_like(packet.q), "difference"
            qd.flags.writeable = False
        else:
            qd, source = kernels.filtered_velocity(packet.q, last.packet.q, last.qd, dt, _FILTER), "difference"
        self.received += 1
        self.missed += missed
        self._stray = None
        step = believed if self._clock.exact else min(believed, (missed + 1) * self.period.seconds)
        self._last = Sample(packet, arrival.ns, dt, missed, self.number, last is None, qd, source, step)
        return self._last

    def _drop(self, drop: Drop, arrival: Arrival) -> None:
        self.drops[drop.reason] += 1
        self.total_drops += 1
        if drop.reason not in self._reported:
            self._reported.add(drop.reason)
            host, port = arrival.source
            bytes_ = arrival.data[:32].hex(" ")
            what = f"Dropped a datagram from {host}:{port}, {drop.reason}: {drop.detail}. First bytes: {bytes_}."
            self._on_event(what, warn=True)
