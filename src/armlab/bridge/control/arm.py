"""`ArmSession`: one arm during a run. It takes packets from its port, sends the one reply to each, and records both."""

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

_BINS = 20_000  # of one microsecond; the last one takes everything longer


class Latency:
    """Times from arrival to reply in bins of 1 us, in constant memory."""

    def __init__(self) -> None:
        self._bins = [0] * _BINS
        self.count = 0
        self.longest = 0.0

    def add(self, nanoseconds: int) -> None:
        self.count += 1
        self._bins[min(max(nanoseconds, 0) // 1000, _BINS - 1)] += 1
        self.longest = max(self.longest, 1e-3 * nanoseconds)

    def percentile(self, percent: float) -> float:
        """Return the time [us] that `percent` of the times do not exceed; NaN when nothing was counted."""
        if not self.count:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self._bins), percent / 100.0 * self.count))
        return min(index + 1.0, self.longest) if index < _BINS - 1 else self.longest

    def summary(self) -> dict[str, float]:
        names = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9}
        return {name: self.percentile(percent) for name, percent in names.items()} | {"max": self.longest}

    def histogram(self) -> dict[str, list[int]]:
        """Return limits that double from 2 us on, "below_us", and the "count" of times from the one before to each."""
        limits = [1 << k for k in range(1, _BINS.bit_length() + 1)]
        counts = [sum(self._bins[before:limit]) for before, limit in zip([0, *limits], limits, strict=False)]
        return {"below_us": limits, "count": counts}


_CYCLES = 3  # in a row with messages left: fewer are replies on their way
_REMEDY = "End other programs that send to this robot, then restart its EGM session."
_MOST = 16  # replies left out in a row: whatever it tells, a robot gets one long before its time-out


class QueueTrimming:
    """Decides packet by packet whether its reply is left out. A queue that stays deep all the same is an event."""

    def __init__(self, on_event: Tell = nobody) -> None:
        self._on_event, self._standing = on_event, StandingQueue()
        self.left_out = self._owed = self._depth = 0
        self._depths: list[int] = []

    def leaves_out(self, depth: int, period: float) -> bool:
        """Return whether the reply to this packet is left out: one for each message that was left in three cycles."""
        before, self._depth = self._depth, depth
        if depth <= 0 and before <= 0:
            return False
        if standing := self._standing.after(depth, period):
            self._on_event(f"{standing} Skipping {self.left_out} replies did not empty the queue. {_REMEDY}", warn=True)
        self._owed = min(self._owed, max(depth, 0))  # a queue that is shorter, or another session's, owes no more
        if not self._owed:
            self._depths = [*self._depths, depth] if depth > 0 else []
            if len(self._depths) < _CYCLES:
                return False
            self._owed = min(*self._depths, _MOST)
            self._depths = []  # look anew afterwards: the next two packets still count what was left out
        self._owed -= 1
        self.left_out += 1
        return True


_DROPS = 64  # refused datagrams per wake-up: a flood cannot hold the loop up
_BACKLOG = 1000  # datagrams per wake-up, more than wait after any stall: all but the newest packet are overtaken
_DEADLINE = 0.75  # of a period, from arrival to reply


_SILENCE = 0.5  # s that end a session


class End(NamedTuple):
    """The port and codec of an arm; `admittance` makes velocities of torques, None where they are sent or refused."""

    robot: Robot
    port: Port
    codec: Codec
    admittance: Admittance | None = None


