"""Control loop: receive and decode a packet, call the controller, apply the limits, send one reply, then record.

Each packet gets at most one reply, and a packet overtaken by a newer packet gets no reply. One arm paces the loop: its
packets trigger the controller calls. The other arms receive their newest commands on their own ticks. All code except
the controller runs under one lock, which the watchdog thread takes when the controller is overdue.

`merge_states` combines the States of several arms; `split_command` splits a Command among the arms.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from itertools import accumulate, chain, pairwise
from mmap import mmap
from operator import attrgetter
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from armlab import kernels
from armlab.bridge.control.arm import ArmSession, End
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.realtime import Lateness, Waiting, collect_if_due
from armlab.bridge.control.session import Sample
from armlab.bridge.control.state_machine import PLAIN, SLOTS, Mode
from armlab.bridge.control.supervision import Settings
from armlab.bridge.inputs.fusion import Fusion
from armlab.bridge.net.events import nobody
from armlab.bridge.net.sockets import Arrival
from armlab.errors import CommandRefused, ControllerFailed, ControllerLate, LinkError
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Drop, Packet, Reference
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec

_joints = attrgetter("q", "qd", "tau", "q_start", "q_planned", "q_sent", "qd_sent")
_of_pace = attrgetter(
    "dt", "seq", "missed", "session", "qd_source", "tau_source", "motors", "rapid", "mci", "converged", "utilization",
    "robotware", "robot_ns", "t_receive", "sources",
)  # fmt: skip
_values = attrgetter(*State.__slots__)
_AGE = list(State.__slots__).index("age")


def merge_states(states: Sequence[State], ages: Sequence[float], pace: int, t: float) -> State:
    """Return the State of all arms: joint arrays are concatenated, and `arms` contains the State and age of each arm.

    Time, sequence number and robot states are taken from the pacing arm. Poses and wrenches are NaN; see `arms`.
    """
    arrays = list(chain.from_iterable(zip(*map(_joints, states), strict=True)))
    flat, clamped = np.concatenate(arrays), np.concatenate([state.clamped for state in states])
    flat.flags.writeable = clamped.flags.writeable = False
    ends = [0, *accumulate(map(len, arrays))][:: len(states)]
    q, qd, tau, q_start, q_planned, q_sent, qd_sent = [flat[a:b] for a, b in pairwise(ends)]
    (
        dt, seq, missed, session, qd_source, tau_source, motors, rapid, mci, converged, utilization, robotware,
        robot_ns, t_receive, sources,
    ) = _of_pace(states[pace])  # fmt: skip
    plain, robot = PLAIN, "+".join(state.robot for state in states)
    arms = tuple(_aged(one, age) if age > 0.0 else one for one, age in zip(states, ages, strict=True))
    return kernels.filled(
        State,
        SLOTS,
        (
            t, dt, q, qd, tau, None, seq, missed, session, qd_source, tau_source, q_start, q_planned, q_sent, qd_sent,
            clamped, plain.T_frame_tool, plain.wrench_raw, plain.wrench, plain.q_ext, motors, rapid, mci, converged,
            utilization, robotware, plain.rapid_data, plain.rapid_digital, robot_ns, t_receive, sources, robot, 0.0,
            plain.details, arms,
        ),
    )  # fmt: skip


def _aged(state: State, age: float) -> State:
    values = list(_values(state))
    values[_AGE] = age
    return kernels.filled(State, SLOTS, tuple(values))


def split_command(asked: Any, robots: Sequence[Robot], pace: int = 0) -> Sequence[Command | None]:
    if len(robots) == 1:
        return (asked,)
    if asked is None:
        return (None,) * len(robots)
    if isinstance(asked, Sequence) and len(asked) == len(robots):
        return asked
    if not isinstance(asked, Command):
        names = " and ".join(robot.name for robot in robots)
        raise CommandRefused(
            f"Expected the controller to return one Command for all joints, one per arm ({names}) or None, got "
            f"{type(asked).__name__}{f' of {len(asked)}' if isinstance(asked, Sequence) else ''}. "
            "Write Command(q) with all joints, or a tuple of one Command per arm."
        )
    for name in ("q_ext", "rapid_data", "rapid_digital"):
        if getattr(asked, name) is not None:
            raise CommandRefused(
                f"Expected no {name} in a single Command for all arms, because it does not specify the arm. "
                "Return a tuple of one Command per arm."
            )
    parts = [_parts(name, getattr(asked, name), robots) for name in ("q", "qd", "tau")]
    records = [asked.record if index == pace else {} for index in range(len(robots))]
    return [Command(q, qd, tau, record, asked.ends) for q, qd, tau, record in zip(*parts, records, strict=True)]


def _parts(name: str, values: Any, robots: Sequence[Robot]) -> Sequence[np.ndarray | None]:
    if values is None:
        return (None,) * len(robots)
    array, ends = np.asarray(values), list(accumulate(robot.n for robot in robots))
    if array.shape != (ends[-1],):
        joints = " and ".join(f"{robot.n} of {robot.name}" for robot in robots)
        raise CommandRefused(
            f"Expected Command.{name} of shape ({ends[-1]},), {joints}, got {array.shape}. "
            "Write all joints one arm after another, or return a tuple of one Command per arm."
        )
    return [array[a:b] for a, b in pairwise([0, *ends])]


Controller = Callable[[State], Command | Sequence[Command | None] | None]
"""Controller: maps a State to a Command or None (hold); with several arms, it may return one Command per arm."""

_CHECK_EVERY = 0.05  # s between checks for silence and interrupts
_GRACE = 0.25  # fraction of a period, minimum time for a controller call
_BLAME = 0.5  # fraction of a period; a late cycle with a longer call counts against the controller
_HANGS = 1_000_000_000  # ns, duration of a call after which the controller counts as hanging
_NAP = 2e-3  # s: pause of the watchdog between hold replies
_SPARE = 1_000_000  # ns: time before the next packet that suffices for garbage collection
_PROGRESS = 0.1  # s between progress calls
_STALE_PERIODS, _STALE = 3.0, 0.02  # periods and s; the other arms hold while an arm is silent for longer than both
_SERVES = 2.5  # periods of the pacing arm for which a command to another arm is valid
_elapsed = attrgetter("machine.elapsed")  # robot time while an arm was ready [s]
_RESERVE = 2**24  # bytes freed at the end of the run, needed to stop the arms and report the cause


class Loop:
    """Real-time loop over the arms of a link, which runs until every arm is in the mode ENDED."""

    interrupted: bool
    reason: str

    def __init__(
        self,
        arms: Sequence[ArmSession],
        waiting: Waiting,
        controller: Controller | None,
        settings: Settings,
        pace: int = 0,
    ) -> None:
        self._arms, self._pace, self._waiting = tuple(arms), arms[pace], waiting
        self._others = tuple(arm for arm in arms if arm is not self._pace)
        self._robots, self._pace_index = tuple(arm.robot for arm in arms), pace
        self._controller, self._settings = controller, settings
        self._in_lockstep = settings.clock == "robot"
        self._lateness = Lateness()
        self.interrupted = self._has_failed = False
        self.reason = ""
        self._lock = threading.Lock()
        self._reserve: mmap | None = None  # untouched pages use address space, but no memory
        self._next_progress = 0.0
        self._checked_ns = time.monotonic_ns()
        self._sessions: tuple[int, ...] = ()
        self._t0 = 0.0
        # Shared with the watchdog: `_calling` becomes False only under the lock; until then, `_pending` is constant.
        self._calling = self._taken = self._reported = False
        self._called_ns, self._deadline_ns = 0, 0.0
        self._pending: Sample | None = None

    @property
    def failure(self) -> LinkError | None:
        """Error for `Link.run` to raise, or None."""
        return next((arm.machine.failure for arm in self._arms if arm.machine.failure is not None), None)

    def interrupt(self) -> None:
        """Stop at the next packet; the second call, or a call while the controller hangs, raises KeyboardInterrupt."""
        again, self.interrupted = self.interrupted, True
        if again or self._hangs:
            raise KeyboardInterrupt

    @property
    def _hangs(self) -> bool:
        """Whether the current controller call has lasted so long that it may never return."""
        return self._calling and time.monotonic_ns() - self._called_ns > _HANGS

    def run(self) -> None:
        try:
            self._reserve = mmap(-1, _RESERVE)
        except OSError as error:
            self.reason = "not enough memory to end the run"
            text = f"Expected {_RESERVE >> 20} MiB of free memory for the end of the run: {error.strerror}. "
            raise LinkError(f"{text}Close other programs, or raise the memory limit of this program.") from error
        ended = False
        while not ended:
            try:
                ended = self._have_ended()
                if not ended:
                    self.cycle()
            except Exception as error:
                with self._lock:
                    ended = self._has_failed  # after a second failure, the arms cannot be brought to rest
                    if not ended:
                        self._fail(error)
        self._free_reserve()

    def _free_reserve(self) -> None:
        if self._reserve is not None:
            self._reserve.close()

    def _fail(self, error: Exception) -> None:
        """Stop after an internal error or an error in a custom codec or source, so that no arm keeps moving."""
        self._free_reserve()
        self._has_failed = True
        failure = LinkError(f"Expected the cycle to run without errors, got {_named(error)}.")
        failure.__cause__ = error
        with suppress(Exception):  # the arms come to rest even if a report fails
            self._stop("the bridge failed", failure)
        self._pace.machine.failure = self.failure or failure  # even if the arms are already stopping
        with suppress(Exception):
            self._pace.recording.event(str(failure), warn=True)
            self._pace.recording.catch_up()

    def cycle(self) -> None:
        """Wait for one packet, reply to it and to waiting packets of other arms, and record all of them."""
        pending = self.answer(self._waiting.next(_CHECK_EVERY))
        for _ in self._others:  # arms often send together; all replies are sent before any recording
            if self._have_ended() or (found := self._waiting.next(0.0)) is None:
                break
            pending = self.answer(found) or pending
        for arm in self._arms:
            arm.record()
        now_ns = time.monotonic_ns()
        if pending is None or now_ns - self._checked_ns > 1e9 * _CHECK_EVERY:  # even if only one arm is silent
            self._checked_ns = now_ns
            for arm in self._arms:
                arm.supervisor.check_silence(arm.arrived_ns)
                arm.recording.catch_up()
        settings, elapsed = self._settings, min(map(_elapsed, self._arms))
        if self.interrupted:
            self._stop("interrupted")
        if settings.seconds is not None and elapsed >= settings.seconds:
            self._stop("the time is up")
        if settings.progress is not None and elapsed >= self._next_progress:
            self._report_progress(settings.progress, elapsed)
        spare_ns = time.monotonic_ns() + _SPARE
        for arm in () if self._in_lockstep else self._arms:
            next_ns = arm.prediction.next_ns
            if next_ns is not None and next_ns < spare_ns:
                return
        collect_if_due()

    def answer(self, found: tuple[int, Arrival] | None) -> Sample | None:
        pending = accepted = None
        with self._lock:
            if found is not None:
                arm = self._arms[found[0]]
                pending = arm.receive(found[1])
                if pending is not None and arm is self._pace and self._may_ask(pending):
                    accepted = pending
                    if self._others:
                        self._serve_others()
                elif pending is not None:
                    self._answer(arm, pending)
        if accepted is not None:
            self._call(accepted)
        return pending

    def _report_progress(self, progress: Callable[[float], None], elapsed: float) -> None:
        self._next_progress = elapsed + _PROGRESS
        try:
            progress(elapsed)
        except Exception as error:
            self._free_reserve()
            failure = ControllerFailed(f"The callback `progress` raised {_named(error)}. The arm was stopped.")
            failure.__cause__ = error
            self._stop("the progress callback failed", failure)

    def overdue(self) -> float:
        """Called by the watchdog: return the time [s] until the controller is overdue, or a value <= 0 if it already
        is."""
        if not self._calling:
            return 1.0
        return 0.0 if self._taken else 1e-9 * (self._deadline_ns - time.monotonic_ns())

    def answer_for_controller(self) -> None:
        """Called by the watchdog: send hold replies until the controller returns."""
        if self._taken:
            time.sleep(_NAP)  # only the loop thread may wait on the ports
        with self._lock:
            if self.overdue() > 0.0:
                return
            try:
                self._hold_for_controller()
            except Exception as error:  # the watchdog must keep running to end the run
                self._taken = True
                self._fail(error)

    def _hold_for_controller(self) -> None:
        pace = self._pace
        pending = pace.receive(pace.port.receive(), None if self._taken else self._pending)
        self._taken = True
        if pending is not None:
            pace.reply(pending, None, pace.machine.hold(pace.period), late=True)
        self._serve_others()
        if self._hangs and not self._reported:
            self._reported = True
            sentence = f"The controller has not returned for {1e-9 * _HANGS:g} s; the arm holds its position meanwhile."
            pace.recording.event(f"{sentence} Press Ctrl-C to interrupt the controller and end the run.", warn=True)
        for arm in self._arms:
            arm.record()

    def _may_ask(self, pending: Sample | None = None) -> bool:
        """Return whether all arms are ready and have recent packets, and no required source is stale."""
        for arm in self._arms:
            if not arm.machine.calls or arm.fusion.missing:
                return False
        if pending is not None and not self._in_lockstep:
            for arm in self._others:
                longest = max(_STALE_PERIODS * arm.period, _STALE)
                if arm.newest is None or pending.arrival_ns - arm.newest.arrival_ns > 1e9 * longest:
                    return False
        return True

    def _answer(self, arm: ArmSession, pending: Sample) -> None:
        """Reply without calling the controller: the pacing arm holds, and any other arm gets its newest command."""
        command = None
        if arm is self._pace:
            for other in self._others:
                other.set_command(None)
        elif self._may_ask():
            command = arm.kept_command(pending, _SERVES * self._pace.period)
        arm.reply(pending, command, arm.machine.answer(command, arm.period))

    def _serve_others(self) -> None:
        for arm in self._others:
            pending = arm.receive(arm.port.receive())
            if pending is not None:
                self._answer(arm, pending)

    def _call(self, pending: Sample) -> None:
        """Call the controller and reply; discard the result if the watchdog has already replied."""
        pace, controller, period_ns = self._pace, self._controller, 1e9 * self._pace.period
        state = self._state(pending) if self._others else pending.state
        result, failure = None, None
        self._pending, self._taken = pending, False
        start = self._called_ns = time.monotonic_ns()
        self._deadline_ns = max(pending.deadline_ns, start + _GRACE * period_ns)
        self._calling = True
        try:
            result = controller(state) if controller is not None else None
        except BaseException as error:  # including SystemExit: the arm must not keep its last speed
            by_hand = isinstance(error, KeyboardInterrupt) and self.interrupted
            if by_hand and not self._hangs:
                raise  # the second Ctrl-C
            self._free_reserve()
            if not by_hand:
                failure = ControllerFailed(f"The controller raised {_named(error)}. The arm was stopped.")
                failure.__cause__ = error
        finally:
            call_ns = time.monotonic_ns() - start
            with self._lock:
                self._calling = False
        with self._lock:
            if failure is not None:
                self._stop("the controller failed", failure)
            if not self._taken:
                self._apply(pending, result, call_ns)
            if not self._in_lockstep:  # only lateness caused by the controller counts, not a busy computer
                blamed = self._taken or (pace.was_late and call_ns > _BLAME * period_ns)
                too_late = self._lateness.add(time.monotonic_ns(), blamed, call_ns)
                if too_late:
                    sentence = f"The controller was too slow: {too_late}. The arm was stopped."
                    self._stop("the controller was late", ControllerLate(f"{sentence} Move work to another thread."))

    def _state(self, pending: Sample) -> State:
        pendings = [arm.newest or pending for arm in self._arms]
        sessions = tuple(one.session for one in pendings)
        if sessions != self._sessions:
            self._sessions, self._t0 = sessions, pending.state.t
        ages = [1e-9 * (pending.stamp_ns - one.stamp_ns) for one in pendings]
        return merge_states([one.state for one in pendings], ages, self._pace_index, pending.state.t - self._t0)

    def _apply(self, pending: Sample, result: Any, call_ns: int) -> None:
        """Send the command for the pacing arm in reply to its newest packet; store the commands for the other arms."""
        pace = self._pace
        try:
            commands = split_command(result, self._robots, self._pace_index) if self._others else (result,)
        except CommandRefused as error:
            self._stop("a command was refused", error)
            commands = (None,) * len(self._arms)
        newest, arrival = pending, pace.port.receive()
        if arrival is not None:
            newest = pace.receive(arrival, pending) or pending
        is_same = newest.session == pending.session
        command = commands[self._pace_index] if is_same else None
        pace.reply(newest, command, pace.machine.answer(command, pace.period), call_ns=call_ns)
        for arm, command in zip(self._arms, commands, strict=True):
            if arm is not pace:
                arm.set_command(command if is_same else None)

    def _have_ended(self) -> bool:
        """Return whether all arms have ended; an arm that is stopping or has ended stops the others."""
        ended = True
        for arm in self._arms:
            mode = arm.machine.mode
            if mode is Mode.STOPPING or mode is Mode.ENDED:
                self._stop(arm.machine.reason)
            ended = ended and mode is Mode.ENDED
        return ended

    def _stop(self, reason: str, failure: LinkError | None = None) -> None:
        """Bring all arms to rest and end the run; only the first reason is stored, and only the pacing arm stores the
        failure."""
        self.reason = self.reason or reason
        self._pace.machine.stop(reason, failure)
        for arm in self._others:
            arm.machine.stop(reason)


_DRY_RUNS = 20  # before a run, because Python specialises code only after several executions


class DryRun:
    """Dry run of a cycle: a separate loop replies to a synthetic packet, and the reply is discarded.

    Between packets, other programs evict the loop's code from the processor caches. A dry run just before a packet is
    due brings the loop's code back into the cache, which shortens the reply latency by a third
    (benchmarks/bench_egm.py).
    """

    def __init__(self, end: End, limits: Limits) -> None:
        self.capabilities = end.codec.capabilities
        self._codec, robot = copy(end.codec), end.robot
        self._data = RobotSideCodec(robot).encode_robot(RobotMessage(0, 0, robot.q_home, robot.q_home))
        settings, silent, itself = Settings(), SimpleNamespace(event=nobody), cast(Any, self)  # port, codec and waiting
        arm_end = End(robot, itself, itself)
        arm = ArmSession(arm_end, limits, settings, 0, cast(Any, silent), Fusion(()), commands=True, answer_stream=True)
        self._arm, self._number = arm, 0
        self._loop = Loop([arm], itself, lambda state: Command(state.q_start), settings)
        for _ in range(_DRY_RUNS):
            self()

    def __call__(self) -> None:
        self._number += 1
        self._loop.answer((0, Arrival(self._data, ("", 0), time.monotonic_ns())))
        self._arm.rows.clear()

    def receive(self) -> None: ...

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        return True

    def reset(self) -> None:
        self._codec.reset()

    def decode(self, data: bytes) -> Packet | Drop:
        packet = self._codec.decode(data)
        if isinstance(packet, Drop):
            return packet
        return packet._replace(seqno=self._number, robot_ns=time.monotonic_ns())

    def encode(self, ref: Reference) -> bytes:
        return self._codec.encode(ref)


def _named(error: BaseException) -> str:
    """Return the type and text of an error; never raise another error."""
    try:
        text = "out of memory" if isinstance(error, MemoryError) else str(error)
    except Exception:
        text = "unreadable text"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
