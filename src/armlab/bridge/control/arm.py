"""`ArmSession`: one arm during a run, which receives packets, replies to each packet, and records both."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from armlab.bridge.control.limits import Limits, Reply, kept
from armlab.bridge.control.realtime import Prediction
from armlab.bridge.control.recording import Recording
from armlab.bridge.control.session import Sample, Session
from armlab.bridge.control.state_machine import StateMachine
from armlab.bridge.control.supervision import Settings, Supervisor
from armlab.bridge.control.torque import Admittance
from armlab.bridge.inputs.fusion import Fusion
from armlab.bridge.net.events import Tell, nobody
from armlab.bridge.net.sockets import Arrival, Port
from armlab.log import Tick
from armlab.robots import Robot
from armlab.state import Command
from armlab.wire.egm import Codec, Reference
from armlab.wire.egm.types import StandingQueue

_BINS = 20_000  # bins of 1 us; the last bin counts all longer times


class Latency:
    """Histogram of the arrival-to-reply latency, with 1 us bins in constant memory."""

    count: int
    longest: float

    def __init__(self) -> None:
        self._bins = [0] * _BINS
        self.count = 0
        self.longest = 0.0

    def add(self, nanoseconds: int) -> None:
        self.count += 1
        self._bins[min(max(nanoseconds, 0) // 1000, _BINS - 1)] += 1
        self.longest = max(self.longest, 1e-3 * nanoseconds)

    def percentile(self, percent: float) -> float:
        """Return a latency percentile [us], or NaN if there are no replies."""
        if not self.count:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self._bins), percent / 100.0 * self.count))
        return min(index + 1.0, self.longest) if index < _BINS - 1 else self.longest

    def summary(self) -> dict[str, float]:
        names = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9}
        return {name: self.percentile(percent) for name, percent in names.items()} | {"max": self.longest}

    def histogram(self) -> dict[str, list[int]]:
        """Return the upper bin edges ("below_us", doubling from 2 us) and the reply "count" per bin."""
        limits = [1 << k for k in range(1, _BINS.bit_length() + 1)]
        counts = [sum(self._bins[before:limit]) for before, limit in zip([0, *limits], limits, strict=False)]
        return {"below_us": limits, "count": counts}


_CYCLES = 3  # consecutive cycles with queued messages before a reply is skipped; fewer may be replies in transit
_REMEDY = "End other programs that send to this robot, then restart its EGM session."
_MAX_SKIPPED = 16  # consecutive skipped replies; the robot must get a reply well before its time-out


class QueueTrimming:
    """Skips replies until the robot's receive queue is empty; reports a queue that stays full."""

    left_out: int

    def __init__(self, on_event: Tell = nobody) -> None:
        self._on_event, self._standing = on_event, StandingQueue()
        self.left_out = self._owed = self._depth = 0
        self._depths: list[int] = []

    def leaves_out(self, depth: int, period: float) -> bool:
        """Return whether to skip the reply to this packet; one reply is skipped for each message queued for three
        cycles."""
        before, self._depth = self._depth, depth
        if depth <= 0 and before <= 0:
            return False
        if standing := self._standing.after(depth, period):
            self._on_event(f"{standing} Skipping {self.left_out} replies did not empty the queue. {_REMEDY}", warn=True)
        self._owed = min(self._owed, max(depth, 0))  # the queue may have become shorter, or belong to a new session
        if not self._owed:
            self._depths = [*self._depths, depth] if depth > 0 else []
            if len(self._depths) < _CYCLES:
                return False
            self._owed = min(*self._depths, _MAX_SKIPPED)
            self._depths = []  # the next two packets still count the skipped messages
        self._owed -= 1
        self.left_out += 1
        return True


_DROPS = 64  # maximum number of refused datagrams per wake-up, so a flood does not block the loop
_BACKLOG = 1000  # maximum number of datagrams per wake-up, more than arrive during any stall
_DEADLINE = 0.75  # fraction of a period, from arrival to reply
_SILENCE = 0.5  # s of silence after which a session ends


class End(NamedTuple):
    """Port and codec of an arm; `admittance` converts torques to velocities (None: no conversion)."""

    robot: Robot
    port: Port
    codec: Codec
    admittance: Admittance | None = None


