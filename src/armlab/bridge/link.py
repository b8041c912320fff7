"""`connect` and `Link`: the entry to the bridge."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Literal
from urllib.parse import parse_qsl, urlsplit

from armlab.bridge.conditions import LOOP_PRIORITY, priority, quiet_memory, short_switches
from armlab.bridge.events import Tell
from armlab.bridge.limits import Limits
from armlab.bridge.loop import Controller, Loop
from armlab.bridge.port import Port
from armlab.bridge.recording import Recording
from armlab.bridge.rehearsal import Rehearsal
from armlab.bridge.run import Run
from armlab.bridge.session import Session
from armlab.bridge.simulator import Simulator
from armlab.bridge.states import Guide
from armlab.bridge.supervision import Settings
from armlab.bridge.waiting import Wait, Waiting
from armlab.bridge.watchdog import Guard
from armlab.errors import ConfigError, RobotError, UnknownName
from armlab.log import Column
from armlab.robots import Robot
from armlab.wire.egm import Codec, EgmCodec

__all__ = ["Link", "connect"]

_PORT = 6510
_SILENCE = 0.5  # s that end a session
_CLAMPS = ("position", "velocity", "acceleration", "braking")


def connect(
    url: str,
    robot: Robot,
    codec: str | Codec = "egm",
    extension: bool = False,
    answer_stream: bool = True,
    clock: Literal["wall", "robot"] = "wall",
    patience: float = 30.0,
) -> Link:
    """Return a link to a robot; use it as a context manager.

    Parameters
    ----------
    url : ``egm://127.0.0.1:6510`` listens there for a robot's controller. ``sim://yumi_right`` starts that simulated
        robot and stops it with the link; ``?seed=1&lockstep=true`` are options of ``armlab sim``.
    robot : the arm.
    codec : "egm", or an object with the methods of `wire.egm.Codec`.
    extension : send the research extension; always with a simulated robot. What arrives of it is always used.
    answer_stream : answer also before guidance begins.
    clock : "robot" for a robot in lockstep: no deadline then. Implied by ``lockstep=true``.
    patience : seconds to wait for a packet before `NoRobot` or `SessionEnded` is raised.

    Raises
    ------
    ConfigError, UnknownName : wrong url, codec or clock. RobotError : no robot, or one whose axes EGM does not give.
    LinkError : the port cannot be bound.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("egm", "sim") or not parts.netloc:
        raise ConfigError(f"Expected a link like egm://127.0.0.1:6510 or sim://yumi_right, got {url!r}.")
    if clock not in ("wall", "robot"):
        raise ConfigError(f'Expected clock to be "wall" or "robot", got {clock!r}.')
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    is_simulated = parts.scheme == "sim"
    if options and not is_simulated:
        raise ConfigError(f"Expected no options in an egm link, got {', '.join(options)} in {url!r}.")
    wires = _codecs(codec, robot, extension or is_simulated)
    if is_simulated:
        in_lockstep = options.get("lockstep", "false").lower() in ("", "true")
        settings = Settings(clock="robot" if in_lockstep else clock, patience=patience)
        port = Port("127.0.0.1", 0)
        try:
            simulator = Simulator(parts.netloc, port.port, options)
        except BaseException:
            port.close()
            raise
        return Link(port, robot, wires, answer_stream, replace(settings, alive=simulator.gone), simulator)
    host, number = _address(url, parts.hostname, parts.netloc)
    return Link(Port(host, number), robot, wires, answer_stream, Settings(clock=clock, patience=patience))


def _codecs(codec: str | Codec, robot: Robot, extension: bool) -> tuple[Codec, Codec | None]:
    """Return the codec and one more for rehearsals, which an object of the user's does not have."""
    if not isinstance(codec, str):
        return codec, None
    if codec != "egm":
        raise UnknownName.among("codec", codec, ["egm"])
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    return EgmCodec(robot, extension), EgmCodec(robot, extension)


def _address(url: str, host: str | None, netloc: str) -> tuple[str, int]:
    number = netloc.rpartition(":")[2] if ":" in netloc else str(_PORT)
    if not host or not number.isascii() or not number.isdigit() or int(number) > 65535:
        raise ConfigError(f"Expected egm://HOST:PORT with a port from 0 to 65535, got {url!r}.")
    return host, int(number)


