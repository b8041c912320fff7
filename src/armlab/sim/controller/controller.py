"""`SimulatedController`: one motion task of the simulated robot controller, without sockets.

Each cycle follows ABB's manual (3HAC073318-001, section 2.3): build and send the packet, take at most one message from
a FIFO queue, and move. Without a message, the last reference stays in effect, including its speed. The reply to a
packet takes effect in the next cycle at the earliest. A surplus reply adds a permanent lag of one cycle, reported after
1 s by an event.

Phases: ``streaming`` (packets report STOPPED) -> ``guiding`` (RUNNING) -> ``failing`` (ERROR, while the arm brakes) ->
``paused`` (no packets) -> the next session or ``over``. The controller returns from guidance to streaming when the
motors or RAPID stop.

`ReplyQueue` matches replies to packets by the sequence number echoed in the research extension, else by `tm` in the
header, else by order. Matching by order is correct only if the peer answers every packet. If several packets share
a millisecond, `tm` refers to the oldest unanswered packet.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab.errors import UnknownName
from armlab.sim.arm.arm import LaggingArm, SimulatedArm
from armlab.sim.controller.guidance import ExternalAxes, Guidance, ReferenceDecoder, has_numbers
from armlab.sim.controller.settings import ControllerSettings
from armlab.sim.controller.statistics import ControllerEvent, EventLog, Statistics
from armlab.sim.events import AppliedWrench, Surroundings
from armlab.wire.egm import Drop
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec, SensorMessage
from armlab.wire.egm.types import StandingQueue

EPOCH_NS = 1_500_000_000_000_000_000
"""Start of the robot's clock [ns]; constant, so every run sends the same bytes."""

OPTIONAL_FIELDS = {
    "tm": "tm_ms",
    "planned": "q_planned",
    "cartesian": "T_frame_tool",
    "time": "robot_ns",
    "motorState": "motors",
    "mciState": "mci",
    "rapidExecState": "rapid",
    "mciConvergenceMet": "converged",
    "utilizationRate": "utilization",
}
"""Optional fields of EgmRobot: names on the wire, and fields of `RobotMessage`."""

_UPTIME_MS = 10_000  # tm of the first packet; an echoed 0 would mean "no tm"


class PacketBuilder:
    """Encodes EgmRobot messages, which are sent `phase` seconds after the start of a cycle.

    For RobotWare 7, `torque_reference` sends the drive torque as torqueRef, and `data` is the number of RAPID data
    values sent back in addition to the digital value.
    """

    codec: RobotSideCodec

    def __init__(
        self,
        codec: RobotSideCodec,
        period: float,
        *,
        fields: Iterable[str] = (),
        phase: float = 0.0,
        force: bool = False,
        torque_reference: bool = False,
        data: int = 0,
    ) -> None:
        self.codec, self._period, self._phase = codec, period, phase
        self._force, self._torque_reference, self._data = force, torque_reference, data
        self._left_out: dict[str, Any] = {}
        for field in fields:
            if field not in OPTIONAL_FIELDS:
                raise UnknownName.among("optional field of EgmRobot", field, OPTIONAL_FIELDS)
            self._left_out[OPTIONAL_FIELDS[field]] = None

    def time_ns(self, cycle: int) -> int:
        """Return the robot's clock in a cycle [ns]: a multiple of the period plus the phase."""
        return EPOCH_NS + round((cycle * self._period + self._phase) * 1e9)

    def tm_ms(self, cycle: int) -> int:
        """Return the integer `tm` of a cycle's packet [ms]; with a period below 1 ms, packets share a value."""
        return _UPTIME_MS + int((cycle * self._period + self._phase) * 1e3 + 1e-6)

    def encode(
        self,
        cycle: int,
        arm: SimulatedArm | LaggingArm,
        guidance: Guidance,
        q_ext: Sequence[float] = (),
        target: ReferenceDecoder | None = None,
        **condition: Any,
    ) -> bytes:
        """Return the bytes of a cycle's packet, including RAPID's echo of `target` and the fields in `condition`."""
        measured, sample = arm.measure(), arm.sample
        feels = arm.has_torque
        echoed = target if self._data else None
        message = RobotMessage(
            tm_ms=self.tm_ms(cycle),
            q=measured.q,
            q_planned=guidance.q,
            robot_ns=self.time_ns(cycle),
            q_ext=q_ext,
            T_frame_tool=arm.robot.chain.forward(measured.q),
            utilization=guidance.utilization,
            wrench_raw=np.array(sample.wrench) if self._force else None,
            rapid_data=echoed.rapid_data[: self._data].tolist() if echoed else (),
            rapid_digital=echoed.rapid_digital if echoed else None,
            tau_reference=sample.tau if self._torque_reference and feels else None,
            qd=measured.qd,
            tau=measured.tau if feels else None,
            tau_total=sample.tau if feels else None,
            tau_gravity=sample.tau_gravity if feels else None,
            q_reference=guidance.q,
            qd_reference=guidance.qd,
            mono_ns=self.time_ns(cycle) - EPOCH_NS,
            **condition,
        )
        return self.codec.encode_robot(message._replace(**self._left_out) if self._left_out else message)


