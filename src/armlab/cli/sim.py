"""``armlab sim``: simulated arms and a simulated controller that speaks EGM."""

from __future__ import annotations

import json as json_format
import math
import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from armlab._interrupts import deferred
from armlab.cli import FAILED, INTERRUPTED
from armlab.cli.sim_options import Around, Content, FaultOptions
from armlab.errors import ConfigError
from armlab.sim.arm.mismatch import Mismatch
from armlab.sim.controller.settings import ControllerSettings

if TYPE_CHECKING:
    from armlab.robots import Robot
    from armlab.sim.arm.arm import LaggingArm, SimulatedArm
    from armlab.sim.controller.channel import UdpClient
    from armlab.sim.controller.statistics import ControllerEvent

__all__ = ["sim"]

_flat = Parameter(name="*")


def sim(
    *robot: str,
    to: str,
    lockstep: bool = False,
    seed: str = "0",
    seconds: float | None = None,
    extension: bool = False,
    phase: float = 0.0,
    truth: Path | None = None,
    stats: Path | None = None,
    json: bool = False,
    patience: float = 10.0,
    abb_defaults: bool = False,
    content: Annotated[Content, _flat] = Content(),  # noqa: B008 - frozen
    around: Annotated[Around, _flat] = Around(),  # noqa: B008 - frozen
    settings: Annotated[ControllerSettings, _flat] = ControllerSettings(),  # noqa: B008 - frozen
    faults: Annotated[FaultOptions, _flat] = FaultOptions(),  # noqa: B008 - frozen
    outgoing: FaultOptions | None = None,
    incoming: FaultOptions | None = None,
    mismatch: Mismatch = Mismatch(),  # noqa: B008 - frozen
    parent: Annotated[int | None, Parameter(show=False)] = None,
) -> int:
    """Simulate arms and their EGM controller. Masses, friction and noise are invented; see the documentation.

    Parameters
    ----------
    robot : str
        Names in the library, or robot files, one motion task each; or none together with --axes.
    to : str
        HOST:PORT of the bridge; with several robots one each, separated by commas.
    lockstep : bool
        Wait for each reply and run as fast as the peer; the same seed gives the same bytes.
    seed : str
        Seed of noise, faults and the random hand; with several robots also one each, separated by commas.
    seconds : float
        Robot time after which to end [s]; without it until Ctrl-C.
    extension : bool
        Send velocities and torques too (research extension, field 101), and obey torques and gains.
    phase : float
        With several robots: how long after the one before each sends [s].
    truth : Path
        CSV file to write with the exact state, friction and wrench of every packet (one robot only).
    stats : Path
        JSON file to write with counters and round-trip times, per robot; a name given twice gets a number.
    json : bool
        Print events as JSON, one object per line.
    patience : float
        How long lockstep waits for one reply before the session times out [s].
    abb_defaults : bool
        Speed deviation 1 deg/s and convergence after 1 s within 0.5 deg, as on a robot set up without care. What is
        given as an option of its own keeps its value.
    content : Content
        Of the packets.
    around : Around
        The arms.
    settings : Settings
        Of the controller.
    faults : FaultOptions
        In both directions.
    outgoing : FaultOptions
        Of the robot's packets instead, for example --outgoing.loss 0.1.
    incoming : FaultOptions
        Of the replies instead.
    mismatch : Mismatch
        How the arms differ from what is believed of them, for example --mismatch.torque-constant 0.05.
    parent : int
        Process with which to end; the one that started this one by default.
    """
    from armlab.cli.output import note
    from armlab.cli.sim_files import Written, truth_writer
    from armlab.sim.controller.cycles import Timing, run

    os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is drawn: MuJoCo need not load what opens windows
    parent = os.getppid() if parent is None else parent  # now, before anything takes time in which it could end
    pace = Timing(lockstep, seconds, patience)
    if not 0.0 <= phase < math.inf:
        raise ConfigError(f"Expected a phase of at least 0 s, got {phase:g}.")
    if abb_defaults:
        settings = _with_abb_defaults(settings)
    tell = (lambda event: note(json_format.dumps(event._asdict()))) if json else (lambda event: note(str(event)))
    cell = _Cell(content, around, settings, (outgoing or faults, incoming or faults), mismatch, extension, phase, tell)
    addresses = _addresses(to)
    names = content.names(robot, len(addresses))
    if not names or len(addresses) != len(names):
        raise ConfigError(f"Expected robots and as many addresses in --to, got {len(names)} and {len(addresses)}.")
    if truth is not None and len(names) > 1:
        raise ConfigError(f"Expected one robot together with --truth, got {len(names)}. Start one simulator per robot.")
    seeds = _seeds(seed, len(names))
    with ExitStack() as opened:
        channels: list[UdpClient] = []
        for i, (name, address) in enumerate(zip(names, addresses)):
            with deferred():  # MuJoCo loads here
                channels.append(cell.channel(name, address, i, [seeds[i], i]))
            opened.callback(channels[-1].close)
        summary, exact = (path and opened.enter_context(Written(path)) for path in (stats, truth))
        observe = truth_writer(exact, channels[0].controller) if exact else None
        try:
            # never outlive the program that started us
            reason = run(channels, pace, alive=lambda: os.getppid() == parent, observe=observe)
            code = FAILED if any(channel.controller.dead for channel in channels) else 0
        except KeyboardInterrupt:
            reason, code = "interrupted", INTERRUPTED
        for name, channel in zip(names, channels):
            counted = channel.controller.statistics
            note(f"{name}: {channel.controller.uptime:.3f} s, {counted.line()}; {reason}\n{counted.text()}")
        if summary:
            labels = [f"{name} {i + 1}" if names.count(name) > 1 else name for i, name in enumerate(names)]
            found = [channel.controller.statistics.as_dict() for channel in channels]
            summary.write(json_format.dumps(dict(zip(labels, found)), indent=2) + "\n")
    return code


