"""The loop of one arm: receive, decode, ask the controller, limit, send one reply, record. In this order, every cycle.

One reply per packet, never more; none for a packet that a newer one has overtaken. Everything but the controller runs
under one lock, which the guard thread takes when the controller is overdue.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from armlab.bridge.conditions import collect_if_due
from armlab.bridge.latency import Latency
from armlab.bridge.limits import Reply
from armlab.bridge.port import Arrival, Port
from armlab.bridge.recording import Recording
from armlab.bridge.rehearsal import Rehearsal
from armlab.bridge.session import Sample, Session
from armlab.bridge.states import Guide, Mode
from armlab.bridge.supervision import Settings, Supervisor
from armlab.bridge.waiting import Waiting
from armlab.bridge.watchdog import Lateness
from armlab.errors import ControllerFailed, ControllerLate
from armlab.log import Tick
from armlab.state import Command, State
from armlab.wire.egm import Codec, Reference

__all__ = ["Controller", "Loop"]

Controller = Callable[[State], Command | None]
"""What decides: called with each state, returns a command or None for hold."""

_DROPS = 64  # refused datagrams per wake-up: a flood cannot hold the loop up
_BACKLOG = 1000  # datagrams per wake-up, more than wait after any stall: all but the newest packet are overtaken
_LOOK = 0.05  # s between two looks at silence and interrupts
_DEADLINE = 0.75  # of a period, from arrival to reply
_GRACE = 0.25  # of a period, that the controller has in any case
_BLAME = 0.5  # of a period: a late cycle is the controller's fault when its call took longer
_NAP = 2e-3  # s the guard waits for a packet
_SPARE = 1_000_000  # ns to the next packet that leave time to collect garbage
_PROGRESS = 0.1  # s between two calls of progress


class _Turn(NamedTuple):
    """A packet that is about to be answered, and what the controller sees of it."""

    sample: Sample
    state: State


class Loop:
    """Runs one arm until it ends.

    Parameters
    ----------
    port, codec, session, guide, waiting, recording : the parts.
    controller : see `Controller`; None listens only. settings : see `Settings`. rehearsal : see `rehearsal`.

    Attributes
    ----------
    latency : arrival to reply. replies, overtaken, late : packets. interrupted : set it to stop.
    """

    def __init__(
        self,
        port: Port,
        codec: Codec,
        session: Session,
        guide: Guide,
        waiting: Waiting,
        recording: Recording,
        controller: Controller | None,
        settings: Settings,
        rehearsal: Rehearsal | None = None,
    ) -> None:
        self._port, self._codec, self._session, self._guide = port, codec, session, guide
        self._waiting, self._recording, self._controller, self._settings = waiting, recording, controller, settings
        self._rehearsal = rehearsal
        self._in_lockstep = settings.clock == "robot"
        self.latency, self._lateness = Latency(), Lateness()
        self.replies = self.overtaken = self.late = self._ticks = 0
        self.interrupted = False
        self._supervisor = Supervisor(port, session, guide, settings, recording.event)
        self._lock = threading.Lock()
        self._wall_ns = time.time_ns() - time.monotonic_ns()
        self._heard_ns = time.monotonic_ns()
        self._robot_ns = 0
        self._next_progress = 0.0
        self._surpassed: list[_Turn] = []
        # Shared with the guard. `_calling` becomes False only under the lock, `_turn` does not change while it is True.
        self._calling = self._taken = self._was_late = False
        self._deadline_ns = 0.0
        self._turn: _Turn | None = None
        self._arrival: Arrival | None = None
        self._command: Command | None = None
        waiting.rehearse = self._rehearse

    @property
    def stamp_ns(self) -> int:
        """Now: wall clock at the start plus monotonic time since [ns]; in lockstep the robot's clock."""
        return self._robot_ns if self._in_lockstep and self._robot_ns else self._wall_ns + time.monotonic_ns()

    def run(self) -> None:
        """Run until the guide has ended. What it ended with is in `guide.reason` and `guide.failure`."""
        guide = self._guide
        while guide.mode is not Mode.ENDED:
            arrival = self._waiting.next(_LOOK)
            with self._lock:
                turn = self._take(arrival)
                if turn is None:
                    self._stop_if_interrupted()
                    self._supervisor.look(self._heard_ns)
                    continue
                asks = guide.calls
                if not asks:
                    self._reply(turn, None, guide.answer(None, self._session.period.seconds))
            if asks:
                self._call(turn)
            self._after()

    def overdue(self) -> float:
        """Return the seconds until the controller is overdue, 0 or less when it is. For the guard."""
        if not self._calling:
            return 1.0
        return 0.0 if self._taken else 1e-9 * (self._deadline_ns - time.monotonic_ns())

    def answer_for_controller(self) -> None:
        """Hold for the packet whose reply is overdue and for newer ones until the controller returns. For the guard."""
        if self._taken:
            time.sleep(_NAP)  # not port.wait: only the loop's own thread may wait on the port
        with self._lock:
            if self.overdue() > 0.0:
                return
            turn = self._take(self._port.receive(), None if self._taken else self._turn)
            self._taken = True
            if turn is not None:
                self._reply(turn, None, self._guide.hold(self._session.period.seconds), late=True)

    def _take(self, arrival: Arrival | None, unanswered: _Turn | None = None) -> _Turn | None:
        """Drain the port as far as a flood allows. Return the newest packet that counts, or the unanswered one."""
        newest, refused = unanswered, 0
        for _ in range(_BACKLOG):
            if arrival is None:
                break
            sample = self._session.accept(arrival)
            if sample is None:
                refused += 1
                if refused == _DROPS:
                    break  # before the next is taken from the port: it would be lost
            else:
                if newest is not None:
                    self._surpassed.append(newest)
                newest = self._observe(sample)
                self._arrival = arrival
            arrival = self._port.receive()
        return newest

    def _observe(self, sample: Sample) -> _Turn:
        self._guide.observe(sample)
        self._heard_ns, self._robot_ns = sample.arrival_ns, sample.packet.robot_ns
        self._waiting.prediction.add(sample.arrival_ns, sample.missed + 1, self._session.period.seconds)
        return _Turn(sample, self._guide.state(sample, self._wall_ns + sample.arrival_ns))

    def _call(self, turn: _Turn) -> None:
        """Ask the controller and answer; when the guard has answered meanwhile, the result is discarded."""
        controller, period_ns = self._controller, 1e9 * self._session.period.seconds
        command, failure = None, None
        self._turn, self._taken = turn, False
        start = time.monotonic_ns()
        self._deadline_ns = max(self._deadline(turn.sample), start + _GRACE * period_ns)
        self._calling = True
        try:
            command = controller(turn.state) if controller is not None else None
        except BaseException as error:  # also SystemExit: the arm must not go on at its last speed
            if isinstance(error, KeyboardInterrupt) and self.interrupted:
                raise  # the second Ctrl-C
            failure = ControllerFailed(f"The controller raised {type(error).__name__}: {error}. The arm was stopped.")
            failure.__cause__ = error
        finally:
            call_ns = time.monotonic_ns() - start
            with self._lock:
                self._calling = False
        with self._lock:
            if failure is not None:
                self._guide.stop("the controller failed", failure)
            if not self._taken:
                newest = self._take(self._port.receive(), turn) or turn
                self._command = command if newest.sample.session == turn.sample.session else None
                reply = self._guide.answer(self._command, self._session.period.seconds)
                self._reply(newest, self._command, reply, call_ns=call_ns)
            self._judge(call_ns, period_ns)

    def _deadline(self, sample: Sample) -> float:
        """Return when the reply is late, on our monotonic clock [ns]."""
        return sample.arrival_ns + _DEADLINE * 1e9 * self._session.period.seconds

    def _rehearse(self) -> None:
        if self._rehearsal is not None and self._arrival is not None:
            self._rehearsal(self._arrival, self._command)
            self._arrival = None

    def _judge(self, call_ns: int, period_ns: float) -> None:
        """Stop when the controller, not the computer, makes too many cycles late."""
        if self._in_lockstep:
            return
        blamed = self._taken or (self._was_late and call_ns > _BLAME * period_ns)
        too_late = self._lateness.add(time.monotonic_ns(), blamed, call_ns)
        if too_late:
            sentence = f"The controller was too slow: {too_late}. The arm was stopped. Give work to another thread."
            self._guide.stop("the controller was late", ControllerLate(sentence))

    def _reply(
        self, turn: _Turn, command: Command | None, reply: Reply | None, *, call_ns: int = 0, late: bool = False
    ) -> None:
        """Send the one reply to a packet, then record it and those it has overtaken."""
        sample, session = turn.sample, self._session
        seq = send_ns = -1
        if reply is not None and session.source is not None:
            packet = sample.packet
            tm_ms = 0 if packet.tm_ms is None else packet.tm_ms
            reference = Reference(reply.q, reply.qd, None, session.seq, tm_ms, packet.seqno, packet.robot_mono_ns)
            data = self._codec.encode(reference)
            now = time.monotonic_ns()
            if self._port.send(data, session.source):
                seq, send_ns = session.seq, now
                session.replied(now)
                self.replies += 1
                self.latency.add(now - sample.arrival_ns)
                late = late or (not self._in_lockstep and now > self._deadline(sample))
        self._was_late = late
        self.late += late
        for older in self._surpassed:
            self.overtaken += 1
            self._record(older, None, None, -1, -1, 0, late=False)
        self._surpassed.clear()
        self._record(turn, command, reply if send_ns >= 0 else None, seq, send_ns, call_ns, late)

    def _record(
        self,
        turn: _Turn,
        command: Command | None,
        reply: Reply | None,
        seq: int,
        send_ns: int,
        call_ns: int,
        late: bool,
    ) -> None:
        sample, wall_ns = turn.sample, self._wall_ns
        stamp_ns = (
            sample.packet.robot_ns if self._in_lockstep and sample.packet.robot_ns else wall_ns + sample.arrival_ns
        )
        tick = Tick(
            number=self._ticks,
            seq_sent=seq,
            stamp_ns=stamp_ns,
            receive_ns=wall_ns + sample.arrival_ns,
            send_ns=send_ns if send_ns < 0 else wall_ns + send_ns,
            step_ns=call_ns,
            late=late,
            drops=self._session.total_drops,
            q_sent=None if reply is None else reply.q,
            qd_sent=None if reply is None else reply.qd,
            clamped=None if reply is None else reply.clamped,
        )
        self._ticks += 1
        self._recording.row(turn.state, command, tick)

    def _after(self) -> None:
        """After a reply: ends, progress, garbage."""
        guide, settings = self._guide, self._settings
        self._stop_if_interrupted()
        if settings.seconds is not None and guide.elapsed >= settings.seconds:
            guide.stop("the time is up")
        if settings.progress is not None and guide.elapsed >= self._next_progress:
            self._next_progress = guide.elapsed + _PROGRESS
            try:
                settings.progress(guide.elapsed)
            except Exception as error:
                failure = ControllerFailed(f"`progress` raised {type(error).__name__}: {error}. The arm was stopped.")
                failure.__cause__ = error
                guide.stop("the display of progress failed", failure)
        next_ns = self._waiting.prediction.next_ns
        if self._in_lockstep or next_ns is None or next_ns - time.monotonic_ns() > _SPARE:
            collect_if_due()

    def _stop_if_interrupted(self) -> None:
        if self.interrupted:
            self._guide.stop("interrupted")
