"""`SimulatedController`: one motion task of the simulated robot controller, without sockets.

It keeps the order of ABB's cycle (3HAC073318-001, section 2.3): build and send the packet; take at most one message of
a first-in first-out queue; hold the last reference, speed included, when there is none; move. So the reply to a packet
acts in the next cycle at the earliest, and a surplus reply adds one cycle of lag for ever: an event after 1 s.

Phases: ``streaming`` (packets say STOPPED) -> ``guiding`` (RUNNING) -> ``failing`` (ERROR, while the arm brakes) ->
``paused`` (no packets) -> the next session or ``over``. Motors or RAPID that stop lead from guiding back to streaming.

`ReplyQueue` matches replies with packets by the sequence number that the research extension echoes, else by the `tm`
of the header, else by order. By order is right only for a peer that answers every packet. Several packets of one
millisecond share their `tm`: the oldest of them without an answer is meant.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from armlab.sim.arm.arm import LaggingArm, SimulatedArm
from armlab.sim.controller.guidance import ExternalAxes, Guidance, ReferenceDecoder, has_numbers
from armlab.sim.controller.packets import PacketBuilder
from armlab.sim.controller.settings import ControllerSettings
from armlab.sim.controller.statistics import ControllerEvent, EventLog, Statistics
from armlab.sim.events import AppliedWrench, Surroundings
from armlab.wire.egm import Drop
from armlab.wire.egm.robot_side import RobotSideCodec, SensorMessage
from armlab.wire.egm.types import StandingQueue

QUEUE_LENGTH = 64
"""Messages that wait; more are dropped. The packets that a reply can be matched with are as many."""

_CONTENT = {
    "joint": ("q", "no joints", "joint references"),
    "pose": ("T_frame_tool", "no pose", "a pose"),
    "path": ("path_yz", "no path correction", "a path correction"),
}


@dataclass(slots=True)
class Sent:
    """A packet that can be answered: number, `tm`, cycle, whether in guidance, clock just before sending [ns]."""

    seq: int
    tm_ms: int
    cycle: int
    guiding: bool
    stamp_ns: int = 0
    answered: bool = False


class ReplyQueue:
    """Queue of replies of one motion task, bounded, in the order that the settings ask for."""

    def __init__(self, codec: RobotSideCodec, statistics: Statistics, settings: ControllerSettings) -> None:
        self._codec, self._statistics = codec, statistics
        self._field, self._missing, self._wanted = _CONTENT[settings.mode]
        self._takes_newest, self._period = settings.queue == "newest", settings.period
        self.begin()

    def __len__(self) -> int:
        return len(self._queue)

    def begin(self) -> None:
        """Forget everything: a new session."""
        self._queue: deque[tuple[SensorMessage, int | None]] = deque()
        self._sent: deque[Sent] = deque(maxlen=QUEUE_LENGTH)
        self._standing = StandingQueue()
        self._ordered = -1  # number of the packet that the last reply without an echo answered
        self._last_seqno: int | None = None

    def note(self, sent: Sent) -> None:
        """Remember a packet that was built."""
        self._sent.append(sent)

    def stamp(self, nanoseconds: int, uptime: float) -> None:
        """Note when the newest packet left; a reply to the one before that has not arrived is late or missing."""
        if self._sent:
            self._sent[-1].stamp_ns = nanoseconds
        if len(self._sent) > 1 and self._sent[-2].guiding and not self._sent[-2].answered:
            self._statistics.miss(uptime)

    def read(self, data: bytes, count: bool = True) -> SensorMessage | Drop:
        """Decode a datagram; return the message, or the reason why it is not valid in this mode."""
        found = self._codec.decode_sensor(data)
        if isinstance(found, SensorMessage):
            self._statistics.mtypes[found.mtype] += count
            if getattr(found, self._field) is None:
                return Drop(self._missing, f"a message without {self._wanted}, which this mode needs")
        return found

    def match(self, message: SensorMessage, arrival_ns: int, uptime: float) -> Sent | None:
        """Return the packet that a message answers, or None; count duplicates and round trips. Arrival 0 is unknown."""
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
        """Append a message and the cycle of the packet it answers, if known. Return False when the queue is full."""
        if len(self._queue) >= QUEUE_LENGTH:
            return False
        self._queue.append((message, cycle))
        return True

    def take(self, cycle: int) -> SensorMessage | None:
        """Return the next message, or None, and note its age. Mode newest drops all messages before it."""
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
        """Return a sentence when the queue has not been empty for 1 s, "" otherwise. Call it once per cycle."""
        return self._standing.after(len(self._queue), self._period)

    def _find(self, message: SensorMessage) -> tuple[str, Sent | None]:
        if message.echo_mono_ns or message.echo_seq:
            return "echo", next((sent for sent in reversed(self._sent) if sent.seq == message.echo_seq), None)
        if message.tm_ms:  # abb_libegm sends 0, the Python clients nothing
            same = [sent for sent in self._sent if sent.tm_ms == message.tm_ms]
            return "tm", next((sent for sent in same if not sent.answered), same[-1] if same else None)
        if self._ordered < 0:  # the first reply of a session may come late; the last packet built may not have left
            left = [sent.seq for sent in self._sent if sent.stamp_ns]
            self._ordered = left[-1] - 1 if left else -1
        self._ordered += 1
        return "order", next((sent for sent in self._sent if sent.seq == self._ordered), None)


_BEYOND = 1e6  # rad or m, and per s: packets have no numbers for more
_FAILING_TIME = 0.1  # s
_MCI = {"streaming": 2, "guiding": 3, "failing": 1}
_NO_DATA = (41822, "No data from the UdpUc device")
_MISMATCH = (41826, "EGM mode mismatch")
_SKIP = "Skip as many replies once and send one per packet, or take the newest message with --queue newest."


class SimulatedController:
    """One motion task: one session at a time, one sequence, one queue, one arm, whose period is the controller's.

    `wire`: the robot's side of the wire, or packets of chosen content on it. `scene`: an operator alone is one too.
    """

    def __init__(
        self,
        arm: SimulatedArm | LaggingArm,
        wire: RobotSideCodec | PacketBuilder,
        settings: ControllerSettings,
        scene: Surroundings | AppliedWrench | None = None,
        on_event: Callable[[ControllerEvent], None] | None = None,
    ) -> None:
        self.arm, self.statistics = arm, Statistics()
        self.packets = wire if isinstance(wire, PacketBuilder) else PacketBuilder(wire, settings.period)
        self._settings, self._event_log = settings, EventLog(arm.robot.name, self.statistics, on_event)
        self._surroundings = scene if isinstance(scene, Surroundings) else Surroundings(scene)
        self._hand = self._surroundings.leads(settings.program, arm.robot.n)
        if self._hand is not None:
            arm.place(self._hand.at(0.0)[0])
        self._guidance = Guidance(arm.robot, settings, arm.sample.q)
        self._target = ReferenceDecoder(arm.robot, settings)
        self._drive = arm.drive if isinstance(arm, SimulatedArm) else None  # without masses there are no torques
        self._external = ExternalAxes(self._surroundings.external, settings)
        self.inbox = ReplyQueue(self.packets.codec, self.statistics, settings)
        self._cycles = {
            "streaming": self._stream,
            "guiding": self._guide,
            "failing": self._stop_in_error,
            "paused": self._pause,
            "over": self._guidance.brake,
        }
        self.cycle = self.session = 0
        self.reason, self.dead, self._answered = "", False, False
        self._begin_session(0)

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
        """Seconds since guidance began in this session; negative before."""
        return (self.cycle - self._guided_since) * self._settings.period

    def packet(self) -> bytes | None:
        """Return the bytes of this cycle's packet, or None while no session runs."""
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
        """Decode an arrived datagram and queue it. Return the message, or None for what is no message to us."""
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
        """Take at most one message, none in a cycle that this process missed; move reference and arm by one period."""
        self._in_phase += 1
        self._takes = takes
        self._cycles[self.phase]()
        moves = self.phase == "guiding" or (self._settings.only_streams and self.phase == "streaming")
        self.cycle += 1
        wrench = self._surroundings.wrench(self.guidance_time, self.arm.sample.T_base_tool) if moves else None
        self._external.follow(self._target.q_ext if self.phase == "guiding" else None)
        self.arm.step(self._guidance.q, self._guidance.qd, wrench)
        if self.phase != "over" and not (np.abs([self.arm.sample.q, self.arm.sample.qd]) < _BEYOND).all():  # NaN too
            self._die(0, "the simulated arm was driven beyond all numbers; push it with less force")

    def skip(self, cycles: int) -> None:
        """Let robot time pass without packets and without motion."""
        self.cycle += cycles

    def lose_peer(self) -> None:
        """End the session as CommTimeout does. For lockstep, where robot time stands still while the peer is silent."""
        if self.phase in _MCI:
            self._no_data()

    def stop(self, reason: str) -> None:
        """End for good."""
        if self.phase != "over":
            self.reason = reason
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
        if self._lasted(self._settings.restart):
            if self._settings.program != "once":
                self._begin_session(self.cycle + 1)
            else:
                self.stop("the program ran once")

    def _take(self) -> None:
        """Step 5 of the cycle: the next message, or none and the last reference stays."""
        message = self.inbox.take(self.cycle)
        if standing := self.inbox.standing():
            self._event(0, f"{standing} {_SKIP}")
        if message is None:
            self._silent_for += 1
            self.statistics.counts["starved"] += self._in_phase > 1  # nothing can have come in the first cycle
            return
        self._silent_for, self._left = 0, len(self.inbox)
        found = self._target.read(message, self._guidance.q)
        if found is None:
            self._fail("no posture of the arm reaches the pose")
        elif not has_numbers(message, *found):
            self._die(10014, "System failure state: a reference is no usable number; restart the controller")
        elif refusal := self._guidance.refusal(found[0]):
            self._fail(refusal)
        else:
            self._target.accept(message, *found)
            self.statistics.heard(message.rapid_data, message.rapid_digital, message.q_ext)
            self._used_seq = message.seqno or 0
            self._target.apply(self._drive)

    def _die(self, number: int, text: str) -> None:
        self._event(number, text)
        self.dead = True
        self.stop(f"event {number}" if number else text)

    def _fail(self, text: str) -> None:
        self._event(0, f"External Motion Interface input out of bounds: {text}")
        self._enter("failing")

    def _no_data(self) -> None:
        if self._answered or self.session == 1:  # without a peer this happens again and again
            self._event(*_NO_DATA)
        self._answered = False
        self._enter("paused")

    def _event(self, number: int, text: str) -> None:
        self._event_log.tell(self.uptime, number, text)