def _with_abb_defaults(settings: ControllerSettings) -> ControllerSettings:
    """Return the settings with ABB's defaults where the user gave nothing."""
    ours, careless = ControllerSettings(), ControllerSettings.abb_defaults()
    names = [field.name for field in fields(ControllerSettings)]
    return replace(
        settings, **{name: getattr(careless, name) for name in names if getattr(settings, name) == getattr(ours, name)}
    )


def _seeds(seed: str, count: int) -> list[int]:
    """Return the seed of each robot."""
    words = [word.strip() for word in seed.split(",")]
    if len(words) not in (1, count) or not all(word.isascii() and word.isdigit() and len(word) < 20 for word in words):
        raise ConfigError(f"Expected --seed as one whole number of at least 0, or one per robot, got {seed!r}.")
    return [int(word) for word in words] * (count // len(words))


def _addresses(to: str) -> list[tuple[str, int]]:
    """Return (host, port) per robot."""
    found = []
    for word in to.split(","):
        host, _, port = word.strip().rpartition(":")
        if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
            raise ConfigError(f"Expected --to HOST:PORT with a port from 1 to 65535, got {word!r}.")
        found.append((host, int(port)))
    return found


@dataclass(frozen=True)
class _Cell:
    """All that is the same for every robot of one command."""

    content: Content
    around: Around
    settings: ControllerSettings
    faults: tuple[FaultOptions, FaultOptions]
    mismatch: Mismatch
    extension: bool
    phase: float
    tell: Callable[[ControllerEvent], None]

    def channel(self, name: str, address: tuple[str, int], index: int, seed: list[int]) -> UdpClient:
        """Return one simulated robot with its socket."""
        from armlab.cli.links import simulated
        from armlab.sim.controller.channel import Faults, UdpClient
        from armlab.sim.controller.controller import SimulatedController
        from armlab.sim.controller.packets import PacketBuilder
        from armlab.wire.egm import RobotSideCodec

        content, settings = self.content, self.settings
        robot = simulated(name)
        is_rw7 = content.robotware == "7"
        codec = RobotSideCodec(
            robot,
            content.robotware,
            self.extension,
            force=content.force,
            external=content.external,
            data=content.rapid_data,
        )
        packets = PacketBuilder(
            codec,
            settings.period,
            fields=content.left_out,
            phase=index * self.phase,
            force=content.force,
            torque_reference=is_rw7 and settings.level == 0 and not settings.only_streams,
            data=content.rapid_data,
        )
        scene = self.around.scene(robot, index, [*seed, 3], content.external)
        controller = SimulatedController(self._arm(robot, seed), packets, settings, scene, self.tell)
        both = [options.rates() for options in self.faults]
        ways = [Faults(rates, [*seed, i], settings.period) if rates.any else None for i, rates in enumerate(both, 1)]
        return UdpClient(controller, *address, *ways, phase=index * self.phase)

    def _arm(self, robot: Robot, seed: list[int]) -> SimulatedArm | LaggingArm:
        from armlab.sim.arm.arm import LaggingArm, SimulatedArm
        from armlab.sim.arm.truth import synthetic_truth, truth_names

        period = self.settings.period
        if self.content.lagging or robot.name not in truth_names():
            return LaggingArm(robot, period)
        return SimulatedArm(robot, synthetic_truth(robot), period=period, seed=seed, mismatch=self.mismatch)
