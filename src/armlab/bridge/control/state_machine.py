"""State machine of a run: `Mode`, and `StateMachine`, which selects the reply to each packet.

WAITING -> HOLDING (not ready: the feedback is echoed; ready: the position is frozen) -> RUNNING -> STOPPING -> ENDED.
LISTENING never sends. *Hold* always means that the reference velocity ramps to zero within the acceleration limits;
the position then stays constant.

The time step of a reference is the measured robot time since the last reference sent. Implausible feedback is never
echoed or held. The robot becomes ready after three consecutive plausible packets; three consecutive implausible packets
stop the run.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np

from armlab import kernels
from armlab.bridge.control.external_axes import ExternalReferences, joined
from armlab.bridge.control.feedback import MCI_RUNNING, READY_AFTER, STOP_AFTER, FeedbackCheck, Readiness
from armlab.bridge.control.limits import Limits, Reply, entry_refusal, limiter_of, refusal, requested
from armlab.bridge.control.session import Sample
from armlab.bridge.control.torque import Admittance, Torques
from armlab.bridge.net.events import Tell, nobody
from armlab.errors import CommandRefused, LinkError
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Packet

SLOTS = tuple(getattr(State, name) for name in State.__slots__)
PLAIN = State(0.0, 0.0, np.zeros(0), np.zeros(0), np.zeros(0))


STOP_TIME = 0.5  # s at rest before a run ends
_UNSENT = 500  # unsent replies that end a stop; after 2 s, the robot has timed out
_REFUSALS = 3  # consecutive refusals that end the run
_GAP = 3.0  # periods: maximum time step of a reference after a gap
_ENTRY_PATIENCE = 1.0  # s of refused first positions before a warning
_BITS = 1, 2, 4, 8, 16, 32  # bits of `Reply.clamped`


class Mode(Enum):
    """Mode of a run."""

    WAITING = "waiting"
    LISTENING = "listening"
    HOLDING = "holding"
    RUNNING = "running"
    STOPPING = "stopping"
    ENDED = "ended"


_CALLING, _UNANSWERED = (Mode.HOLDING, Mode.RUNNING), (Mode.WAITING, Mode.LISTENING)
_LAST = (Mode.STOPPING, Mode.ENDED)


class StateMachine:
    """Decides for each packet whether to call the controller and which reply to send."""

    ready: bool
    t: float
    elapsed: float
    q_start: np.ndarray
    reason: str
    refusing: str
    clamps: np.ndarray
    worst_ratio: float
    refused: int
    guided: bool

    def __init__(
        self,
        robot: Robot,
        limits: Limits,
        *,
        commands: bool = True,
        capabilities: frozenset[str] = frozenset(("position", "velocity")),
        answer_stream: bool = True,
        on_event: Tell = nobody,
        admittance: Admittance | None = None,
    ) -> None:
        self._robot, self._limits = robot, limits
        self._capabilities = capabilities
        self._torques = Torques(robot, limits, capabilities, admittance)
        self._answer_stream, self._on_event = answer_stream, on_event
        self._limiter, self._external = limiter_of(limits, robot), ExternalReferences(limits.external, capabilities)
        self._last = self._limiter.rest(np.full(robot.n, np.nan))
        self._no_torque = self._last.q  # NaN: unmeasured
        self.mode = Mode.WAITING if commands else Mode.LISTENING
        self.ready = False
        self.t = self.elapsed = self._rested = self._waited = 0.0
        self.q_start = self._last.q
        self.failure: LinkError | None = None
        self.reason = self.refusing = ""
        self.clamps = np.zeros((len(_BITS), robot.n), dtype=int)
        self.worst_ratio = 1.0
        self.refused = self._refused_in_a_row = self._unsent = 0
        self._packet: Packet | None = None
        self._feedback, self._readiness = FeedbackCheck(robot, limits), Readiness()
        self._dt = self._passed = 0.0  # s since the last reference sent, and since the last packet
        self._longest = np.inf
        self._before = self._memory
        self._qd = self._last.qd
        self.guided = self._doubtful = self._warned = False

    @property
    def calls(self) -> bool:
        return self.ready and not self._doubtful and self.mode in _CALLING

    @property
    def _may_be_guided(self) -> bool:
        """Whether a guided robot no longer reports its states; the arm then holds without jumping to the feedback."""
        return self.guided and self._readiness.is_unknown

    @property
    def _memory(self) -> tuple[float, float, Reply, Any, Any, Any]:
        external = None if self._limits.external is None else self._external.memory
        return self._dt, self._rested, self._last, self._limiter.memory, self._torques.memory, external

    def observe(self, sample: Sample) -> None:
        """Update readiness, time and mode with one sample; `answer` replies to the newest sample."""
        packet, self._qd = sample.packet, sample.qd
        self._packet = packet
        if sample.fresh:
            self.t, self._dt, self.guided, self.ready = 0.0, 0.0, False, False
            self._external.begin()
            self._feedback.begin()
            self._readiness.begin()
            if self.mode is Mode.RUNNING:
                self.mode = Mode.HOLDING
        else:
            self.t += sample.dt if self.guided or self.mode is Mode.LISTENING else 0.0
        self._passed = sample.step
        self._dt += sample.step
        if self._limits.external is not None:
            problem = self._external.observe(packet, sample.dt)
            if problem:
                self._on_event(problem, warn=True)
        if self.mode is Mode.LISTENING:
            self.elapsed += 0.0 if sample.fresh else sample.dt
            return
        if self.mode is Mode.WAITING:
            self.mode = Mode.HOLDING
        problem = self._feedback.check(packet.q, sample.dt, self._last if self.ready else None)
        self._doubtful = bool(problem)
        if problem:
            self._doubt(problem)
        was_unknown = not self.ready and self._may_be_guided
        why = self._readiness.not_ready_reason(packet)
        ready = not why and (self.ready or self._feedback.plausible >= READY_AFTER)
        if ready and self.ready:
            self.elapsed += sample.dt
        elif ready and was_unknown:
            self._on_event("The robot reports its states again.")
        elif ready:
            self._become_ready(packet)
        elif self.ready:
            self._on_event(f"The robot is not ready: {why}.", warn=True)
            self.mode = Mode.HOLDING if self.mode is Mode.RUNNING else self.mode
        self.ready = ready

    def state(self, sample: Sample, t_receive: int, fused: Mapping[str, Any]) -> State:
        """Return the State of the sample just observed, with the previous reply and the `fused` fields."""
        packet, last, plain = sample.packet, self._last, PLAIN
        (
            seqno, _, robot_ns, q, q_planned, q_ext, _, tau, tau_source, T_frame_tool, wrench_raw, motors, mci, rapid,
            converged, utilization, robotware, rapid_data, rapid_digital, _, _,
        ) = packet  # fmt: skip
        values = (
            self.t, sample.dt, q, sample.qd, self._no_torque if tau is None else tau, None, seqno, sample.missed,
            sample.session, sample.qd_source, tau_source, self.q_start if self.guided else q, q_planned, last.q,
            last.qd, last.clamped, T_frame_tool, wrench_raw, plain.wrench, q_ext, motors, rapid, mci, converged,
            utilization, robotware, rapid_data, rapid_digital, robot_ns, t_receive, plain.sources, self._robot.name,
            0.0, plain.details, (),
        )  # fmt: skip
        state: State = kernels.filled(State, SLOTS, values)
        for name, value in fused.items():
            object.__setattr__(state, name, value)
        return state

    def answer(self, command: Command | None, period: float) -> Reply | None:
        """Return the reply to the newest observed packet, or None to send nothing."""
        packet, self._before = self._packet, self._memory
        if packet is None or self.mode in _UNANSWERED:
            return None
        if self.mode is Mode.ENDED and self._rested < STOP_TIME:  # an arm at rest still gets replies while others stop
            return None
        self._longest = _GAP * period
        if self._dt == 0.0:  # this packet has been answered
            return self._last
        if not self.ready and self._may_be_guided:
            self._last = self._held()
        elif not self.ready:
            self._rest()
            q = self._feedback.q
            if q is None or not (self._answer_stream or packet.mci == MCI_RUNNING):
                return None
            self._last = joined(self._limiter.rest(q), self._external.rest(packet))
        elif self.mode in _LAST:
            self._last = self._held()
            if self._limiter.at_rest and self._external.at_rest:
                self._rest()
        elif self._doubtful:
            self._last = self._held()
        else:
            self.refusing = ""
            self._last = self._follow(Command() if command is None else command, packet)
        self._dt = 0.0
        if any(self._last.clamped.tobytes()):  # ten times faster than ndarray.any
            self.clamps += [(self._last.clamped & bit) != 0 for bit in _BITS]
            self.worst_ratio = min(self.worst_ratio, self._last.ratio)
        return self._last

    def hold(self, period: float) -> Reply | None:
        """Return the hold reply to the newest packet while the controller is overdue; the mode does not change."""
        if not self.calls or self._dt == 0.0:
            return self.answer(None, period)
        self._before, self._longest = self._memory, _GAP * period
        self._last, self._dt = self._held(), 0.0
        return self._last

    def take_back(self, waits: bool = False) -> None:
        """Undo the last reply, which was not sent; the next reply continues from the robot's last reference."""
        self._dt, rested, self._last, self._limiter.memory, self._torques.memory, external = self._before
        if external is not None:
            self._external.memory = external
        if waits:
            self._dt = max(0.0, self._dt - self._passed)
        if self.mode is not Mode.STOPPING:
            return
        self._rested, self._unsent = rested, self._unsent + 1
        if self._unsent >= _UNSENT:
            problem = (
                f"Expected to send the replies that bring the arm to rest, got {_UNSENT} unsent replies. The robot "
                "keeps the last reference until its time-out. Check the network of this computer."
            )
            self.mode, self.failure = Mode.ENDED, self.failure or LinkError(problem)
            self._on_event(problem, warn=True)

    def stop(self, reason: str, failure: LinkError | None = None) -> None:
        """Bring the arm to rest and end the run; only the first reason is stored."""
        if self.mode in _LAST:
            return
        self.reason, self.failure = reason, failure
        self.mode = Mode.ENDED if self.mode in _UNANSWERED else Mode.STOPPING  # set first, because the event may fail
        self._on_event(f"Stopping: {reason}.")

    def lose(self, reason: str, resume: bool) -> None:
        self.ready = False
        self._packet = None
        if self.mode is Mode.STOPPING:
            self.mode = Mode.ENDED
        elif not resume:
            self.reason, self.mode = reason, Mode.ENDED
        elif self.mode is not Mode.LISTENING:
            self.mode = Mode.WAITING

    def _follow(self, command: Command, packet: Packet) -> Reply:
        try:
            q, qd, tau = requested(command, self._robot)
            if tau is not None:
                q, qd, tau = self._torques.requested(q, qd, tau, packet.q, self._qd, packet.tau is not None)
            if command.ends:
                self.stop("the controller ended the run")
                return self._held()
            external, beside = self._external, None
            if external.moves or not (command.q_ext is command.rapid_data is command.rapid_digital is None):
                beside = external.follow(command, packet, self._dt, self._longest)
        except CommandRefused as error:
            self.stop("a command was refused", error)
            return self._held()
        reply = self._moved(q, qd, tau, packet)
        return reply if beside is None else joined(reply, beside)

    def _moved(self, q: np.ndarray | None, qd: np.ndarray | None, tau: np.ndarray | None, packet: Packet) -> Reply:
        """Return the joint reply to a valid command."""
        if q is None and qd is None:
            if tau is not None:
                return self._free(tau, packet)
            self.mode, self._refused_in_a_row = Mode.HOLDING, 0
            return self._still()
        before = self._limiter.memory
        if self.mode is Mode.HOLDING and q is not None:
            problem = entry_refusal(q, self._limiter.q, self._limits.entry, self._robot)
            if problem:
                return self._refuse_entry(problem)
        reply = self._limiter.step(q, qd, self._dt, self._longest)
        if tau is not None or self._torques.memory is not None:
            reply = self._torques.limited(reply, None if reply.refused else tau, self._dt, self._longest)
        if reply.refused:
            self._refuse(refusal(reply.refused, q, qd, self._limiter.sent(before), self._robot))
        else:
            self.mode, self._refused_in_a_row, self._waited = Mode.RUNNING, 0, 0.0
        return reply

    def _free(self, tau: np.ndarray, packet: Packet) -> Reply:
        """Reply to a torque-only command; the position loop is off while the arm is within its limits."""
        problem = self._torques.outside(packet.q, self._qd)
        if problem:
            self._refuse(problem)
            return self._still()
        self.mode, self._refused_in_a_row, self._waited = Mode.RUNNING, 0, 0.0
        return self._torques.limited(self._limiter.follow(packet.q, self._qd), tau, self._dt, self._longest)

    def _held(self) -> Reply:
        return joined(self._still(), self._external.hold(self._dt, self._longest))

    def _still(self) -> Reply:
        return self._torques.limited(self._limiter.hold(self._dt, self._longest), None, self._dt, self._longest)

    def _refuse(self, problem: str) -> None:
        self.refused, self.refusing = self.refused + 1, problem
        self._refused_in_a_row += 1
        if self._refused_in_a_row == 1:
            self._on_event(problem, warn=True)
        if self._refused_in_a_row >= _REFUSALS:
            self.stop("commands were refused", CommandRefused(problem))

    def _refuse_entry(self, problem: str) -> Reply:
        self.refused, self.refusing = self.refused + 1, problem
        self._waited += self._passed
        if self._waited >= _ENTRY_PATIENCE and not self._warned:
            self._warned = True
            self._on_event(problem, warn=True)
        return self._still()

    def _rest(self) -> None:
        if self.mode is Mode.STOPPING:
            self._rested += self._passed
            if self._rested >= STOP_TIME:
                self.mode = Mode.ENDED

    def _become_ready(self, packet: Packet) -> None:
        self._torques.reset()
        self._dt = self._passed  # counted from this packet's feedback
        self._last = joined(self._limiter.rest(packet.q), self._external.rest(packet))
        self._refused_in_a_row, self._waited, self._warned = 0, 0.0, False
        if not self.guided:
            self.guided, self.t, self.q_start = True, 0.0, packet.q
            if packet.tau is None and "torque" in self._capabilities:
                self._on_event(
                    "The robot reports no torques, so it accepts no torque commands and its contact force is unknown."
                )
        self._on_event("The robot is ready and holds its position.")

    def _doubt(self, problem: str) -> None:
        """Report implausible feedback; three consecutive packets stop the run."""
        if self._feedback.implausible <= 1.0:
            self._on_event(problem, warn=True)
        if self._feedback.implausible >= STOP_AFTER and (self.ready or self._feedback.q is None):
            self.stop("the feedback is implausible", LinkError(problem))
            if not self.ready:  # feedback in wrong units must not be echoed: the arm would jump
                self._rested, self.mode = 0.0, Mode.ENDED
