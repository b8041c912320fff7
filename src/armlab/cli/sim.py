"""``armlab sim``: simulated arms and their EGM controller, its options, and the files it reads and writes."""

from __future__ import annotations

import json as json_format
import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TextIO

from cyclopts import Parameter

from armlab._interrupts import deferred
from armlab.cli import FAILED, INTERRUPTED
from armlab.cli.support.options import simulated
from armlab.cli.support.output import note
from armlab.errors import ConfigError, LogError
from armlab.sim.arm.mismatch import Mismatch
from armlab.sim.controller.settings import ControllerSettings, FaultRates

if TYPE_CHECKING:
    import numpy as np

    from armlab.robots import Robot
    from armlab.sim.arm.arm import LaggingArm, SimulatedArm
    from armlab.sim.controller.channel import UdpClient
    from armlab.sim.controller.controller import SimulatedController
    from armlab.sim.controller.statistics import ControllerEvent
    from armlab.sim.events import AppliedWrench, HandPath, Surroundings


_AXES = {"6": "irb1200", "7": "yumi_right", "scara": "scara"}


@dataclass(frozen=True)
class FaultOptions:
    """What goes wrong: `FaultRates`, with pairs as text."""

    loss: float = FaultRates.loss
    duplicate: float = FaultRates.duplicate
    reorder: float = FaultRates.reorder
    corrupt: float = FaultRates.corrupt
    delay: str = "0,0"
    pause: str = "0,0"
    burst: int = FaultRates.burst
    until: float = FaultRates.until

    def rates(self) -> FaultRates:
        given: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        return FaultRates(**{**given, "delay": pair("delay", self.delay), "pause": pair("pause", self.pause)})


_, _, _attributes = (FaultRates.__doc__ or "").partition("    Attributes\n")  # the help is written once, there
FaultOptions.__doc__ = f"{FaultOptions.__doc__}\n\n    Attributes\n{_attributes.partition('    Raises')[0]}"


@dataclass(frozen=True)
class PacketOptions:
    """What the packets hold.

    Attributes:
        robotware: Flavour: 6.06 sends radians and no time, 6.07 time, 6.10 the utilization, 7 what came later.
        axes: A robot without a name: 6 for irb1200, 7 for yumi_right, scara for an invented robot of four axes.
        external: External axes beyond those of the robot.
        rapid_data: How many of the numbers that RAPID hears it sends back, with the digital value (RobotWare 7).
        fields: Fields of EgmRobot to leave out, with commas between: tm, planned, cartesian, time, motorState,
            mciState, rapidExecState, mciConvergenceMet, utilizationRate.
        force: Send the wrench on the tool as measuredForce, in the layout of the RobotWare.
        lagging: No masses: the arm follows its reference through a dead time of two cycles and a lag of 8 ms, without
            torques. So do all robots of which no masses are assumed.
    """

    robotware: Literal["6.06", "6.07", "6.10", "7"] = "6.10"
    axes: Literal["6", "7", "scara"] | None = None
    external: int = 0
    rapid_data: int = 0
    fields: str = ""
    force: bool = False
    lagging: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.rapid_data <= 40 or (self.rapid_data and self.robotware != "7"):
            raise ConfigError(
                f"Expected --rapid-data from 0 to 40, with --robotware 7 only, got {self.rapid_data} and RobotWare "
                f"{self.robotware}."
            )

    def names(self, robots: Sequence[str], count: int) -> tuple[str, ...]:
        if self.axes and robots:
            raise ConfigError(f"Expected names of robots or --axes, got both: {', '.join(robots)} and {self.axes}.")
        return (_AXES[self.axes],) * count if self.axes else tuple(robots)


