"""``armlab sim``: simulated arms and a simulated controller that speaks EGM."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import numpy as np
from cyclopts import Parameter

from armlab.cli import FAILED, INTERRUPTED, interrupts_deferred
from armlab.errors import ConfigError
from armlab.sim.faults import FaultRates, Faults
from armlab.sim.guidance import Settings
from armlab.sim.mismatch import Mismatch
from armlab.sim.operator import Operator

if TYPE_CHECKING:
    from armlab.sim.channel import Channel
    from armlab.sim.controller import Controller

__all__ = ["read_operator", "sim"]

_OPERATOR = ("t", "fx", "fy", "fz", "mx", "my", "mz")
_SHOWN = 80  # characters of a wrong line that a message quotes
_flat = Parameter(name="*")


def sim(
    *robot: str,
    to: str,
    lockstep: bool = False,
    seed: int = 0,
    seconds: float | None = None,
    extension: bool = False,
    operator: Path | None = None,
    truth: Path | None = None,
    stats: Path | None = None,
    patience: float = 10.0,
    abb_defaults: bool = False,
    settings: Annotated[Settings, _flat] = Settings(),  # noqa: B008 - frozen
    faults: Annotated[FaultRates, _flat] = FaultRates(),  # noqa: B008 - frozen
    mismatch: Mismatch = Mismatch(),  # noqa: B008 - frozen
) -> int:
    """Simulate arms and their EGM controller. Masses, friction and noise are invented; see the documentation.

    Parameters
    ----------
    robot : str
        Names in the library, one motion task each.
    to : str
        HOST:PORT of the bridge; with several robots one each, separated by commas.
    lockstep : bool
        Wait for each reply and run as fast as the peer; the same seed gives the same bytes.
    seed : int
        Seed of noise and faults.
    seconds : float
        Robot time after which to end [s]; without it until Ctrl-C.
    extension : bool
        Send velocities and torques too (research extension, field 101).
    operator : Path
        CSV file of the wrench that a hand exerts on the first robot, t,fx,fy,fz,mx,my,mz: seconds since guidance began,
        N and N m in base axes at the tool point, linear between rows.
    truth : Path
        CSV file to write with the exact state, friction and wrench of every packet (one robot only).
    stats : Path
        JSON file to write with counters and round-trip times, per robot; a name given twice gets a number.
    patience : float
        How long lockstep waits for one reply before the session times out [s].
    abb_defaults : bool
        Speed deviation 1 deg/s and convergence after 1 s within 0.5 deg, as on a robot set up without care. What is
        given as an option of its own keeps its value.
    settings : Settings
        Of the controller.
    faults : FaultRates
        In both directions.
    mismatch : Mismatch
        How the arms differ from what is believed of them, for example --mismatch.torque-constant 0.05.
    """
    from armlab.cli.output import note
    from armlab.sim.loop import Pace, run

    parent = os.getppid()  # now, before anything takes time in which it could end
    pace = Pace(lockstep, seconds, patience)
    if seed < 0:
        raise ConfigError(f"Expected a seed of at least 0, got {seed}.")
    if abb_defaults:
        settings = _with_abb_defaults(settings)
    hand = Operator.idle() if operator is None else read_operator(operator)
    addresses = _addresses(to, robot)
    if truth is not None and len(robot) > 1:
        raise ConfigError(f"Expected one robot together with --truth, got {len(robot)}. Start one simulator per robot.")
    with ExitStack() as opened:
        channels: list[Channel] = []
        for i, (name, address) in enumerate(zip(robot, addresses, strict=True)):
            pusher = hand if i == 0 else Operator.idle()
            with interrupts_deferred():  # MuJoCo loads here
                channels.append(_channel(name, address, settings, extension, pusher, faults, mismatch, [seed, i], note))
            opened.callback(channels[-1].close)
        summary, exact = (path and opened.enter_context(path.open("w", encoding="utf-8")) for path in (stats, truth))
        observe = _recorder(exact, channels[0].controller) if exact else None
        try:
            # never outlive the program that started us
            reason = run(channels, pace, alive=lambda: os.getppid() == parent, observe=observe)
            code = FAILED if any(channel.controller.dead for channel in channels) else 0
        except KeyboardInterrupt:
            reason, code = "interrupted", INTERRUPTED
        for name, channel in zip(robot, channels):
            note(f"{name}: {channel.controller.uptime:.3f} s, {channel.controller.statistics.line()}; {reason}")
        if summary:
            labels = [f"{name} {i + 1}" if robot.count(name) > 1 else name for i, name in enumerate(robot)]
            counted = [channel.controller.statistics.as_dict() for channel in channels]
            summary.write(json.dumps(dict(zip(labels, counted)), indent=2) + "\n")
    return code


def read_operator(path: Path) -> Operator:
    """Return the operator described by a CSV file with the header ``t,fx,fy,fz,mx,my,mz``.

    Parameters
    ----------
    path : the file; one row per time, times increasing.

    Raises
    ------
    ConfigError : when the file cannot be read or a row is wrong; names file and line.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"Expected an operator file at {path}, but it cannot be read ({error}).") from error
    header, *lines = text.splitlines() or [""]
    if tuple(word.strip() for word in header.split(",")) != _OPERATOR:
        raise ConfigError(f"Expected the header {','.join(_OPERATOR)} in line 1 of {path}, got {header[:_SHOWN]!r}.")
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=2):
        if not line.strip():
            continue
        row = _numbers(line.split(","))
        if len(row) != len(_OPERATOR) or not all(math.isfinite(value) for value in row):
            raise ConfigError(f"Expected {len(_OPERATOR)} numbers in line {number} of {path}, got {line[:_SHOWN]!r}.")
        if rows and row[0] <= rows[-1][0]:
            raise ConfigError(
                f"Expected times that increase in line {number} of {path}, got {row[0]:g} s after {rows[-1][0]:g} s."
            )
        rows.append(row)
    table = np.array(rows).reshape(len(rows), len(_OPERATOR))
    return Operator(table[:, 0], table[:, 1:])


