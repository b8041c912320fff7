"""`Controller`: one motion task of the simulated robot controller, without sockets.

It keeps the order of ABB's cycle (3HAC073318-001, section 2.3): build and send the packet; take at most one message of
a first-in first-out queue; hold the last reference, speed included, when there is none; move. So the reply to a packet
acts in the next cycle at the earliest, and a surplus reply adds one cycle of lag for ever.

Phases: ``streaming`` (packets say STOPPED) -> ``guiding`` (RUNNING) -> ``failing`` (ERROR, while the arm brakes) ->
``paused`` (no packets) -> the next session or ``over``.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from armlab.sim.arm import Arm
from armlab.sim.guidance import Guidance, Settings
from armlab.sim.operator import Operator
from armlab.sim.statistics import Event, Statistics
from armlab.wire.egm import Drop, RobotMessage, RobotSideCodec, SensorMessage

__all__ = ["Controller"]

QUEUE_LENGTH = 64
EPOCH_NS = 1_500_000_000_000_000_000  # robot time starts here: the same bytes in every run
_UPTIME_MS = 10_000  # tm of the first packet; 0 would look like "no tm" when it is echoed
_FAILING_TIME = 0.1  # s
_ABSURD = 1e9  # rad, rad/s
_MCI = {"streaming": 2, "guiding": 3, "failing": 1}
_NO_DATA = (41822, "No data from the UdpUc device")


class Controller:
    """One motion task: one session at a time, one sequence, one queue, one arm.

    Parameters
    ----------
    arm : the simulated arm; its period is the controller's.
    codec : the robot's side of the wire.
    settings : see `Settings`.
    operator : who pushes the arm, over guidance time.
    on_event : called with each event as one line of text.

    Attributes
    ----------
    phase : see the module. reason : why it is over, "" before. dead : over by a failure that only a restart ends.
    session : number of the session from 1. uptime : robot time [s]. guidance_time : since guidance began [s].
    robot_ns, seq : stamp and sequence number of the next packet.
    statistics : what was counted.
    """

    def __init__(
        self,
        arm: Arm,
        codec: RobotSideCodec,
        settings: Settings,
        operator: Operator | None = None,
        on_event: Callable[[str], None] | None = None,
    ) -> None:
        self.arm, self.statistics = arm, Statistics()
        self._codec, self._settings = codec, settings
        self._operator = operator or Operator.idle()
        self._on_event = on_event
        self._guidance = Guidance(arm.robot, settings, arm.sample.q)
        self._queue: deque[SensorMessage] = deque()
        self._sent: deque[tuple[int, int]] = deque(maxlen=QUEUE_LENGTH)  # (tm, cycle) of packets that may be answered
        self._cycles = {
            "streaming": self._stream,
            "guiding": self._guide,
            "failing": self._stop_in_error,
            "paused": self._pause,
            "over": self._guidance.brake,
        }
        self._cycle = self.session = 0
        self.reason, self.dead, self._answered = "", False, False
        self._begin_session(0)

    @property
    def uptime(self) -> float:
        """Robot time since the start [s]."""
        return self._cycle * self._settings.period

    @property
    def robot_ns(self) -> int:
        """Robot clock [ns]: exact multiples of the period."""
        return EPOCH_NS + round(self._cycle * self._settings.period * 1e9)

    @property
    def guidance_time(self) -> float:
        """Seconds since guidance began in this session; negative before."""
        return (self._cycle - self._guided_since) * self._settings.period

    @property
    def tm_ms(self) -> int:
        """The `tm` of the next packet."""
        return _UPTIME_MS + int(self._cycle * self._settings.period * 1e3 + 1e-6)

    def packet(self) -> bytes | None:
        """Return the bytes of this cycle's packet, or None while no session runs."""
        if self.phase not in _MCI:
            return None
        arm, guidance, measured = self.arm, self._guidance, self.arm.measure()
        message = RobotMessage(
            seqno=self.seq,
            tm_ms=self.tm_ms,
            q=measured.q,
            q_planned=guidance.q,
            robot_ns=self.robot_ns,
            T_frame_tool=arm.robot.chain.forward(measured.q),
            mci=_MCI[self.phase],
            converged=self._near,
            utilization=guidance.utilization,
            qd=measured.qd,
            tau=measured.tau,
            tau_total=arm.sample.tau,
            tau_gravity=arm.sample.tau_gravity,
            q_reference=guidance.q,
            qd_reference=guidance.qd,
            mono_ns=self.robot_ns - EPOCH_NS,
            used_seq=self._used_seq,
            queue_depth=self._left,
        )
        self._sent.append((self.tm_ms, self._cycle))
        self.seq += 1
        self.statistics.counts["packets"] += 1
        return self._codec.encode_robot(message)

    def accept(self, data: bytes) -> SensorMessage | None:
        """Decode an arrived datagram and queue it. Return the message, or None for what is no message to us.

        Parameters
        ----------
        data : one datagram, whatever it holds.
        """
        found = self._codec.decode_sensor(data)
        if isinstance(found, SensorMessage) and found.q is None:
            found = Drop("no joints", "a message without joint references in joint mode")
        if isinstance(found, Drop):
            self._drop(found, data)
            return None
        self._answered = True
        self.statistics.counts["replies"] += 1
        if self.phase != "guiding":
            self.statistics.drops["not guiding"] += 1
        elif len(self._queue) >= QUEUE_LENGTH:
            self.statistics.drops["queue full"] += 1
        else:
            self._queue.append(found)
        return found

    def advance(self) -> None:
        """Take at most one message, move the reference and the arm by one period."""
        self._in_phase += 1
        self._cycles[self.phase]()
        guiding = self.phase == "guiding"
        self._cycle += 1
        wrench = self._operator.at(self.guidance_time) if guiding else None
        self.arm.step(self._guidance.q, self._guidance.qd, wrench)
        if self.phase != "over" and not np.isfinite(self.arm.sample.q).all():
            self._die(0, "the simulated arm was driven beyond all numbers; push it with less force")

    def lose_peer(self) -> None:
        """End the session as CommTimeout does. For lockstep, where robot time stands still while the peer is silent."""
        if self.phase in _MCI:
            self._no_data()

    def stop(self, reason: str) -> None:
        """End for good.

        Parameters
        ----------
        reason : why, in words.
        """
        if self.phase != "over":
            self.reason = reason
            self._enter("over")

    def _begin_session(self, first_cycle: int) -> None:
        self.session += 1
        self.statistics.counts["sessions"] += 1
        self.seq = self._used_seq = self._left = self._near_for = 0
        self._near = False
        self._q_ref: np.ndarray | None = None
        self._qd_ref: np.ndarray | None = None
        self._told: set[str] = set()
        self._queue.clear()
        self._sent.clear()
        streamed = math.ceil(self._settings.stream / self._settings.period - 1e-9)
        self._guided_since = first_cycle + streamed
        self._enter("streaming" if streamed else "guiding")

    def _enter(self, phase: str) -> None:
        self.phase, self._in_phase = phase, 0
        if phase == "guiding":
            self._silent_for = 0
            self._guidance.begin()

    def _lasted(self, seconds: float) -> bool:
        return self._in_phase * self._settings.period >= seconds - 1e-9

    def _stream(self) -> None:
        self._guidance.brake()
        if self._cycle + 1 == self._guided_since:
            self._enter("guiding")

    def _guide(self) -> None:
        self._take()
        guidance = self._guidance
        if self.phase != "guiding":
            guidance.brake()
            return
        guidance.follow(self._q_ref, self._qd_ref)
        if violation := guidance.violation():
            self._fail(violation)
            return
        self._near = guidance.near(self._q_ref)
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
            if self._settings.program == "loop":
                self._begin_session(self._cycle + 1)
            else:
                self.stop("the program ran once")

    def _take(self) -> None:
        """Step 5 of the cycle: the next message, or none and the last reference stays."""
        self.statistics.queue[len(self._queue)] += 1
        if not self._queue:
            self._silent_for += 1
            self.statistics.counts["starved"] += self._in_phase > 1  # nothing can have come in the first cycle
            return
        self._silent_for = 0
        message = self._queue.popleft()
        self._left = len(self._queue)
        self._note_age(message)
        q, qd = message.q, message.qd
        if q is None or not _is_number(q) or (qd is not None and not _is_number(qd)):
            self._die(10014, "System failure state: a reference is no usable number; restart the controller")
        elif refusal := self._guidance.refusal(q):
            self._fail(refusal)
        else:
            self._q_ref, self._qd_ref, self._used_seq = q, qd, message.seqno or 0

    def _note_age(self, message: SensorMessage) -> None:
        """Cycles between the packet that was answered and now, for peers that echo our time."""
        for tm, cycle in reversed(self._sent):
            if tm == message.tm_ms:
                self.statistics.age[self._cycle - cycle] += 1
                return

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

    def _drop(self, drop: Drop, data: bytes) -> None:
        """Count what is no message; say it once per kind and session."""
        self.statistics.drops[drop.reason] += 1
        if drop.reason not in self._told:
            self._told.add(drop.reason)
            self._event(0, f"dropped a datagram, {drop.reason}: {drop.detail}; first bytes {data[:32].hex(' ')}")

    def _event(self, number: int, text: str) -> None:
        event = Event(round(self.uptime, 6), self.arm.robot.name, number, text)
        self.statistics.events.append(event)
        if self._on_event:
            self._on_event(str(event))


def _is_number(values: np.ndarray) -> bool:
    """Whether all values are finite, and not so large that sums of them would not be."""
    return bool((np.abs(values) < _ABSURD).all())