class Link:
    """A bound port for one arm. Made by `connect`; several runs after one another are allowed.

    Attributes
    ----------
    robot : the arm. host, port : the address bound.
    """

    def __init__(
        self,
        port: Port,
        robot: Robot,
        codecs: tuple[Codec, Codec | None],
        answer_stream: bool,
        settings: Settings,
        simulator: Simulator | None = None,
    ) -> None:
        self.robot, self.host, self.port = robot, port.host, port.port
        self._port, self._answer_stream = port, answer_stream
        self._codec, self._spare = codecs
        self._settings, self._simulator = settings, simulator

    def __enter__(self) -> Link:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the port and stop the simulated robot."""
        self._port.close()
        if self._simulator is not None:
            self._simulator.stop()

    def run(
        self,
        controller: Controller | None,
        seconds: float | None = None,
        wait: Wait = "ahead",
        limits: Limits | None = None,
        reconnect: Literal["resume", "stop"] = "resume",
        torque: Literal["refuse"] = "refuse",
        record: str | Path | None = None,
        extra: Mapping[str, Column] | None = None,
        progress: Callable[[float, float, str], None] | None = None,
    ) -> Run:
        """Run a controller against the robot: one call and one reply per packet.

        The arm holds until the first command within `Limits.entry` of where it is. The run ends after `seconds`, when
        the controller returns ``Command.stop()``, raises or is late too often, on Ctrl-C, or when the robot is gone;
        the arm is brought to rest first. Ctrl-C raises KeyboardInterrupt once the arm rests and the log is closed; a
        second one raises at once, and the last speed then acts until the time-out of the robot's controller.

        Parameters
        ----------
        controller : callable State -> Command or None (hold). None only listens and never sends.
        seconds : robot time under guidance, counted from the first readiness (from the first packet when listening).
        wait : "ahead" polls just before the packet, "block" sleeps, "spin" polls always.
        limits : on what is sent; `Limits.of(robot)` by default.
        reconnect : "resume" waits for the next session when the controller ends one, "stop" ends the run.
        torque : torque commands are refused by this link.
        record : file for the recording; without it the rows stay in memory.
        extra : columns of ``Command.record`` by name.
        progress : called ten times a second of robot time with (done, total, what): seconds under guidance, and of all.

        Returns
        -------
        Run with the table, the report and the reason.

        Raises
        ------
        ConfigError : wrong options, limits for another number of joints, or a robot in lockstep that gets no answers.
        NoRobot, SessionEnded, CommandRefused, ControllerLate, ControllerFailed : with the last ten seconds in `.table`.
        """
        self._check(controller, wait, reconnect, torque, limits)
        in_lockstep = self._settings.clock == "robot"
        tell = None if progress is None else lambda done: progress(done, seconds or done, "moving")
        settings = replace(self._settings, seconds=seconds, resume=reconnect == "resume", progress=tell)
        recording = Recording(self.robot, record, extra, wait=in_lockstep, clock=lambda: loop.stamp_ns)
        limits = limits or Limits.of(self.robot)
        guide = Guide(
            self.robot,
            limits,
            commands=controller is not None,
            capabilities=self._codec.capabilities,
            answer_stream=self._answer_stream,
            on_event=recording.event,
        )
        session = Session(self._codec, float("inf") if in_lockstep else _SILENCE, recording.event)
        waiting = Waiting(self._port, "block" if in_lockstep else wait)
        rehearsal = None if self._spare is None else Rehearsal(self.robot, limits, self._spare)
        loop = Loop(self._port, self._codec, session, guide, waiting, recording, controller, settings, rehearsal)
        problems: list[str] = []
        statistics: dict[str, Any] = {}
        try:
            with ExitStack() as stack:
                stack.enter_context(_interrupts(loop))
                stack.enter_context(quiet_memory())
                if not in_lockstep:
                    self._port.flush()
                    _enter_real_time(stack, loop, recording.event, wait)
                loop.run()
        finally:
            statistics = _statistics(self.robot, self._codec, self._port, session, guide, loop)
            problems = recording.close(statistics)
        if guide.failure is not None:
            guide.failure.table = recording.tail()
            raise guide.failure
        if loop.interrupted:
            raise KeyboardInterrupt
        return Run(
            guide.reason, {**statistics, "problems": problems}, tuple(recording.events), recording.path, recording
        )

    def _check(
        self, controller: Controller | None, wait: str, reconnect: str, torque: str, limits: Limits | None
    ) -> None:
        for name, value, known in (
            ("wait", wait, ("ahead", "block", "spin")),
            ("reconnect", reconnect, ("resume", "stop")),
            ("torque", torque, ("refuse",)),
        ):
            if value not in known:
                raise ConfigError(f"Expected {name} to be one of {', '.join(known)}, got {value!r}.")
        if controller is not None and "position" not in self._codec.capabilities:
            raise ConfigError(
                f"Expected a codec that can send positions to {self.robot.name}, but this one cannot. "
                "Listen only: pass None as the controller."
            )
        if limits is not None and len(limits.q_min) != self.robot.n:
            raise ConfigError(
                f"Expected limits for the {self.robot.n} joints of {self.robot.name}, got {len(limits.q_min)}. "
                "Use Limits.of(robot)."
            )
        if self._settings.clock == "robot" and (controller is None or not self._answer_stream):
            what = "controller=None" if controller is None else "answer_stream=False"
            raise ConfigError(
                f"Expected every packet to be answered, since a robot in lockstep waits for each reply, got {what}. "
                'Leave out lockstep=true and clock="robot", or answer.'
            )


def _enter_real_time(stack: ExitStack, loop: Loop, on_event: Tell, wait: Wait) -> None:
    """Enter short switches, guard and priority. A loop that always polls keeps normal priority: it never yields."""
    stack.enter_context(short_switches())
    stack.enter_context(Guard(loop.overdue, loop.answer_for_controller))
    if wait != "spin":
        stack.enter_context(priority(LOOP_PRIORITY, on_event))


@contextmanager
def _interrupts(loop: Loop) -> Iterator[None]:
    """Turn the first Ctrl-C or SIGTERM into a stop of the loop; a second raises at once. Only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        if loop.interrupted:
            raise KeyboardInterrupt
        loop.interrupted = True

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _statistics(robot: Robot, codec: Codec, port: Port, session: Session, guide: Guide, loop: Loop) -> dict[str, Any]:
    return {
        "robot": robot.name,
        "robotware": getattr(codec, "robotware", ""),
        "sessions": session.number,
        "period_s": session.period.seconds,
        "seconds": guide.elapsed,
        "packets": session.received,
        "replies": loop.replies,
        "overtaken": loop.overtaken,
        "missed": session.missed,
        "late": loop.late,
        "refused": guide.refused,
        "drops": dict(session.drops),
        "socket_errors": port.errors,
        "latency_us": loop.latency.summary(),
        "clamps": dict(zip(_CLAMPS, guide.clamps.tolist(), strict=True)),
        "worst_ratio": guide.worst_ratio,
        "reason": guide.reason,
    }