def _with_abb_defaults(settings: Settings) -> Settings:
    """Return the settings with ABB's defaults where the user gave nothing."""
    ours, careless = Settings(), Settings.abb_defaults()
    names = [field.name for field in fields(Settings)]
    return replace(
        settings, **{name: getattr(careless, name) for name in names if getattr(settings, name) == getattr(ours, name)}
    )


def _numbers(words: Iterable[str]) -> list[float]:
    """Return the words as numbers; nothing when one of them is none."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def _addresses(to: str, robot: tuple[str, ...]) -> list[tuple[str, int]]:
    """Return (host, port) per robot."""
    found = []
    for word in to.split(","):
        host, _, port = word.strip().rpartition(":")
        if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
            raise ConfigError(f"Expected --to HOST:PORT with a port from 1 to 65535, got {word!r}.")
        found.append((host, int(port)))
    if not robot or len(found) != len(robot):
        raise ConfigError(f"Expected robots and as many addresses in --to, got {len(robot)} and {len(found)}.")
    return found


def _channel(
    name: str,
    address: tuple[str, int],
    settings: Settings,
    extension: bool,
    operator: Operator,
    faults: FaultRates,
    mismatch: Mismatch,
    seed: list[int],
    note: Callable[[str], None],
) -> Channel:
    """Return one simulated robot with its socket."""
    from armlab import robots
    from armlab.sim.arm import Arm
    from armlab.sim.channel import Channel
    from armlab.sim.controller import Controller
    from armlab.sim.truth import synthetic_truth
    from armlab.wire.egm import RobotSideCodec

    robot = robots.load(name)
    arm = Arm(robot, synthetic_truth(robot), period=settings.period, seed=seed, mismatch=mismatch)
    controller = Controller(arm, RobotSideCodec(robot, extension=extension), settings, operator, note)
    directions = [Faults(faults, [*seed, stream]) if faults.any else None for stream in (1, 2)]
    return Channel(controller, *address, outgoing=directions[0], incoming=directions[1])


def _recorder(file: TextIO, controller: Controller) -> Callable[[int], None]:
    """Write the header of the truth file and return what writes a row per packet."""
    joints = {"q": "rad", "qd": "rad/s", "qdd": "rad/s^2", "tau": "N m", "tau_friction": "N m"}
    n = controller.arm.robot.n
    header = ["robot_ns", "session", "seq", "t [s]"]
    header += [f"wrench_true{i + 1} [{'N' if i < 3 else 'N m'}]" for i in range(6)]
    header += [f"{name}{i + 1} [{unit}]" for name, unit in joints.items() for i in range(n)]
    file.write(",".join(header) + "\n")

    def write(_: int) -> None:
        sample = controller.arm.sample
        numbers = np.concatenate([sample.wrench, *(getattr(sample, name) for name in joints)])
        stamp = f"{controller.robot_ns},{controller.session},{controller.seq - 1},{controller.guidance_time:.6f}"
        file.write(stamp + "," + ",".join(map(repr, numbers.tolist())) + "\n")

    return write
