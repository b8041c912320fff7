"""`connect` and `Link`: the entry to the bridge."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np

from armlab._descriptors import Descriptor
from armlab.bridge.control.arm import ArmSession, End
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.loop import Controller, Loop
from armlab.bridge.control.realtime import (
    LOOP_PRIORITY,
    Guard,
    Wait,
    Waiting,
    interrupts,
    priority,
    quiet_memory,
    short_switches,
)
from armlab.bridge.control.recording import Feed
from armlab.bridge.control.run import Run, assemble, checked_limits, finished, together
from armlab.bridge.control.supervision import Settings
from armlab.bridge.control.torque import TorqueModel, admittances
from armlab.bridge.inputs.sources import Source
from armlab.bridge.net.events import Tell
from armlab.bridge.net.sockets import Port
from armlab.bridge.servers.supervisor import Offering, stoppable
from armlab.bridge.urls import addresses, simulator_options
from armlab.errors import ConfigError, LinkError, RobotError, UnknownName
from armlab.log import Column
from armlab.robots import Robot
from armlab.wire.egm import Codec, EgmCodec

GROUP = "armlab.bridge.codecs"
"""Group of entry points; each is a function from a Robot to its `wire.egm.Codec`."""

_METHODS = ("capabilities", "reset", "decode", "encode")


def codec_named(name: str, robot: Robot, extension: bool = False) -> Codec:
    if name == "egm":
        return EgmCodec(robot, extension)
    from importlib.metadata import entry_points

    brought = entry_points(group=GROUP)
    if name not in brought.names:
        raise UnknownName.among("codec", name, ["egm", *sorted(brought.names)])
    point = brought[name]
    try:
        codec = point.load()(robot)
    except Exception as error:
        raise ConfigError(
            f"Expected the entry point {point.value} of {GROUP} to make a codec for {robot.name}, but it raised "
            f"{type(error).__name__}: {error}."
        ) from error
    missing = [method for method in _METHODS if not hasattr(codec, method)]
    if missing:
        raise ConfigError(
            f"Expected the entry point {point.value} of {GROUP} to make a codec, got {type(codec).__name__} without "
            f"{', '.join(missing)}. See wire.egm.Codec."
        )
    return codec


def codecs_of(codec: str | Codec | Sequence[Codec], robots: Sequence[Robot], extension: bool) -> list[Codec]:
    """Return the codec of each arm: made by name, or the user's objects."""
    if isinstance(codec, str):
        return [codec_named(codec, robot, extension) for robot in robots]
    given = list(codec) if isinstance(codec, Sequence) else [codec]
    for one in given:
        if not all(hasattr(one, method) for method in _METHODS):
            raise ConfigError(f"Expected the name of a codec, or one like wire.egm.Codec, got {one!r}.")
    if len(given) != len(robots):
        raise ConfigError(f"Expected one codec per arm, since each follows one session, got {len(given)}.")
    return given


_KEPT_LINES = 20
_PATIENCE = 5.0  # s to end by itself before it is killed