QUEUE_LENGTH = 64
"""Capacity of the reply queue and of the list of packets to match; further messages are dropped."""

_CONTENT = {
    "joint": ("q", "no joints", "joint references"),
    "pose": ("T_frame_tool", "no pose", "a pose"),
    "path": ("path_yz", "no path correction", "a path correction"),
}


@dataclass(slots=True)
class Sent:
    """Packet that awaits its reply; `stamp_ns` is the time just before sending [ns]."""

    seq: int
    tm_ms: int
    cycle: int
    guiding: bool
    stamp_ns: int = 0
    answered: bool = False


class ReplyQueue:
    """Bounded reply queue of one motion task, in the order defined by the settings."""

    def __init__(self, codec: RobotSideCodec, statistics: Statistics, settings: ControllerSettings) -> None:
        self._codec, self._statistics = codec, statistics
        self._field, self._missing, self._wanted = _CONTENT[settings.mode]
        self._takes_newest, self._period = settings.queue == "newest", settings.period
        self.begin()

    def __len__(self) -> int:
        return len(self._queue)

    def begin(self) -> None:
        """Clear the queue for a new session."""
        self._queue: deque[tuple[SensorMessage, int | None]] = deque()
        self._sent: deque[Sent] = deque(maxlen=QUEUE_LENGTH)
        self._standing = StandingQueue()
        self._ordered = -1  # number of the packet answered by the last reply without an echo
        self._last_seqno: int | None = None

    def note(self, sent: Sent) -> None:
        """Register a new packet."""
        self._sent.append(sent)

    def stamp(self, nanoseconds: int, uptime: float) -> None:
        """Set the send time of the newest packet; count the previous packet as missed if it has no reply."""
        if self._sent:
            self._sent[-1].stamp_ns = nanoseconds
        if len(self._sent) > 1 and self._sent[-2].guiding and not self._sent[-2].answered:
            self._statistics.miss(uptime)

    def read(self, data: bytes, count: bool = True) -> SensorMessage | Drop:
        """Decode a datagram; return the message, or a `Drop` if it is invalid in this mode."""
        found = self._codec.decode_sensor(data)
        if isinstance(found, SensorMessage):
            self._statistics.mtypes[found.mtype] += count
            if getattr(found, self._field) is None:
                return Drop(self._missing, f"a message without {self._wanted}, which this mode needs")
        return found

    def match(self, message: SensorMessage, arrival_ns: int, uptime: float) -> Sent | None:
        """Return the packet that a message answers, or None; an arrival time of 0 means unknown."""
        counts = self._statistics.counts
        counts["duplicates"] += message.seqno is not None and message.seqno == self._last_seqno
        self._last_seqno = message.seqno
        how, sent = self._find(message)
        if sent is None or sent.answered:
            return sent
        counts[f"matched by {how}"] += 1
        sent.answered = True
        if sent.stamp_ns and arrival_ns:
            self._statistics.trip(1e-9 * (arrival_ns - sent.stamp_ns), uptime)
        return sent

    def put(self, message: SensorMessage, cycle: int | None) -> bool:
        """Append a message and the cycle of the packet it answers, if known; return False if the queue is full."""
        if len(self._queue) >= QUEUE_LENGTH:
            return False
        self._queue.append((message, cycle))
        return True

    def take(self, cycle: int) -> SensorMessage | None:
        """Return the next message, or None, and record its age; mode "newest" drops all earlier messages."""
        self._statistics.queue[len(self._queue)] += 1
        if not self._queue:
            return None
        if self._takes_newest:
            self._statistics.counts["overtaken"] += len(self._queue) - 1
            self._queue = deque([self._queue[-1]])
        message, asked = self._queue.popleft()
        if asked is not None:
            self._statistics.last_age = cycle - asked
            self._statistics.age[cycle - asked] += 1
        return message

    def standing(self) -> str:
        """Return a warning if the queue has been non-empty for 1 s, otherwise ""; called once per cycle."""
        return self._standing.after(len(self._queue), self._period)

    def _find(self, message: SensorMessage) -> tuple[str, Sent | None]:
        if message.echo_mono_ns or message.echo_seq:
            return "echo", next((sent for sent in reversed(self._sent) if sent.seq == message.echo_seq), None)
        if message.tm_ms:  # abb_libegm sends 0; Python clients omit it
            same = [sent for sent in self._sent if sent.tm_ms == message.tm_ms]
            return "tm", next((sent for sent in same if not sent.answered), same[-1] if same else None)
        if self._ordered < 0:  # the first reply of a session may be late, and the last packet unsent
            left = [sent.seq for sent in self._sent if sent.stamp_ns]
            self._ordered = left[-1] - 1 if left else -1
        self._ordered += 1
        return "order", next((sent for sent in self._sent if sent.seq == self._ordered), None)


