"""The arms of a run, put together from where each is heard: `End`, `assemble`; and `finished`, their runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armlab.bridge.control.arm import Arm
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.loop import Loop
from armlab.bridge.control.recording import Feed, Recording, paths
from armlab.bridge.control.run import Run, statistics
from armlab.bridge.control.session import Session
from armlab.bridge.control.state_machine import Guide
from armlab.bridge.control.supervision import Settings
from armlab.bridge.control.torque import Admittance
from armlab.bridge.inputs.fusion import Fusion
from armlab.bridge.inputs.parameters import Change
from armlab.bridge.inputs.sources import Source
from armlab.bridge.net.events import nobody
from armlab.bridge.net.sockets import Arrival, Port
from armlab.errors import ConfigError
from armlab.log import Column
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Codec

__all__ = ["End", "Rehearsal", "assemble", "checked_limits", "finished"]


class Rehearsal:
    """A second loop, one packet behind the real one, that nobody listens to.

    robot, limits, admittance : as in `Guide`. codec : one of its own, since it is reset with the sessions.
    """

    def __init__(
        self, robot: Robot, limits: Limits, codec: Codec, port: Port, admittance: Admittance | None = None
    ) -> None:
        softness = None if admittance is None else replace(admittance, model=None)  # the user's may remember its calls
        guide = Guide(robot, limits, capabilities=codec.capabilities, admittance=softness)
        session, settings = Session(codec, float("inf")), Settings(patience=float("inf"))
        nobody: Any = _Nobody()
        self._port, self._stage = port, _Stage()
        self._arm = Arm(robot, port, codec, session, guide, nobody, settings, 0, Fusion(()))
        self._loop = Loop([self._arm], self._stage, self._obey, settings)
        self._command: Command | None = None

    def __call__(self, arrival: Arrival, command: Command | None) -> None:
        """Do everything that the loop did with a packet."""
        self._stage.arrival, self._command = arrival, command
        self._loop.cycle()
        self._port.flush()

    def _obey(self, state: State) -> Command | None:
        return self._command


class _Stage:
    """In place of `Waiting`: the packet is there."""

    arrival: Arrival

    def next(self, seconds: float) -> tuple[int, Arrival]:
        return 0, self.arrival


class _Nobody:
    """In place of a `Recording`."""

    def keep(self, *_: Any) -> None:
        """Forget a row."""

    def pass_on(self, *_: Any) -> None:
        """Nobody gets it."""

    def event(self, *_: Any, **__: Any) -> None:
        """Forget a sentence."""

    def catch_up(self) -> None:
        """Nothing waits."""


_SILENCE = 0.5  # s that end a session


class End(NamedTuple):
    """Where one arm is heard, and how.

    spares, aside : codecs and a port that sends to itself for rehearsals, none where the codec is the user's.
    admittance : makes velocities of torque commands, None where torques are sent or refused.
    """

    robot: Robot
    port: Port
    codec: Codec
    spares: tuple[Codec, ...]
    aside: Port | None = None
    admittance: Admittance | None = None

    def close(self) -> None:
        """Close the ports."""
        self.port.close()
        if self.aside is not None:
            self.aside.close()


def checked_limits(
    limits: Limits | Sequence[Limits] | None, robots: Sequence[Robot], commands: bool = True
) -> list[Limits]:
    """Return the limits of each arm.

    limits : one per arm; None gives the robots' own. robots : the arms. commands : False when nothing is ever sent.

    Raises
    ------
    ConfigError : another number of limits, limits for another number of joints, or none on speed or acceleration.
    """
    given: list[Any] = [Limits.of(robot) for robot in robots]
    if limits is not None:
        given = list(limits) if isinstance(limits, list | tuple) else [limits]
    for one in given:
        if not isinstance(one, Limits):
            raise ConfigError(f"Expected Limits, or one per arm in a list, got {one!r}. Use Limits.of(robot).")
    if len(given) != len(robots):
        names = ", ".join(robot.name for robot in robots)
        raise ConfigError(f"Expected Limits for each of {names}, got {len(given)}. Use Limits.of(robot) for each.")
    for one, robot in zip(given, robots, strict=True):
        if len(one.q_min) != robot.n:
            raise ConfigError(
                f"Expected limits for the {robot.n} joints of {robot.name}, got {len(one.q_min)}. Use Limits.of(robot)."
            )
        if commands and not np.isfinite([one.qd_max, one.qdd_max, one.jump]).all():
            raise ConfigError(
                f"Expected limits on speed and acceleration of each joint of {robot.name}, got qd_max = {one.qd_max} "
                f"and qdd_max = {one.qdd_max}: any jump would pass. Write them in the robot's file, or give `limits`."
            )
    return given


def assemble(
    ends: Sequence[End],
    limits: Sequence[Limits],
    settings: Settings,
    *,
    commands: bool,
    answer_stream: bool,
    record: str | Path | None,
    extra: Mapping[str, Column] | None,
    attachments: Mapping[str, bytes],
    feeds: Sequence[Feed],
    sources: Sequence[Source],
) -> list[Arm]:
    """Return the arms of one run, on one clock.

    ends : where they are heard. limits : of each. settings : of the run. commands : False when nothing is ever sent.
    """
    wall_ns = time.time_ns() - time.monotonic_ns()
    told = list(feeds)  # one list: a feed that fails is dropped for all arms
    columns = {**Fusion(sources).columns, **_columns(extra)}
    for source in sources:
        source.check([end.robot for end in ends])
    files = paths(record, [end.robot for end in ends])
    arms: list[Arm] = []
    try:
        for end, one, file in zip(ends, limits, files, strict=True):
            recording = Recording(
                end.robot,
                file,
                columns,
                attachments=attachments,
                wait=settings.clock == "robot",
                clock=_clock(arms, len(arms)),
                feeds=told,
                label=end.robot.name if len(ends) > 1 else "",
            )
            fusion = Fusion(sources, recording.event if not arms else nobody)
            arms.append(_arm(end, one, settings, wall_ns, recording, fusion, commands, answer_stream))
    except BaseException:
        for arm in arms:
            arm.recording.close({})
        raise
    for feed in feeds:
        begin = getattr(feed, "begin", None)
        if begin is not None:
            files = [arm.recording.path for arm in arms if arm.recording.path is not None]
            begin(arms[0].recording.note, files, lambda change: _keep(arms, change))
    return arms


def _columns(extra: Mapping[str, Column] | None) -> Mapping[str, Column]:
    for name, column in (extra or {}).items():
        if not isinstance(column, Column):
            raise ConfigError(f"Expected `extra` to name columns, as extra={{'{name}': Column('N')}}, got {column!r}.")
    return extra or {}


def _keep(arms: Sequence[Arm], change: Change) -> None:
    for arm in arms:
        arm.recording.parameter(change)


def _clock(arms: Sequence[Arm], index: int) -> Callable[[], int]:
    return lambda: arms[index].stamp_ns


def _arm(
    end: End,
    limits: Limits,
    settings: Settings,
    wall_ns: int,
    recording: Recording,
    fusion: Fusion,
    commands: bool,
    answer_stream: bool,
) -> Arm:
    robot = end.robot
    guide = Guide(
        robot,
        limits,
        commands=commands,
        capabilities=end.codec.capabilities,
        answer_stream=answer_stream,
        on_event=recording.event,
        admittance=end.admittance,
    )
    session = Session(end.codec, float("inf") if settings.clock == "robot" else _SILENCE, recording.event)
    rehearsals: list[Rehearsal] = []
    if commands and end.aside is not None:
        rehearsals = [Rehearsal(robot, limits, spare, end.aside, end.admittance) for spare in end.spares]
    return Arm(robot, end.port, end.codec, session, guide, recording, settings, wall_ns, fusion, rehearsals)


def finished(arms: Sequence[Arm], reason: str, feeds: Sequence[Feed] = ()) -> Run:
    """Close the recordings and return what the run left behind."""
    runs = []
    told = {}
    for feed in feeds:
        told |= getattr(feed, "summary", dict)()
    for arm in arms:
        try:
            arm.record()
            lost = []
        except Exception as error:  # the recording is finished all the same
            lost = [f"The last rows were not recorded: {type(error).__name__}."]
        counted = {**statistics(arm, reason), **told}
        why = arm.guide.refusing
        refused = [f"The last command to {arm.robot.name} was refused. {why}"] if why else []
        problems = refused + lost + arm.recording.close(counted)
        events = tuple(arm.recording.events)
        runs.append(Run(reason, {**counted, "problems": problems}, events, arm.recording.path, arm.recording))
    return runs[0] if len(runs) == 1 else Run.of_several(reason, tuple(runs))
