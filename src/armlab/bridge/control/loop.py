"""The loop: receive, decode, ask the controller, limit, send one reply, record. In this order, every packet.

One reply per packet, never more; none for a packet that a newer one has overtaken. One arm paces: the controller is
called on its packets. Another arm is answered in its own tick with the newest command it was given. Everything but the
controller runs under one lock, which the guard thread takes when the controller is overdue.

`merge_states` makes one State of several arms, `split_command` gives each arm its part of a Command.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from mmap import mmap
from operator import attrgetter
from typing import Any

import numpy as np

from armlab.bridge.control.arm import ArmSession
from armlab.bridge.control.realtime import Lateness, Waiting, collect_if_due
from armlab.bridge.control.session import Sample
from armlab.bridge.control.state_machine import Mode
from armlab.bridge.control.supervision import Settings
from armlab.errors import CommandRefused, ControllerFailed, ControllerLate, LinkError
from armlab.robots import Robot
from armlab.state import Command, State

_JOINTS = ("q", "qd", "tau", "q_start", "q_planned", "q_sent", "qd_sent")
_OF_PACE = (
    "dt", "seq", "missed", "session", "qd_source", "tau_source", "motors", "rapid", "mci", "converged", "utilization",
    "robotware", "robot_ns", "t_receive", "sources",
)  # fmt: skip


def merge_states(states: Sequence[State], ages: Sequence[float], pace: int, t: float) -> State:
    """Return the state of all arms: joint arrays one arm after another, each arm's own State in `arms` with its age.

    Time, sequence and state numbers are those of the pacing arm. What a fused state cannot say (poses, wrenches) is
    NaN: look into `arms`.
    """
    fields: dict[str, Any] = {name: getattr(states[pace], name) for name in _OF_PACE}
    for name in (*_JOINTS, "clamped"):
        fields[name] = np.concatenate([getattr(state, name) for state in states])
        fields[name].flags.writeable = False
    return State(
        t=t,
        robot="+".join(state.robot for state in states),
        arms=tuple(replace(one, age=age) if age > 0.0 else one for one, age in zip(states, ages, strict=True)),
        **fields,
    )


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
            f"Expected the controller to return one Command of all joints, one per arm ({names}) or None, got "
            f"{type(asked).__name__}{f' of {len(asked)}' if isinstance(asked, Sequence) else ''}. "
            "Write Command(q) with all joints, or a tuple of one Command per arm."
        )
    for name in ("q_ext", "rapid_data", "rapid_digital"):
        if getattr(asked, name) is not None:
            raise CommandRefused(
                f"Expected no {name} in a Command of all joints: it does not say for which arm. "
                "Return a tuple of one Command per arm."
            )
    parts = [_parts(name, getattr(asked, name), robots) for name in ("q", "qd", "tau")]
    records = [asked.record if index == pace else {} for index in range(len(robots))]
    return [Command(q, qd, tau, record, asked.ends) for q, qd, tau, record in zip(*parts, records, strict=True)]


def _parts(name: str, values: Any, robots: Sequence[Robot]) -> Sequence[np.ndarray | None]:
    if values is None:
        return (None,) * len(robots)
    array, ends = np.asarray(values), np.cumsum([robot.n for robot in robots])
    if array.shape != (ends[-1],):
        joints = " and ".join(f"{robot.n} of {robot.name}" for robot in robots)
        raise CommandRefused(
            f"Expected Command.{name} of shape ({ends[-1]},), {joints}, got {array.shape}. "
            "Write all joints one arm after another, or return a tuple of one Command per arm."
        )
    return np.split(array, ends[:-1])


Controller = Callable[[State], Command | Sequence[Command | None] | None]
"""What decides: called with each state, returns a command or None for hold; with several arms also one per arm."""

_LOOK = 0.05  # s between two looks at silence; an interrupt waits no longer either
_GRACE = 0.25  # of a period, that the controller has in any case
_BLAME = 0.5  # of a period: a late cycle is the controller's fault when its call took longer
_HANGS = 1_000_000_000  # ns in one call of the controller, after which nobody waits for its return
_NAP = 2e-3  # s the guard waits for a packet
_SPARE = 1_000_000  # ns to the next packet that leave time to collect garbage
_PROGRESS = 0.1  # s between two calls of progress
_STALE_PERIODS, _STALE = 3.0, 0.02  # an arm unheard for longer, the larger of the two, holds the others
_SERVES = 2.5  # periods of the pacing arm for which a command serves another arm
_elapsed = attrgetter("machine.elapsed")  # robot time while an arm was ready [s]
_RESERVE = 2**24  # bytes, given back by what ends the run: to bring the arms to rest and to tell why needs some


class Loop:
    """Runs the arms of a link until all have ended."""

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
        self._reserve: mmap | None = None  # pages that nobody touches: address space, no memory
        self._next_progress = 0.0
        self._looked_ns = time.monotonic_ns()
        self._sessions: tuple[int, ...] = ()
        self._t0 = 0.0
        # Shared with the guard. `_calling` becomes False only under the lock; `_pending` stays while it is True.
        self._calling = self._taken = self._told = False
        self._called_ns, self._deadline_ns = 0, 0.0
        self._pending: Sample | None = None

    @property
    def failure(self) -> LinkError | None:
        """What `run` of the link raises."""
        return next((arm.machine.failure for arm in self._arms if arm.machine.failure is not None), None)

    def interrupt(self) -> None:
        """Stop at the next packet; the second time, or to break off a call that hangs, raise KeyboardInterrupt."""
        again, self.interrupted = self.interrupted, True
        if again or self._hangs:
            raise KeyboardInterrupt

    @property
    def _hangs(self) -> bool:
        """Whether the controller has not returned for so long that it may never do."""
        return self._calling and time.monotonic_ns() - self._called_ns > _HANGS

    def run(self) -> None:
        try:
            self._reserve = mmap(-1, _RESERVE)
        except OSError as error:
            self.reason = "there is no memory for its end"
            text = f"Expected {_RESERVE >> 20} MiB of memory to set aside for the end of the run: {error.strerror}. "
            raise LinkError(f"{text}End other programs, or raise the limit of this one.") from error
        ended = False
        while not ended:
            try:
                ended = self._have_ended()
                if not ended:
                    self.cycle()
            except Exception as error:
                with self._lock:
                    ended = self._has_failed  # again: the arms cannot be brought to rest
                    if not ended:
                        self._fail(error)
        self._give_back()

    def _give_back(self) -> None:
        if self._reserve is not None:
            self._reserve.close()

    def _fail(self, error: Exception) -> None:
        """Stop after an error of a codec or a source of the user's, or ours: no arm goes on at its speed."""
        self._give_back()
        self._has_failed = True
        failure = LinkError(f"Expected a cycle without errors, got {_named(error)}.")
        failure.__cause__ = error
        with suppress(Exception):  # the arms come to rest, whoever cannot be told
            self._stop("the bridge failed", failure)
        self._pace.machine.failure = self.failure or failure  # also when the arms were to stop already
        with suppress(Exception):
            self._pace.recording.event(str(failure), warn=True)

    def cycle(self) -> None:
        """Wait for one packet, answer it, record it."""
        found = self._waiting.next(_LOOK)
        pending = asked = None
        with self._lock:
            if found is not None:
                arm = self._arms[found[0]]
                pending = arm.receive(found[1])
                if pending is not None and arm is self._pace and self._may_ask(pending):
                    asked = pending
                    if self._others:
                        self._serve_others()
                elif pending is not None:
                    self._answer(arm, pending)
        if asked is not None:
            self._call(asked)
        for arm in self._arms:
            arm.record()
        now_ns = time.monotonic_ns()
        if pending is None or now_ns - self._looked_ns > 1e9 * _LOOK:  # often enough when only one arm is silent
            self._looked_ns = now_ns
            for arm in self._arms:
                arm.supervisor.check_silence(arm.arrived_ns)
                arm.recording.catch_up()
        settings, elapsed = self._settings, min(map(_elapsed, self._arms))
        if self.interrupted:
            self._stop("interrupted")
        if settings.seconds is not None and elapsed >= settings.seconds:
            self._stop("the time is up")
        if settings.progress is not None and elapsed >= self._next_progress:
            self._tell_progress(settings.progress, elapsed)
        spare_ns = time.monotonic_ns() + _SPARE
        for arm in () if self._in_lockstep else self._arms:
            next_ns = arm.prediction.next_ns
            if next_ns is not None and next_ns < spare_ns:
                return
        collect_if_due()

    def _tell_progress(self, progress: Callable[[float], None], elapsed: float) -> None:
        self._next_progress = elapsed + _PROGRESS
        try:
            progress(elapsed)
        except Exception as error:
            self._give_back()
            failure = ControllerFailed(f"`progress` raised {_named(error)}. The arm was stopped.")
            failure.__cause__ = error
            self._stop("the display of progress failed", failure)

    def overdue(self) -> float:
        """Return the seconds until the controller is overdue, 0 or less when it is. For the guard."""
        if not self._calling:
            return 1.0
        return 0.0 if self._taken else 1e-9 * (self._deadline_ns - time.monotonic_ns())

    def answer_for_controller(self) -> None:
        """Hold for the packet whose reply is overdue and for newer ones until the controller returns. For the guard."""
        if self._taken:
            time.sleep(_NAP)  # only the loop's own thread may wait on the ports
        with self._lock:
            if self.overdue() > 0.0:
                return
            try:
                self._hold_for_controller()
            except Exception as error:  # the guard must go on, and the run end
                self._taken = True
                self._fail(error)

    def _hold_for_controller(self) -> None:
        pace = self._pace
        pending = pace.receive(pace.port.receive(), None if self._taken else self._pending)
        self._taken = True
        if pending is not None:
            pace.reply(pending, None, pace.machine.hold(pace.period), late=True)
        self._serve_others()
        if self._hangs and not self._told:
            self._told = True
            sentence = f"The controller has not returned for {1e-9 * _HANGS:g} s; the arm is held meanwhile."
            pace.recording.event(f"{sentence} Ctrl-C breaks it off and ends the run.", warn=True)
        for arm in self._arms:
            arm.record()

    def _may_ask(self, pending: Sample | None = None) -> bool:
        """Whether the controller may be asked: all arms are ready, no source it requires is stale, all were heard."""
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
        """Answer without the controller: with the newest command for an arm that does not pace, else hold."""
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
        """Ask the controller and answer; when the guard has answered meanwhile, the result is discarded."""
        pace, controller, period_ns = self._pace, self._controller, 1e9 * self._pace.period
        state = self._state(pending) if self._others else pending.state
        asked, failure = None, None
        self._pending, self._taken = pending, False
        start = self._called_ns = time.monotonic_ns()
        self._deadline_ns = max(pending.deadline_ns, start + _GRACE * period_ns)
        self._calling = True
        try:
            asked = controller(state) if controller is not None else None
        except BaseException as error:  # also SystemExit: the arm must not go on at its last speed
            by_hand = isinstance(error, KeyboardInterrupt) and self.interrupted
            if by_hand and not self._hangs:
                raise  # the second Ctrl-C
            self._give_back()
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
                self._obey(pending, asked, call_ns)
            if not self._in_lockstep:  # the controller, not the computer, makes too many cycles late
                blamed = self._taken or (pace.was_late and call_ns > _BLAME * period_ns)
                too_late = self._lateness.add(time.monotonic_ns(), blamed, call_ns)
                if too_late:
                    sentence = f"The controller was too slow: {too_late}. The arm was stopped."
                    self._stop("the controller was late", ControllerLate(f"{sentence} Give work to another thread."))

    def _state(self, pending: Sample) -> State:
        pendings = [arm.newest or pending for arm in self._arms]
        sessions = tuple(one.session for one in pendings)
        if sessions != self._sessions:
            self._sessions, self._t0 = sessions, pending.state.t
        ages = [1e-9 * (pending.stamp_ns - one.stamp_ns) for one in pendings]
        return merge_states([one.state for one in pendings], ages, self._pace_index, pending.state.t - self._t0)

    def _obey(self, pending: Sample, asked: Any, call_ns: int) -> None:
        """Answer the newest packet of the pacing arm with what the controller wants, keep the rest for the others."""
        pace = self._pace
        try:
            commands = split_command(asked, self._robots, self._pace_index) if self._others else (asked,)
        except CommandRefused as error:
            self._stop("a command was refused", error)
            commands = (None,) * len(self._arms)
        newest, arrival = pending, pace.port.receive()
        if arrival is not None:
            newest = pace.receive(arrival, pending) or pending
        is_same = newest.session == pending.session
        for arm, command in zip(self._arms, commands, strict=True):
            if arm is pace:
                command = command if is_same else None
                pace.reply(newest, command, pace.machine.answer(command, pace.period), call_ns=call_ns)
            else:
                arm.set_command(command if is_same else None)

    def _have_ended(self) -> bool:
        """Whether all arms have ended; one that stops or has ended stops the others."""
        ended = True
        for arm in self._arms:
            mode = arm.machine.mode
            if mode is Mode.STOPPING or mode is Mode.ENDED:
                self._stop(arm.machine.reason)
            ended = ended and mode is Mode.ENDED
        return ended

    def _stop(self, reason: str, failure: LinkError | None = None) -> None:
        """Bring all arms to rest and end; the first reason stays. The pacing arm carries the failure."""
        self.reason = self.reason or reason
        self._pace.machine.stop(reason, failure)
        for arm in self._others:
            arm.machine.stop(reason)


def _named(error: BaseException) -> str:
    """Return type and text of an error, whatever it is."""
    try:
        text = "no memory is left" if isinstance(error, MemoryError) else str(error)
    except Exception:
        text = "its text cannot be read"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