@dataclass(frozen=True)
class SurroundingOptions:
    """What happens around the arms.

    Attributes:
        operator: CSV file of the wrench that a hand exerts on the first robot, t,fx,fy,fz,mx,my,mz: seconds since
            guidance began, N and N m in base axes at the tool point, linear between rows.
        hand: CSV file of the posture to which a hand leads the first robot with --program lead-through, t,q1,q2,... in
            rad; without it the path is random and smooth.
        grip: START,END [s] of guidance time: a hand takes the tool of the first robot, holds it where it is, and lets
            go.
        motors: State of the motors over robot time, as on, or 0:on,2.5:off,4:on. Also: undefined.
        rapid: State of RAPID over robot time: running, stopped or undefined (stuck, as after a restart).
    """

    operator: Path | None = None
    hand: Path | None = None
    grip: str | None = None
    motors: str = "on"
    rapid: str = "running"

    def scene(self, robot: Robot, index: int, seed: list[int], external: int) -> Surroundings:
        from armlab.sim.events import MOTORS, RAPID, Grip, HandPath, StateScript, Surroundings

        operator = None if self.operator is None or index else read_operator(self.operator)
        hand = HandPath.random(robot, seed) if self.hand is None or index else read_hand(self.hand, robot.n)
        grip = None if self.grip is None or index else Grip(*pair("grip", self.grip))
        return Surroundings(
            operator, hand, StateScript(self.motors, MOTORS), StateScript(self.rapid, RAPID), external, grip
        )


def pair(name: str, text: str) -> tuple[float, float]:
    words = text.split(",")
    try:
        first, second = (float(word) for word in words)
    except ValueError:
        raise ConfigError(f"Expected two numbers with a comma between for --{name}, got {text!r}.") from None
    return first, second


_OPERATOR = ("t", "fx", "fy", "fz", "mx", "my", "mz")
_SHOWN = 80  # characters of a wrong line that a message quotes


def read_operator(path: Path) -> AppliedWrench:
    """Return the operator described by a CSV file with the header ``t,fx,fy,fz,mx,my,mz``."""
    from armlab.sim.events import AppliedWrench

    table = _read(path, _OPERATOR, "an operator file")
    return AppliedWrench(table[:, 0], table[:, 1:])


def read_hand(path: Path, n: int) -> HandPath:
    """Return the path of a hand described by a CSV file with the header ``t,q1,q2,...``."""
    from armlab.sim.events import HandPath

    table = _read(path, ("t", *(f"q{i + 1}" for i in range(n))), "a hand path")
    if len(table) < 2:
        raise ConfigError(f"Expected at least two rows in {path}, got {len(table)}.")
    return HandPath(table[:, 0], table[:, 1:])


def _read(path: Path, names: Sequence[str], what: str) -> np.ndarray:
    """Return the numbers of a CSV file whose first column is a time that increases."""
    import numpy as np

    from armlab.cli.support.settings import read_text

    header, *lines = read_text(path, what).splitlines() or [""]
    if tuple(word.strip() for word in header.split(",")) != tuple(names):
        raise ConfigError(f"Expected the header {','.join(names)} in line 1 of {path}, got {header[:_SHOWN]!r}.")
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=2):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != len(names) or not all(math.isfinite(value) for value in row):
            raise ConfigError(f"Expected {len(names)} numbers in line {number} of {path}, got {line[:_SHOWN]!r}.")
        if rows and row[0] <= rows[-1][0]:
            raise ConfigError(
                f"Expected times that increase in line {number} of {path}, got {row[0]:g} s after {rows[-1][0]:g} s."
            )
        rows.append(row)
    return np.array(rows).reshape(len(rows), len(names))


