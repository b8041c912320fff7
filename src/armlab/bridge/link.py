"""Connections to robots: `connect` returns a `Link`, which runs controllers."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from armlab._files import Descriptor
from armlab.bridge.control.arm import ArmSession, End
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.loop import Controller, DryRun, Loop
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
from armlab.bridge.control.torque import FreeTorque, admittances
from armlab.bridge.inputs.sources import Source
from armlab.bridge.net.events import Tell
from armlab.bridge.net.sockets import Port
from armlab.bridge.servers.supervisor import Offering, stoppable
from armlab.bridge.urls import Address, addresses, simulator_options
from armlab.errors import ConfigError, LinkError, RobotError, UnknownName
from armlab.log import Column
from armlab.robots import Robot
from armlab.robots.comparison import check_same
from armlab.robots.files import load_chosen
from armlab.wire.egm import Codec, EgmCodec

if TYPE_CHECKING:
    from armlab.bridge.doctor.controller import RapidRun

GROUP = "armlab.bridge.codecs"
"""Entry point group of additional codecs; each entry point maps a Robot to its `wire.egm.Codec`."""

_MOVES = ("links", "prismatic", "coupling", "T_base_mount", "gravity")
_CALIBRATED = 0.02  # largest difference between entries [m, 1, m/s^2] attributable to calibration
_SCARA = "scara"  # provided by the simulator, not by the robot library

_METHODS = ("capabilities", "reset", "decode", "encode")


def codec_named(name: str, robot: Robot, extension: bool = False, simulated: bool = False) -> Codec:
    if name == "egm" and simulated:  # the simulator uses the same units for linear axes in both directions
        axes = zip(robot.prismatic, robot.abb_axes, strict=True)
        return EgmCodec(robot, extension, ["mm" if slides and axis > 6 else "deg" for slides, axis in axes])
    if name == "egm":
        return EgmCodec(robot, extension)
    from importlib.metadata import entry_points

    points = entry_points(group=GROUP)
    if name not in points.names:
        raise UnknownName.among("codec", name, ["egm", *sorted(points.names)])
    point = points[name]
    try:
        codec = point.load()(robot)
    except Exception as error:
        raise ConfigError(
            f"Expected the entry point {point.value} of {GROUP} to return a codec for {robot.name}, got "
            f"{type(error).__name__}: {error}. Correct the entry point."
        ) from error
    missing = [method for method in _METHODS if not hasattr(codec, method)]
    if missing:
        raise ConfigError(
            f"Expected the entry point {point.value} of {GROUP} to return a codec, got {type(codec).__name__} without "
            f"{', '.join(missing)}. See wire.egm.Codec."
        )
    return codec


def codecs_of(
    codec: str | Codec | Sequence[Codec], robots: Sequence[Robot], extension: bool, simulated: bool = False
) -> list[Codec]:
    """Return one codec per arm: a new codec if `codec` is a name, otherwise the given object."""
    if isinstance(codec, str):
        return [codec_named(codec, robot, extension, simulated) for robot in robots]
    given = list(codec) if isinstance(codec, Sequence) else [codec]
    for one in given:
        if not all(hasattr(one, method) for method in _METHODS):
            raise ConfigError(
                f"Expected the name of a codec, or an object with the methods of wire.egm.Codec, got {one!r}."
            )
    if len(given) != len(robots):
        raise ConfigError(f"Expected one codec per arm, because each codec tracks one session, got {len(given)}.")
    return given


_KEPT_LINES = 20
_PATIENCE = 5.0  # s allowed for the process to exit before it is killed


class Simulator:
    """``armlab sim`` process that sends to ports on this computer.

    The process runs in its own session, which shields it from Ctrl-C, so the bridge can bring the arm to rest first.
    """

    def __init__(self, robots: Sequence[str], ports: Sequence[int], options: Mapping[str, str]) -> None:
        to = ",".join(f"127.0.0.1:{port}" for port in ports)
        arguments = [sys.executable, "-m", "armlab", "sim", *robots, "--to", to, "--extension"]
        for name, value in options.items():
            if value.lower() != "false":
                arguments += [f"--{name}"] if value.lower() in ("", "true") else [f"--{name}", value]
        self._command = " ".join(["armlab", *arguments[3:]])
        arguments += [
            "--parent",
            str(os.getpid()),
        ]  # passed, because this process may end before the child can query its parent
        self.lines: deque[str] = deque(maxlen=_KEPT_LINES)
        number, errors = os.pipe()
        self._errors = Descriptor(number)
        self._process = subprocess.Popen(
            arguments, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True
        )
        os.close(errors)
        self._reader = threading.Thread(target=self._read, name="simulator messages", daemon=True)
        self._reader.start()

    def gone(self) -> str:
        """Return the reason why the process ended, or "" while it is running."""
        status = self._process.poll()
        if status is None:
            return ""
        self._reader.join(_PATIENCE)
        if status == 0:
            return "the simulated robot ended"
        output = " ".join(line for line in self.lines if line) or "nothing"
        raise LinkError(f"Expected `{self._command}` to keep running, got exit status {status}. Its output: {output}")

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
    url : str or sequence of str
        One URL per arm. ``egm://127.0.0.1:6510`` listens for a robot's controller; the default port is 6510, or 6511,
        6512, ... for several arms. ``sim://yumi_right`` starts a simulated robot and stops it with the link. The query
        string sets options of armlab sim, such as ``?seed=1&lockstep=true``; only seeds may differ between arms.
        ``sim://yumi_left+yumi_right`` starts two robots; ``sim://mine.toml`` starts the robot described in that file.
        ``labcomm://host:7511`` connects to a bridge through its LabComm server; ``?order=chain&dialect=2014`` sets the
        options of the port. ``zenoh://host:7447/lab`` connects to a bridge or router over Zenoh;
        ``?ca=lab.pem&secret=commander.secret`` sets the certificate and the client password.
        ``egm://127.0.0.1:6510?rws=192.168.125.1`` starts RAPID on that ABB controller at the start of each run with a
        Python controller, and stops RAPID at the end. ``&ca=FILE`` or ``&insecure=true`` sets how the certificate of
        the ABB controller is checked. The user and password are read from ``ARMLAB_RWS_USER`` and
        ``ARMLAB_RWS_PASSWORD``.
    robot : Robot or sequence of Robot
        The arms, in the order of the URLs.
    codec : str, Codec or sequence of Codec
        "egm", the name of an entry point in the group ``armlab.bridge.codecs``, or one object per arm with the methods
        of `wire.egm.Codec`.
    extension : bool
        Send the research extension; always on for a simulated robot. Received extensions are always decoded.
    answer_stream : bool
        Also reply before guidance begins.
    clock : str
        "wall", or "robot" for a robot in lockstep, without deadlines; ``lockstep=true`` implies "robot".
    patience : float, s
        Time to wait for a packet before `NoRobot` or `SessionEnded` is raised.
    offer : str
        Cell name under which ``armlab view --live``, ``armlab monitor`` and ``armlab bridge stop`` reach a run;
        default: these commands cannot reach the run.

    Raises
    ------
    ConfigError, UnknownName
        Invalid URL, codec or clock, or ``sim://`` with an arm that is not in the library.
    RobotError
        An arm is not a Robot, or EGM does not report its axes.
    ModelMismatchError
        The simulated arm differs from the robot.
    LinkError
        A port cannot be bound, or a bridge named `offer` is already running.
    MissingExtra
        ``rws=`` was given, but the extra ``abb`` is not installed.
    """
    robots = _robots(robot)
    where = addresses([url] if isinstance(url, str) else list(url), len(robots))
    if clock not in ("wall", "robot"):
        raise ConfigError(f'Expected clock to be "wall" or "robot", got {clock!r}.')
    if not patience > 0.0:
        raise ConfigError(f"Expected patience above 0 s, got {patience}.")
    is_simulated = where[0].scheme == "sim"
    if is_simulated:
        _check_simulated(robots, where)
    codecs = codecs_of(codec, robots, extension or is_simulated, is_simulated)
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
            ports = [end.port.port for end in ends]
            simulator = Simulator([one.robot for one in where], ports, simulator_options(where))
            opened.callback(simulator.stop)
            settings = replace(settings, alive=simulator.gone)
        rapid = None
        if where[0].scheme == "egm" and "rws" in where[0].options:
            from armlab.bridge.doctor.controller import RapidRun

            rapid = RapidRun(**where[0].options)
        offering = Offering(robots, offer) if offer else None
        opened.pop_all()
    return Link(ends, answer_stream, settings, simulator, offering, rapid)