class ArmSession:
    """One arm of a loop: everything that concerns it alone. Its methods are called under the loop's lock."""

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
        self.trimming = QueueTrimming(recording.event)
        self.supervisor = Supervisor(end.port, session, machine, settings, recording.event)
        self._wall_ns, self.arrived_ns, self._robot_ns = wall_ns, time.monotonic_ns(), 0
        self._surpassed: list[Sample] = []
        self._rows: list[Sample] = []
        self._arrival: Arrival | None = None
        self._details = getattr(end.codec, "details", None)  # a codec of the user's need not have it
        self.set_command(None)

    @property
    def stamp_ns(self) -> int:
        """Now: wall clock at the start plus monotonic time since [ns]; in lockstep the robot's clock, at first 0."""
        if self._in_lockstep and self.newest is None:
            return 0
        return self._robot_ns if self._in_lockstep and self._robot_ns else self._wall_ns + time.monotonic_ns()

    def set_command(self, command: Command | None) -> None:
        """Keep what the controller commands this arm, which does not pace it, for the next packets."""
        self._given, self._given_age = kept(command), 0.0

    def kept_command(self, sample: Sample, longest: float) -> Command | None:
        """Return the command kept for this packet; None, hold, once it is too old."""
        self._given_age += sample.dt
        return self._given if self._given_age <= longest else None

    def receive(self, arrival: Arrival | None, unanswered: Sample | None = None) -> Sample | None:
        """Drain the port as far as a flood allows. Return the newest packet that counts, or the unanswered one."""
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
                break  # before the next is taken from the port: it would be lost
            arrival = self.port.receive()
        return pending

    def _observe(self, sample: Sample, woken_ns: int) -> None:
        if sample.fresh:
            self.set_command(None)  # what it was told in another session: its age counts the packets, not the silence
        if sample.fresh and sample.session > 1:
            self.supervisor.judge()
        if sample.fresh and sample.session > 1 and not self._resumes:  # restarted before anyone saw the silence
            self.machine.lose(self.session.reason, resume=False)
        else:
            self.machine.observe(sample)
        arrival_ns, robot_ns = sample.arrival_ns, sample.packet.robot_ns
        self.arrived_ns, self._robot_ns = arrival_ns, robot_ns
        self.period = self.session.period.seconds
        received_ns = self._wall_ns + arrival_ns
        sample.stamp_ns = robot_ns if self._in_lockstep and robot_ns else received_ns
        sample.deadline_ns = arrival_ns + _DEADLINE * 1e9 * self.period
        sample.wake_ns = max(0, woken_ns - arrival_ns)  # one that came while the loop ran did not wait for it
        fused = self.fusion.fields(arrival_ns, self.robot, sample.packet.q) if self.fusion.sources else {}
        if self._details is not None and self._arrival is not None:
            fused = {**fused, "details": partial(self._details, self._arrival.data)}
        sample.state = self.machine.state(sample, received_ns, fused)
        self.newest = sample

    def reply(
        self,
        sample: Sample,
        command: Command | None,
        reply: Reply | None,
        *,
        call_ns: int = 0,
        late: bool = False,
    ) -> None:
        """Send the one reply to a packet; `record` later records it and those it has overtaken."""
        seq = send_ns = -1
        self._went_out = self._left_out = False
        try:
            if reply is not None:
                seq, send_ns = self._send(sample, reply)
        finally:  # also when the codec raises: the robot has not got it
            if reply is not None and not self._went_out:
                self.machine.take_back(self._left_out)
        if self._went_out and command is self._given and isinstance(command, Command):
            self._given = replace(command, rapid_data=None, rapid_digital=None)  # these go out once
        late = late or (not self._in_lockstep and send_ns > sample.deadline_ns)
        self.was_late = late
        self.late += late
        sample.command, sample.reply, sample.seq = command, reply if seq >= 0 else None, seq
        sample.send_ns, sample.call_ns, sample.late = send_ns, call_ns, late
        self.overtaken += len(self._surpassed)
        self._rows += [*self._surpassed, sample]
        self._surpassed.clear()
        if seq >= 0:
            self.replies += 1
            self.latency.add(send_ns - sample.arrival_ns)

    def _send(self, sample: Sample, reply: Reply) -> tuple[int, int]:
        """Send a reply. Return its number and when [ns], -1 and -1 when nothing went out."""
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
            what = f"A reply to {host}:{port} did not go out: the system refused it. The robot keeps the last one."
            self.recording.event(what, warn=True)
            return -1, -1
        self._went_out = True  # whatever fails from here on
        session.replied(now)
        return seq, now

    def record(self) -> None:
        """Record what was answered or overtaken since the last call: when no reply has to wait for that.

        A row for which there is no memory is the first of the next call; one that was kept never comes again.
        """
        while self._rows:
            sample, wall_ns = self._rows[0], self._wall_ns
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
            del self._rows[0]
            self.prediction.add(sample.arrival_ns, sample.missed + 1, self.period)
            self.recording.publish(state, command, tick)