class TextFile:
    """A text file that is written from its beginning; what goes wrong names it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: TextIO = self._named(lambda: path.open("w", encoding="utf-8"))

    def write(self, text: str) -> None:
        self._named(lambda: self._file.write(text))

    def close(self) -> None:
        self._named(self._file.close)

    def _named(self, work: Callable[[], Any]) -> Any:
        try:
            return work()
        except OSError as error:
            raise LogError(
                f"Expected to write {self._path}, got: {error.strerror}. Make room there or choose another file."
            ) from None


def truth_writer(file: TextFile, controller: SimulatedController) -> Callable[[UdpClient], None]:
    """Write the header of the truth file and return what writes a row per packet."""
    import numpy as np

    joints = {"q": "rad", "qd": "rad/s", "qdd": "rad/s^2", "tau": "N m", "tau_friction": "N m"}
    n = controller.arm.robot.n
    header = ["robot_ns", "session", "seq", "t [s]"]
    header += [f"wrench_true{i + 1} [{'N' if i < 3 else 'N m'}]" for i in range(6)]
    header += [f"{name}{i + 1} [{unit}]" for name, unit in joints.items() for i in range(n)]
    file.write(",".join(header) + "\n")

    def write(_: UdpClient) -> None:
        sample = controller.arm.sample
        numbers = np.concatenate([sample.wrench, *(getattr(sample, name) for name in joints)])
        stamp = f"{controller.robot_ns},{controller.session},{controller.seq - 1},{controller.guidance_time:.6f}"
        file.write(stamp + "," + ",".join(map(repr, numbers.tolist())) + "\n")

    return write


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
    content: Annotated[PacketOptions, _flat] = PacketOptions(),
    around: Annotated[SurroundingOptions, _flat] = SurroundingOptions(),
    settings: Annotated[ControllerSettings, _flat] = ControllerSettings(),  # noqa: B008 - frozen
    faults: Annotated[FaultOptions, _flat] = FaultOptions(),
    outgoing: FaultOptions | None = None,
    incoming: FaultOptions | None = None,
    mismatch: Mismatch = Mismatch(),  # noqa: B008 - frozen
    parent: Annotated[int | None, Parameter(show=False)] = None,
) -> int:
    """Simulate arms and their EGM controller. Masses, friction and noise are invented; see the documentation.

    Parameters:
        robot: Names in the library, or robot files, one motion task each; or none together with --axes.
        to: HOST:PORT of the bridge; with several robots one each, separated by commas.
        lockstep: Wait for each reply and run as fast as the peer; the same seed gives the same bytes.
        seed: Seed of noise, faults and the random hand; with several robots also one each, separated by commas.
        seconds: Robot time after which to end [s]; without it until Ctrl-C.
        extension: Send velocities and torques too (research extension, field 101), and obey torques and gains.
        phase: With several robots: how long after the one before each sends [s].
        truth: CSV file to write with the exact state, friction and wrench of every packet (one robot only).
        stats: JSON file to write with counters and round-trip times, per robot; a name given twice gets a number.
        json: Print events as JSON, one object per line.
        patience: How long lockstep waits for one reply before the session times out [s].
        abb_defaults: Speed deviation 1 deg/s and convergence after 1 s within 0.5 deg, as on a robot set up without
            care. What is given as an option of its own keeps its value.
        content: Of the packets.
        around: The arms.
        settings: Of the controller.
        faults: In both directions.
        outgoing: Of the robot's packets instead, for example --outgoing.loss 0.1.
        incoming: Of the replies instead.
        mismatch: How the arms differ from what is believed of them, for example --mismatch.torque-constant 0.05.
        parent: Process with which to end; the one that started this one by default.
    """
    from armlab.sim.controller.cycles import Timing, run

    os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is drawn: MuJoCo need not load what opens windows
    parent = os.getppid() if parent is None else parent  # now, before anything takes time in which it could end
    pace = Timing(lockstep, seconds, patience)
    if not 0.0 <= phase < math.inf:
        raise ConfigError(f"Expected a phase of at least 0 s, got {phase:g}.")
    if abb_defaults:
        settings = _with_abb_defaults(settings)
    tell = (lambda event: note(json_format.dumps(event._asdict()))) if json else (lambda event: note(str(event)))
    cell = _SharedOptions(
        content, around, settings, (outgoing or faults, incoming or faults), mismatch, extension, phase, tell
    )
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
        summary, exact = (path and opened.enter_context(closing(TextFile(path))) for path in (stats, truth))
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
class _SharedOptions:
    """All that is the same for every robot of one command."""

    content: PacketOptions
    around: SurroundingOptions
    settings: ControllerSettings
    faults: tuple[FaultOptions, FaultOptions]
    mismatch: Mismatch
    extension: bool
    phase: float
    tell: Callable[[ControllerEvent], None]

    def channel(self, name: str, address: tuple[str, int], index: int, seed: list[int]) -> UdpClient:
        from armlab.sim.controller.channel import Faults, UdpClient
        from armlab.sim.controller.controller import SimulatedController
        from armlab.sim.controller.packets import PacketBuilder
        from armlab.wire.egm.robot_side import RobotSideCodec

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
            fields=[name.strip() for name in content.fields.split(",") if name.strip()],
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