def _robots(robot: Any) -> list[Robot]:
    found: list[Any] = list(robot) if isinstance(robot, (list, tuple)) else [robot]
    for one in found:
        if not isinstance(one, Robot):
            raise RobotError.no_robot(one)
    names = [one.name for one in found]
    if len(set(names)) < len(names):
        raise ConfigError(f"Expected arms with different names in one link, got {', '.join(names)}.")
    return found


def _check_simulated(robots: Sequence[Robot], where: Sequence[Address]) -> None:
    """Raise an error if a simulated arm is unknown or has different links or mount; tool and calibration may differ."""
    for robot, address in zip(robots, where, strict=True):
        if address.robot == _SCARA:
            continue
        with warnings.catch_warnings():  # loading the robot already issued these warnings
            warnings.simplefilter("ignore")
            simulated = load_chosen(address.robot, address.options)
        same = simulated.n == robot.n and all(
            np.allclose(getattr(simulated, name), getattr(robot, name), rtol=0.0, atol=_CALIBRATED) for name in _MOVES
        )
        if not same:
            advice = "Pass the simulated arm, or simulate this arm with sim://FILE."
            check_same(robot, f"the link sim://{address.robot}", simulated.name, simulated.hash, simulated, advice)


class Link:
    """Connection to one or more arms, made by `connect`, for one or more consecutive runs.

    Attributes
    ----------
    robots : tuple of Robot
        The arms.
    robot : Robot
        The first arm.
    host : str
        Bound address of the first arm.
    port : int
        Bound port of the first arm.
    ports : tuple of int
        Bound port of each arm.
    last : Run
        Result of the last run, even if it failed; None before the first run.
    """

    robots: tuple[Robot, ...]
    ports: tuple[int, ...]
    robot: Robot
    host: str
    port: int

    def __init__(
        self,
        ends: Sequence[End],
        answer_stream: bool,
        settings: Settings,
        simulator: Simulator | None = None,
        offering: Offering | None = None,
        rapid: RapidRun | None = None,
    ) -> None:
        self.robots, self.ports = tuple(end.robot for end in ends), tuple(end.port.port for end in ends)
        self.robot, self.host, self.port = ends[0].robot, ends[0].port.host, ends[0].port.port
        self._ends, self._answer_stream = tuple(ends), answer_stream
        self._settings, self._simulator, self._offering, self._rapid = settings, simulator, offering, rapid
        self.last: Run | None = None
        self._closed = False

    def __repr__(self) -> str:
        names = ", ".join(robot.name for robot in self.robots)
        return f"<Link to {names}, {self.host} port {', '.join(map(str, self.ports))}>"

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
        torque_model: FreeTorque | Sequence[FreeTorque] | None = None,
        attachments: Mapping[str, bytes] | None = None,
    ) -> Run:
        """Run a controller on the robot: one call and one reply per packet.

        The arm holds until the controller returns a command within `Limits.entry` of the arm position.

        The run ends

        - after `seconds`, or when the controller returns ``Command.stop()``;
        - when the controller raises an error or is late too often;
        - when the robot is lost, or ten consecutive sessions end with less than 0.1 s under guidance;
        - on Ctrl-C.

        The bridge brings the arm to rest before the run ends. Ctrl-C raises KeyboardInterrupt once the arm is at rest
        and the log is closed. A second Ctrl-C raises the exception immediately; the arm then keeps its last speed until
        the robot controller times out. If a controller call lasts longer than 1 s, Ctrl-C interrupts the call.

        With several arms, each packet of the pacing arm triggers a controller call with the State of all arms, provided
        that all arms are ready. The other arms receive their newest commands in their own ticks. All arms hold when any
        arm is not ready, ends its session or stops sending packets.

        Parameters
        ----------
        controller : callable
            Maps a State to a Command or None (hold). With several arms, the controller returns a Command for all
            joints, or a tuple with one Command per arm. If None, the run only listens and never sends.
        seconds : float, s
            Duration of the run: robot time under guidance or, without a controller, from the first packet.
        wait : str
            "ahead" polls just before each expected packet, "block" sleeps, and "spin" polls continuously and needs a
            free core.
        limits : Limits or sequence of Limits
            Limits of the references sent, one per arm; default: `Limits.of(robot)`.
        reconnect : str
            When the robot controller ends a session, "resume" waits for the next one, and "stop" ends the run.
        torque : str
            Handling of torque commands if the codec lacks the capability "torque": "refuse" ends the run with
            `CommandRefused`; "admittance" moves the arm at ``qd = (tau - torque_model(q, qd)) / damping``.
        record : path
            File of the recording; default: rows stay in memory. For the files of several arms, see `recording.paths`.
        extra : mapping
            Columns of ``Command.record`` by name.
        progress : callable
            Called ten times per second of robot time with (done, total, activity): elapsed and total time under
            guidance [s], and "moving" or "listening".
        pace : str
            Name of the pacing arm; default: the first arm.
        feeds : sequence of Feed
            Consumers that receive each row and event after the reply; see `recording.Feed`.
        sources : sequence of Source
            Sources that start and close with the run; fused with each packet into `State.sources`, and recorded.
        damping : array, shape (n,), N m s/rad
            Damping of each joint; required for torque="admittance".
        torque_model : callable, TorqueModel or its Fit, or a sequence of them
            Torque (n,) of free motion as a callable of (q, qd), one per arm; default: zero.
        attachments : mapping
            Bytes by name, such as models and settings, to store in the recordings in addition to the robot
            descriptions.

        Returns
        -------
        Run
            The table, the report, and the reason why the run ended.

        Raises
        ------
        ConfigError
            Invalid options, limits for a different number of joints, or a lockstep robot without replies.
        UnknownName
            `pace` is not an arm of this link.
        NoRobot, SessionEnded, CommandRefused, ControllerLate, ControllerFailed
            The attribute `table` of each of these errors contains the rows of the last ten seconds.
        """
        self._check(controller, seconds, wait, reconnect)
        names = [robot.name for robot in self.robots]
        if pace is not None and pace not in names:
            raise UnknownName.among("arm of this link", pace, names)
        paced = 0 if pace is None else names.index(pace)
        activity = "listening" if controller is None else "moving"
        if self._offering is not None:
            exchange, feeds = self._offering.exchange, (*feeds, self._offering.exchange)
            controller = None if controller is None else stoppable(controller, exchange.arbiter)
        report = None if progress is None else lambda done: progress(done, seconds or done, activity)
        settings = replace(self._settings, seconds=seconds, resume=reconnect == "resume", progress=report)
        given = checked_limits(limits, self.robots, controller is not None)
        softness = admittances(torque, damping, torque_model, self.robots)
        early: list[bool] = []  # interrupts before the loop exists; open recordings must still be closed
        with interrupts(lambda: early.append(True)):
            arms = assemble(
                [end._replace(admittance=one) for end, one in zip(self._ends, softness, strict=True)],
                given,
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
            end = self._ends[paced]
            dry_run = None
            if mode != "block" and controller is not None and isinstance(end.codec, EgmCodec):
                dry_run = DryRun(end, given[paced])
            waiting = Waiting([arm.port for arm in arms], [arm.prediction for arm in arms], mode, dry_run)
            loop = Loop(arms, waiting, controller, settings, paced)
        arms.insert(0, arms.pop(paced))
        try:
            with ExitStack() as stack:
                stack.enter_context(interrupts(loop.interrupt))
                if early:
                    loop.interrupt()
                if self._rapid is not None and controller is not None:
                    note, is_over = arms[0].recording.note, lambda: loop.interrupted
                    stack.enter_context(self._rapid.running(self.ports, note, is_over))
                for source in sources:
                    stack.callback(source.close)
                    source.start()
                stack.enter_context(quiet_memory())
                if settings.clock != "robot":
                    for arm in arms if controller is not None else ():  # a listener keeps earlier packets
                        arm.port.flush()
                    _enter_real_time(stack, loop, arms[0].recording.event, waiting)
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
            raise LinkError("Expected an open link, but this link is closed. Connect again.")
        if controller is not None and not callable(controller):
            raise ConfigError(f"Expected a callable controller, or None to listen, got {controller!r}.")
        if seconds is not None and not (isinstance(seconds, int | float) and seconds >= 0.0):  # NaN would never end
            raise ConfigError(f"Expected seconds of at least 0, or None to run without a time limit, got {seconds!r}.")
        for name, value, known in (
            ("wait", wait, ("ahead", "block", "spin")),
            ("reconnect", reconnect, ("resume", "stop")),
        ):
            if value not in known:
                raise ConfigError(f"Expected {name} to be one of {', '.join(known)}, got {value!r}.")
        for end in self._ends:
            if controller is not None and "position" not in end.codec.capabilities:
                raise ConfigError(
                    f"Expected a codec that can send positions to {end.robot.name}, got a codec without that "
                    "capability. To listen only, pass None as the controller."
                )
        if self._settings.clock == "robot" and (controller is None or not self._answer_stream):
            what = "controller=None" if controller is None else "answer_stream=False"
            raise ConfigError(
                f"Expected a reply to every packet, because a robot in lockstep waits for each reply, got {what}. "
                'Omit lockstep=true and clock="robot", or pass a controller and keep answer_stream=True.'
            )


def _with_tail(failure: LinkError, arms: Sequence[ArmSession]) -> LinkError:
    """Attach the last ten seconds of rows from all arms to the error, if memory allows."""
    with suppress(MemoryError):  # the error matters more than its table
        tails = {arm.robot.name: arm.recording.tail() for arm in arms}
        failure.table = together(tails) if len(tails) > 1 else tails[arms[0].robot.name]
    return failure


def _enter_real_time(stack: ExitStack, loop: Loop, on_event: Tell, waiting: Waiting) -> None:
    """Start the watchdog and raise the priority of this thread."""
    stack.enter_context(short_switches())
    stack.enter_context(Guard(loop.overdue, loop.answer_for_controller))
    waiting.is_permitted = stack.enter_context(priority(LOOP_PRIORITY, on_event))