_BEYOND = 1e6  # rad or m, and per s: limits of the packet fields
_FAILING_TIME = 0.1  # s
_MCI = {"streaming": 2, "guiding": 3, "failing": 1}
_NO_DATA = (41822, "No data from the UdpUc device")
_MISMATCH = (41826, "EGM mode mismatch")
_SKIP = "Skip this number of replies once, then send one per packet, or use --queue newest."


class SimulatedController:
    """Motion task of one arm, with one session at a time.

    `wire`: codec of the robot side, or a `PacketBuilder`. `scene`: surroundings of the arm, or only a wrench on it.
    """

    arm: SimulatedArm | LaggingArm
    statistics: Statistics
    cycle: int
    session: int
    seq: int
    phase: str

    def __init__(
        self,
        arm: SimulatedArm | LaggingArm,
        wire: RobotSideCodec | PacketBuilder,
        settings: ControllerSettings,
        scene: Surroundings | AppliedWrench | None = None,
        on_event: Callable[[ControllerEvent], None] | None = None,
    ) -> None:
        self.arm, self.statistics = arm, Statistics()
        self.packets: PacketBuilder = wire if isinstance(wire, PacketBuilder) else PacketBuilder(wire, settings.period)
        self._settings, self._event_log = settings, EventLog(arm.robot.name, self.statistics, on_event)
        self._surroundings = scene if isinstance(scene, Surroundings) else Surroundings(scene)
        self._hand = self._surroundings.leads(settings.program, arm.robot.n)
        if self._hand is not None:
            arm.place(self._hand.at(0.0)[0])
        self._guidance = Guidance(arm.robot, settings, arm.sample.q)
        self._target = ReferenceDecoder(arm.robot, settings)
        self._drive = arm.drive if isinstance(arm, SimulatedArm) else None  # an arm without masses has no torques
        self._external = ExternalAxes(self._surroundings.external, settings)
        self.inbox: ReplyQueue = ReplyQueue(self.packets.codec, self.statistics, settings)
        self._cycles = {
            "streaming": self._stream,
            "guiding": self._guide,
            "failing": self._stop_in_error,
            "paused": self._pause,
            "over": self._guidance.brake,
        }
        self.cycle = self.session = 0
        self.reason, self.dead, self._answered = "", False, False
        if self._surroundings.is_open():
            self._begin_session(0)
        else:
            self.seq = self._used_seq = self._left = self._guided_since = 0
            self._enter("paused")

    @property
    def uptime(self) -> float:
        """Robot time since the start [s]."""
        return self.cycle * self._settings.period

    @property
    def robot_ns(self) -> int:
        """Robot clock of the next packet [ns]."""
        return self.packets.time_ns(self.cycle)

    @property
    def guidance_time(self) -> float:
        """Time since the start of guidance in this session [s], negative before it."""
        return (self.cycle - self._guided_since) * self._settings.period

    def packet(self) -> bytes | None:
        """Return the bytes of this cycle's packet, or None without a session."""
        if self.phase not in _MCI:
            return None
        scene, t, target = self._surroundings, self.uptime, self._target
        condition = {
            "seqno": self.seq,
            "motors": scene.motors.at(t),
            "mci": _MCI[self.phase],
            "rapid": scene.rapid.at(t),
            "converged": self._near,
            "mode": target.drive_mode,
            "used_seq": self._used_seq,
            "queue_depth": self._left,
        }
        self.inbox.note(Sent(self.seq, self.packets.tm_ms(self.cycle), self.cycle, self.phase == "guiding"))
        self.seq += 1
        self.statistics.counts["packets"] += 1
        q_ext = self._external.q.tolist()
        return self.packets.encode(self.cycle, self.arm, self._guidance, q_ext, target, **condition)

    def accept(self, data: bytes, arrival_ns: int = 0) -> SensorMessage | None:
        """Decode a received datagram and queue it; return the message, or None if it is invalid."""
        found = self.inbox.read(data)
        if isinstance(found, Drop):
            self._event_log.drop(self.uptime, found, data)
            return None
        self._answered = True
        self.statistics.counts["replies"] += 1
        sent = self.inbox.match(found, arrival_ns, self.uptime)
        keeps = self.phase == "streaming" and self._settings.stream_queue == "keep"
        if self.phase != "guiding" and not keeps:
            self.statistics.drops["not guiding"] += 1
        elif not self.inbox.put(found, sent and sent.cycle):
            self.statistics.drops["queue full"] += 1
        return found

    def advance(self, takes: bool = True) -> None:
        """Take at most one message if `takes` is set, then move the reference and the arm by one period."""
        if self.phase in _MCI and not self._surroundings.is_open():
            self._enter("paused")
        self._in_phase += 1
        self._takes = takes
        self._cycles[self.phase]()
        moves = self.phase == "guiding" or (self._settings.only_streams and self.phase == "streaming")
        self.cycle += 1
        wrench = self._surroundings.wrench(self.guidance_time, self.arm.sample.T_base_tool) if moves else None
        self._external.follow(self._target.q_ext if self.phase == "guiding" else None)
        self.arm.step(self._guidance.q, self._guidance.qd, wrench)
        if self.phase != "over" and not (np.abs([self.arm.sample.q, self.arm.sample.qd]) < _BEYOND).all():  # NaN too
            self._die(0, "the simulated arm diverged; apply a smaller force")

    def skip(self, cycles: int) -> None:
        """Advance robot time without packets or motion."""
        self.cycle += cycles

    def lose_peer(self) -> None:
        """End the session as CommTimeout would; needed in lockstep, where robot time stops while the peer is silent."""
        if self.phase in _MCI:
            self._no_data()

    def stop(self, reason: str) -> None:
        """End the task permanently."""
        if self.phase != "over":
            self.reason: str = reason
            self._enter("over")

    def _begin_session(self, first_cycle: int) -> None:
        self.session += 1
        self.statistics.counts["sessions"] += 1
        self.seq = self._used_seq = self._left = 0
        self._event_log.begin()
        self.inbox.begin()
        self._target.begin(self._guidance.q)
        streamed = math.ceil(self._settings.stream / self._settings.period - 1e-9)
        self._guided_since = first_cycle + (0 if self._settings.only_streams else streamed)
        ready = self._surroundings.is_ready(first_cycle * self._settings.period)
        self._enter("guiding" if ready and not streamed and not self._settings.only_streams else "streaming")

    def _enter(self, phase: str) -> None:
        self.phase, self._in_phase, self._near, self._near_for = phase, 0, False, 0
        self._target.release()
        self._target.apply(self._drive)
        if phase == "guiding":
            self._silent_for = 0
            self._target.begin(self._guidance.q)
            self._guidance.begin()
            if self._settings.activated not in (None, self._settings.mode):
                self._event(*_MISMATCH)
                self._enter("paused")

    def _lasted(self, seconds: float) -> bool:
        return self._in_phase * self._settings.period >= seconds - 1e-9

    def _stream(self) -> None:
        if self._hand is not None:
            self._guidance.lead(*self._hand.at(self.guidance_time + self._settings.period))
            return
        self._guidance.brake()
        begins = self.cycle + 1 >= self._guided_since and not self._settings.only_streams
        if begins and self._surroundings.is_ready(self.uptime + self._settings.period):
            self._guided_since = self.cycle + 1
            self._enter("guiding")

    def _guide(self) -> None:
        if not self._surroundings.is_ready(self.uptime):
            self._guidance.brake()
            self._enter("streaming")
            return
        if self._takes:
            self._take()
        guidance, target = self._guidance, self._target
        if self.phase != "guiding":
            guidance.brake()
            return
        if not target.gain_q.all():
            guidance.let_go(self.arm.sample.q, target.gain_q == 0)
        guidance.follow(target.q, target.qd)
        if violation := guidance.violation():
            self._fail(violation)
            return
        self._near = guidance.near(target.q)
        self._near_for = self._near_for + 1 if self._near else 0
        period = self._settings.period
        if self._near and self._near_for * period >= self._settings.condition_time:
            self._event(0, "convergence condition met: guidance ends")
            self._enter("paused")
        elif self._silent_for * period >= self._settings.comm_timeout - 1e-9:
            self._no_data()

    def _stop_in_error(self) -> None:
        self._guidance.brake()
        if self._lasted(_FAILING_TIME):
            self._enter("paused")

    def _pause(self) -> None:
        self._guidance.brake()
        if self._lasted(self._settings.restart) and self._surroundings.is_open():
            if self._settings.program != "once":
                self._begin_session(self.cycle + 1)
            else:
                self.stop("the program ran once")

    def _take(self) -> None:
        """Apply the next message, or hold the last reference."""
        message = self.inbox.take(self.cycle)
        if standing := self.inbox.standing():
            self._event(0, f"{standing} {_SKIP}")
        if message is None:
            self._silent_for += 1
            self.statistics.counts["starved"] += self._in_phase > 1  # no reply is possible in the first cycle
            return
        self._silent_for, self._left = 0, len(self.inbox)
        found = self._target.read(message, self._guidance.q)
        if found is None:
            self._fail("no posture of the arm reaches the pose")
        elif not has_numbers(message, *found):
            self._die(10014, "System failure state: a reference is not a valid number; restart the controller")
        elif refusal := self._guidance.refusal(found[0]):
            self._fail(refusal)
        else:
            self._target.accept(message, *found)
            self.statistics.record_reply(message.rapid_data, message.rapid_digital, message.q_ext)
            self._used_seq = message.seqno or 0
            self._target.apply(self._drive)

    def _die(self, number: int, text: str) -> None:
        self._event(number, text)
        self.dead: bool = True
        self.stop(f"event {number}" if number else text)

    def _fail(self, text: str) -> None:
        self._event(0, f"External Motion Interface input out of bounds: {text}")
        self._enter("failing")

    def _no_data(self) -> None:
        if self._answered or self.session == 1:  # without a peer, this event would repeat
            self._event(*_NO_DATA)
        self._answered = False
        self._enter("paused")

    def _event(self, number: int, text: str) -> None:
        self._event_log.tell(self.uptime, number, text)