class ArmSession:
    """One arm of a loop; the loop calls all methods under its lock."""

    robot: Robot
    port: Port
    codec: Codec
    recording: Recording
    machine: StateMachine
    session: Session
    latency: Latency
    prediction: Prediction
    replies: int
    overtaken: int
    late: int
    period: float
    arrived_ns: int

    def __init__(
        self,
        end: End,
        limits: Limits,
        settings: Settings,
        wall_ns: int,
        recording: Recording,
        fusion: Fusion,
        *,
        commands: bool,
        answer_stream: bool,
    ) -> None:
        self.robot, self.port, self.codec, self.recording = end.robot, end.port, end.codec, recording
        self.machine = machine = StateMachine(
            end.robot,
            limits,
            commands=commands,
            capabilities=end.codec.capabilities,
            answer_stream=answer_stream,
            on_event=recording.event,
            admittance=end.admittance,
        )
        timeout = float("inf") if settings.clock == "robot" else _SILENCE
        self.session = session = Session(end.codec, timeout, recording.event)
        self.latency, self.prediction = Latency(), Prediction()
        self.replies = self.overtaken = self.late = self._ticks = 0
        self.was_late = self._went_out = self._left_out = False
        self.newest: Sample | None = None
        self.period = session.period.seconds
        self._in_lockstep, self._resumes = settings.clock == "robot", settings.resume
        self.fusion = fusion
        self.trimming: QueueTrimming = QueueTrimming(recording.event)
        self.supervisor: Supervisor = Supervisor(end.port, session, machine, settings, recording.event)
        self._wall_ns, self.arrived_ns, self._robot_ns = wall_ns, time.monotonic_ns(), 0
        self._surpassed: list[Sample] = []
        self.rows: list[Sample] = []
        self._arrival: Arrival | None = None
        self._details = getattr(end.codec, "details", None)  # optional in a user's codec
        self.set_command(None)

    @property
    def stamp_ns(self) -> int:
        """Current time [ns]: wall clock or, in lockstep, the robot's clock (0 before the first packet)."""
        if self._in_lockstep and self.newest is None:
            return 0
        return self._robot_ns if self._in_lockstep and self._robot_ns else self._wall_ns + time.monotonic_ns()

    def set_command(self, command: Command | None) -> None:
        """Store the controller's command for an arm that does not pace the loop."""
        self._given, self._given_age = kept(command), 0.0

    def kept_command(self, sample: Sample, longest: float) -> Command | None:
        """Return the stored command, or None (hold) if it is older than `longest` [s]."""
        self._given_age += sample.dt
        return self._given if self._given_age <= longest else None

    def receive(self, arrival: Arrival | None, unanswered: Sample | None = None) -> Sample | None:
        """Read all waiting datagrams (bounded); return the newest valid packet, or `unanswered`."""
        pending, taken, refused, woken_ns = unanswered, 0, 0, time.monotonic_ns()
        while arrival is not None:
            taken += 1
            sample = self.session.accept(arrival)
            if sample is None:
                refused += 1
            else:
                if pending is not None:
                    self._surpassed.append(pending)
                self._arrival, pending = arrival, sample
                self._observe(sample, woken_ns)
            if refused == _DROPS or taken == _BACKLOG:
                break  # leave before the next read, whose datagram would be lost
            arrival = self.port.receive()
        return pending

    def _observe(self, sample: Sample, woken_ns: int) -> None:
        if sample.fresh:
            self.set_command(None)  # the last command is outdated, because its age does not include the silence
        if sample.fresh and sample.session > 1:
            self.supervisor.judge()
        if (
            sample.fresh and sample.session > 1 and not self._resumes
        ):  # the session restarted before the silence was detected
            self.machine.lose(self.session.reason, resume=False)
        else:
            self.machine.observe(sample)
        arrival_ns, robot_ns = sample.arrival_ns, sample.packet.robot_ns
        self.arrived_ns, self._robot_ns = arrival_ns, robot_ns
        self.period = self.session.period.seconds
        received_ns = self._wall_ns + arrival_ns
        sample.stamp_ns = robot_ns if self._in_lockstep and robot_ns else received_ns
        sample.deadline_ns = arrival_ns + _DEADLINE * 1e9 * self.period
        sample.wake_ns = max(0, woken_ns - arrival_ns)  # 0 for a packet that arrived while the loop was running
        fused = self.fusion.fields(arrival_ns, self.robot, sample.packet.q) if self.fusion.sources else {}
        if self._details is not None and self._arrival is not None:
            fused = {**fused, "details": partial(self._details, self._arrival.data)}
        sample.state = self.machine.state(sample, received_ns, fused)
        self.newest = sample

    def reply(
        self, sample: Sample, command: Command | None, reply: Reply | None, *, call_ns: int = 0, late: bool = False
    ) -> None:
        """Send the one reply to a packet; `record` later records this packet and any packets that it overtook."""
        seq = send_ns = -1
        self._went_out = self._left_out = False
        try:
            if reply is not None:
                seq, send_ns = self._send(sample, reply)
        finally:  # even after a codec error, which prevents sending
            if reply is not None and not self._went_out:
                self.machine.take_back(self._left_out)
        given = self._given if self._went_out and command is self._given else None
        if isinstance(given, Command) and (given.rapid_data is not None or given.rapid_digital is not None):
            self._given = replace(given, rapid_data=None, rapid_digital=None)  # sent only once
        late = late or (not self._in_lockstep and send_ns > sample.deadline_ns)
        self.was_late: bool = late
        self.late += late
        sample.command, sample.reply, sample.seq = command, reply if seq >= 0 else None, seq
        sample.send_ns, sample.call_ns, sample.late = send_ns, call_ns, late
        self.overtaken += len(self._surpassed)
        self.rows += [*self._surpassed, sample]
        self._surpassed.clear()
        if seq >= 0:
            self.replies += 1
            self.latency.add(send_ns - sample.arrival_ns)

    def _send(self, sample: Sample, reply: Reply) -> tuple[int, int]:
        """Send a reply; return its sequence number and time [ns], or -1 and -1 if it is not sent."""
        session, packet = self.session, sample.packet
        depth = -1 if self._in_lockstep else packet.queue_depth  # lockstep waits for every reply
        self._left_out = self.trimming.leaves_out(depth, self.period)
        if session.source is None or self._left_out:
            return -1, -1
        tm_ms = 0 if packet.tm_ms is None else packet.tm_ms
        echoes = packet.seqno, packet.robot_mono_ns
        reference = Reference(reply.q, reply.qd, reply.tau, session.seq, tm_ms, *echoes, reply.free, reply.beside)
        data = self.codec.encode(reference)
        now, seq = time.monotonic_ns(), session.seq
        if not self.port.send(data, session.source):
            host, port = session.source
            what = (
                f"A reply to {host}:{port} was not sent, because the operating system refused it. "
                "The robot keeps the last reply."
            )
            self.recording.event(what, warn=True)
            return -1, -1
        self._went_out = True  # stays True if a later step fails
        session.replied(now)
        return seq, now

    def record(self) -> None:
        """Record the packets answered or overtaken since the last call; called when no reply is due.

        If memory was too low to store a row, the next call tries again.
        """
        while self.rows:
            sample, wall_ns = self.rows[0], self._wall_ns
            state, reply = sample.state, sample.reply
            beside = None if reply is None else reply.beside
            tick = Tick(
                number=self._ticks,
                seq_sent=sample.seq,
                stamp_ns=sample.stamp_ns,
                receive_ns=wall_ns + sample.arrival_ns,
                send_ns=sample.send_ns if sample.seq < 0 else wall_ns + sample.send_ns,
                step_ns=sample.call_ns,
                late=sample.late,
                drops=self.session.total_drops,
                q_sent=None if reply is None else reply.q,
                qd_sent=None if reply is None else reply.qd,
                tau_sent=None if reply is None else reply.tau,
                clamped=None if reply is None else reply.clamped,
                q_ext_sent=None if beside is None else beside.q_ext,
                rapid_data_sent=None if beside is None else beside.rapid_data,
                rapid_digital_sent=None if beside is None else beside.rapid_digital,
                wake_ns=sample.wake_ns,
                record=self.fusion.record(state.sources, sample.arrival_ns) if self.fusion.sources else {},
            )
            command = self.recording.keep(state, sample.command, tick)
            self._ticks = tick.number + 1
            del self.rows[0]
            self.prediction.add(sample.arrival_ns, sample.missed + 1, self.period)
            self.recording.publish(state, command, tick)