class Simulator:
    """One ``python -m armlab sim`` process that sends to ports of this computer.

    It gets its own process group, so that Ctrl-C reaches the bridge alone, which brings the arm to rest first.
    """

    def __init__(self, robots: Sequence[str], ports: Sequence[int], options: Mapping[str, str]) -> None:
        to = ",".join(f"127.0.0.1:{port}" for port in ports)
        arguments = [sys.executable, "-m", "armlab", "sim", *robots, "--to", to, "--extension"]
        for name, value in options.items():
            if value.lower() != "false":
                arguments += [f"--{name}"] if value.lower() in ("", "true") else [f"--{name}", value]
        self._command = " ".join(["armlab", *arguments[3:]])
        arguments += ["--parent", str(os.getpid())]  # told, not found: this process may end before the other looks
        self.lines: deque[str] = deque(maxlen=_KEPT_LINES)
        number, errors = os.pipe()
        self._errors = Descriptor(number)
        self._process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
        )
        os.close(errors)
        self._reader = threading.Thread(target=self._read, name="simulator messages", daemon=True)
        self._reader.start()

    def gone(self) -> str:
        """Return why it has ended, "" while it runs."""
        status = self._process.poll()
        if status is None:
            return ""
        self._reader.join(_PATIENCE)
        if status == 0:
            return "the simulated robot ended"
        said = " ".join(line for line in self.lines if line) or "nothing"
        raise LinkError(f"Expected `{self._command}` to go on, but it ended with status {status}. It said: {said}")

    def stop(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._reader.join(_PATIENCE)
        self._errors.close()

    def _read(self) -> None:
        with suppress(OSError), os.fdopen(self._errors.number, errors="replace", closefd=False) as file:
            for line in file:
                self.lines.append(line.strip())


def connect(
    url: str | Sequence[str],
    robot: Robot | Sequence[Robot],
    codec: str | Codec | Sequence[Codec] = "egm",
    extension: bool = False,
    answer_stream: bool = True,
    clock: Literal["wall", "robot"] = "wall",
    patience: float = 30.0,
    offer: str = "",
) -> Link:
    """Return a link to a robot, or to several arms; use it as a context manager.

    Parameters
    ----------
    url : ``egm://127.0.0.1:6510`` listens there for a robot's controller. ``sim://yumi_right`` starts that simulated
        robot and stops it with the link; ``?seed=1&lockstep=true`` are options of ``armlab sim``. Several arms have one
        url each, of which only the seeds may differ, or ``sim://yumi_left+yumi_right``; ``sim://mine.toml`` simulates
        what a file describes. Without a number the port is 6510, of several 6511, 6512, ... ``labcomm://host:7511``
        goes to a LabComm server whose bridge has the robot; ``?order=chain&dialect=2014`` say how its port is set.
        ``zenoh://host:7447/lab`` goes to a bridge that serves Zenoh, or to a router that knows it;
        ``?ca=lab.pem&secret=commander.secret`` are its certificate and our password.
    robot : the arm, or several in the order of the urls.
    codec : "egm", the name of an entry point of the group ``armlab.bridge.codecs``, or an object with the methods of
        `wire.egm.Codec`; one per arm.
    extension : send the research extension; always with a simulated robot. What arrives of it is always used.
    answer_stream : answer also before guidance begins.
    clock : "robot" for a robot in lockstep: no deadline then. Implied by ``lockstep=true``.
    patience : seconds to wait for a packet before `NoRobot` or `SessionEnded` is raised.
    offer : name of the cell under which ``armlab view --live`` and ``armlab monitor`` find the runs of this link, and
        ``armlab bridge stop`` makes its arms hold. Nobody does when left out.

    Raises
    ------
    ConfigError, UnknownName : wrong url, codec or clock.
    RobotError : no robot, or one whose axes EGM does not give.
    LinkError : a port cannot be bound, or a bridge of that name runs.
    """
    robots = _robots(robot)
    where = addresses([url] if isinstance(url, str) else list(url), len(robots))
    if clock not in ("wall", "robot"):
        raise ConfigError(f'Expected clock to be "wall" or "robot", got {clock!r}.')
    if not patience > 0.0:
        raise ConfigError(f"Expected patience above 0 s, got {patience}.")
    is_simulated = where[0].scheme == "sim"
    codecs = codecs_of(codec, robots, extension or is_simulated)
    in_lockstep = is_simulated and where[0].options.get("lockstep", "false").lower() in ("", "true")
    settings = Settings(clock="robot" if in_lockstep else clock, patience=patience)
    with ExitStack() as opened:
        ends: list[End] = []
        for one, address, wire in zip(robots, where, codecs, strict=True):
            if address.scheme in ("labcomm", "zenoh"):
                if address.scheme == "labcomm":
                    from armlab.bridge.servers.labcomm.client import far_end
                else:
                    from armlab.bridge.servers.zenoh.feed import far_end

                ends.append(End(one, *far_end(one, address.host, address.port, address.options)))
            else:
                ends.append(End(one, Port(address.host, address.port), wire))
            opened.callback(ends[-1].port.close)
        simulator = None
        if is_simulated:
            simulator = Simulator(
                [one.robot for one in where], [end.port.port for end in ends], simulator_options(where)
            )
            opened.callback(simulator.stop)
            settings = replace(settings, alive=simulator.gone)
        offering = Offering(robots, offer) if offer else None
        opened.pop_all()
    return Link(ends, answer_stream, settings, simulator, offering)


def _robots(robot: Any) -> list[Robot]:
    found: list[Any] = list(robot) if isinstance(robot, (list, tuple)) else [robot]
    for one in found:
        if not isinstance(one, Robot):
            raise RobotError.no_robot(one)
    names = [one.name for one in found]
    if len(set(names)) < len(names):
        raise ConfigError(f"Expected arms with different names in one link, got {', '.join(names)}.")
    return found


class Link:
    """A bound port for each arm. Made by `connect`; several runs after one another are allowed.

    Attributes
    ----------
    robots : the arms.
    robot : the first.
    host, port : the address bound for the first.
    ports : of each arm.
    last : what the last run left behind, also one that raised; None before the first.
    """

    def __init__(
        self,
        ends: Sequence[End],
        answer_stream: bool,
        settings: Settings,
        simulator: Simulator | None = None,
        offering: Offering | None = None,
    ) -> None:
        self.robots, self.ports = tuple(end.robot for end in ends), tuple(end.port.port for end in ends)
        self.robot, self.host, self.port = ends[0].robot, ends[0].port.host, ends[0].port.port
        self._ends, self._answer_stream = tuple(ends), answer_stream
        self._settings, self._simulator, self._offering = settings, simulator, offering
        self.last: Run | None = None
        self._closed = False

    def __enter__(self) -> Link:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the ports and stop the simulated robots."""
        self._closed = True
        for end in self._ends:
            end.port.close()
        if self._simulator is not None:
            self._simulator.stop()
        if self._offering is not None:
            self._offering.close()

    def run(
        self,
        controller: Controller | None,
        seconds: float | None = None,
        wait: Wait = "ahead",
        limits: Limits | Sequence[Limits] | None = None,
        reconnect: Literal["resume", "stop"] = "resume",
        torque: Literal["refuse", "admittance"] = "refuse",
        record: str | Path | None = None,
        extra: Mapping[str, Column] | None = None,
        progress: Callable[[float, float, str], None] | None = None,
        pace: str | None = None,
        feeds: Sequence[Feed] = (),
        sources: Sequence[Source] = (),
        damping: np.ndarray | None = None,
        torque_model: TorqueModel | Sequence[TorqueModel] | None = None,
        attachments: Mapping[str, bytes] | None = None,
    ) -> Run:
        """Run a controller against the robot: one call and one reply per packet.

        The arm holds until the first command within `Limits.entry` of where it is. The run ends after `seconds`, when
        the controller returns ``Command.stop()``, raises or is late too often, on Ctrl-C, when the robot is gone, or
        when ten sessions in a row end before 0.1 s under guidance; the arm is brought to rest first. Ctrl-C
        raises KeyboardInterrupt once the arm rests and the log is closed; a second one raises at once, and the last
        speed then acts until the time-out of the robot's controller. A call of the controller that lasts longer
        than 1 s is broken off by Ctrl-C, and the arm is brought to rest as otherwise.

        With several arms the controller is called on the packets of the arm that paces, with the State of all, while
        all are ready; each other arm is answered in its own tick with the newest command it was given. When one is
        not ready, ends its session or falls silent, all hold.

        Parameters
        ----------
        controller : callable State -> Command or None (hold). None only listens and never sends. With several arms the
            Command has the joints of all, or there is one per arm in a tuple.
        seconds : robot time under guidance, counted from the first readiness (from the first packet when listening).
        wait : "ahead" polls just before the packet, "block" sleeps, "spin" polls always.
        limits : on what is sent, one per arm; `Limits.of(robot)` by default.
        reconnect : "resume" waits for the next session when the controller ends one, "stop" ends the run.
        torque : what becomes of a torque command on a codec without the capability "torque": "refuse" ends the run with
            `CommandRefused`, "admittance" moves at ``qd = (tau - torque_model(q, qd)) / damping``.
        record : file for the recording; without it the rows stay in memory. Several arms have a file each, see
            `recording.paths`.
        extra : columns of ``Command.record`` by name.
        progress : called ten times a second of robot time with (done, total, what): seconds under guidance, and of all.
        pace : name of the arm that paces, the first by default.
        feeds : told every row and event after the reply was sent; see `recording.Feed`.
        sources : fused with each packet into `State.sources` and recorded; started and closed with the run.
        damping : (n,) of each joint [N m s/rad], for the admittance; it has no default.
        torque_model : (q, qd) -> (n,) torque of a free motion, one per arm; without it the command is what goes beyond.
        attachments : name -> bytes kept in the recordings, such as models and settings; descriptions of the arms are.

        Returns
        -------
        Run with the table, the report and the reason.

        Raises
        ------
        ConfigError : wrong options, limits for another number of joints, or a robot in lockstep that gets no answers.
        UnknownName : `pace` is no arm of this link.
        NoRobot, SessionEnded, CommandRefused, ControllerLate, ControllerFailed : with the last ten seconds in `.table`.
        """
        self._check(controller, seconds, wait, reconnect)
        names = [robot.name for robot in self.robots]
        if pace is not None and pace not in names:
            raise UnknownName.among("arm of this link", pace, names)
        paced = 0 if pace is None else names.index(pace)
        what = "listening" if controller is None else "moving"
        if self._offering is not None:
            exchange, feeds = self._offering.exchange, (*feeds, self._offering.exchange)
            controller = None if controller is None else stoppable(controller, exchange.arbiter)
        tell = None if progress is None else lambda done: progress(done, seconds or done, what)
        settings = replace(self._settings, seconds=seconds, resume=reconnect == "resume", progress=tell)
        softness = admittances(torque, damping, torque_model, self.robots)
        asked: list[bool] = []  # to stop, before there is a loop that can: recordings that were begun are finished
        with interrupts(lambda: asked.append(True)):
            arms = assemble(
                [end._replace(admittance=one) for end, one in zip(self._ends, softness, strict=True)],
                checked_limits(limits, self.robots, controller is not None),
                settings,
                commands=controller is not None,
                answer_stream=self._answer_stream,
                record=record,
                extra=extra,
                attachments=attachments or {},
                feeds=feeds,
                sources=sources,
            )
            mode: Wait = "block" if settings.clock == "robot" else wait
            waiting = Waiting([arm.port for arm in arms], [arm.prediction for arm in arms], mode)
            loop = Loop(arms, waiting, controller, settings, paced)
        arms.insert(0, arms.pop(paced))
        try:
            with ExitStack() as stack:
                stack.enter_context(interrupts(loop.interrupt))
                if asked:
                    loop.interrupt()
                for source in sources:
                    stack.callback(source.close)
                    source.start()
                stack.enter_context(quiet_memory())
                if settings.clock != "robot":
                    for arm in arms if controller is not None else ():  # a listener keeps what has come meanwhile
                        arm.port.flush()
                    _enter_real_time(stack, loop, arms[0].recording.event, wait)
                loop.run()
        finally:
            self.last = run = finished(arms, loop.reason or "interrupted", feeds)
        if loop.failure is not None:
            raise _with_tail(loop.failure, arms)
        if loop.interrupted:
            raise KeyboardInterrupt
        return run

    def _check(self, controller: Controller | None, seconds: Any, wait: str, reconnect: str) -> None:
        if self._closed:
            raise LinkError("Expected an open link, got one that was closed. Connect again.")
        if controller is not None and not callable(controller):
            raise ConfigError(f"Expected a controller to call with each State, or None to listen, got {controller!r}.")
        if seconds is not None and not (isinstance(seconds, int | float) and seconds >= 0.0):  # NaN would never end
            raise ConfigError(f"Expected seconds of at least 0, or None for no end, got {seconds!r}.")
        for name, value, known in (
            ("wait", wait, ("ahead", "block", "spin")),
            ("reconnect", reconnect, ("resume", "stop")),
        ):
            if value not in known:
                raise ConfigError(f"Expected {name} to be one of {', '.join(known)}, got {value!r}.")
        for end in self._ends:
            if controller is not None and "position" not in end.codec.capabilities:
                raise ConfigError(
                    f"Expected a codec that can send positions to {end.robot.name}, but this one cannot. "
                    "Listen only: pass None as the controller."
                )
        if self._settings.clock == "robot" and (controller is None or not self._answer_stream):
            what = "controller=None" if controller is None else "answer_stream=False"
            raise ConfigError(
                f"Expected every packet to be answered, since a robot in lockstep waits for each reply, got {what}. "
                'Leave out lockstep=true and clock="robot", or answer.'
            )


def _with_tail(failure: LinkError, arms: Sequence[ArmSession]) -> LinkError:
    """Return the error with the last ten seconds of all arms, where there is memory for them."""
    with suppress(MemoryError):  # the reason is told in any case
        tails = {arm.robot.name: arm.recording.tail() for arm in arms}
        failure.table = together(tails) if len(tails) > 1 else tails[arms[0].robot.name]
    return failure


def _enter_real_time(stack: ExitStack, loop: Loop, on_event: Tell, wait: Wait) -> None:
    """Enter short switches, guard and priority. A loop that always polls keeps normal priority: it never yields."""
    stack.enter_context(short_switches())
    stack.enter_context(Guard(loop.overdue, loop.answer_for_controller))
    if wait != "spin":
        stack.enter_context(priority(LOOP_PRIORITY, on_event))
