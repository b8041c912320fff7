"""``armlab sim``: simulate arms and their EGM controllers."""

from __future__ import annotations

import json as json_format
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
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
    from armlab.sim.controller.rws import VirtualController
    from armlab.sim.controller.statistics import ControllerEvent
    from armlab.sim.events import AppliedWrench, HandPath, Surroundings

_AXES = {"6": "irb1200", "7": "yumi_right", "scara": "scara"}


@dataclass(frozen=True)
class FaultOptions:
    """`FaultRates` as command options, with pairs of numbers as text."""

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


_attributes = (FaultRates.__doc__ or "").partition("    Attributes\n")[2]  # shared help texts
FaultOptions.__doc__ = f"{FaultOptions.__doc__}\n\n    Attributes\n{_attributes.partition('    Raises')[0]}"


@dataclass(frozen=True)
class PacketOptions:
    """Packet contents.

    Attributes:
        robotware: RobotWare version: 6.06 sends radians and no time; 6.07 adds the time, 6.10 the utilisation rate,
            and 7 the later fields.
        axes: Number of axes, instead of a robot name: 6 for irb1200, 7 for yumi_right, scara for a generic SCARA robot.
        external: Number of external axes in addition to the robot axes.
        rapid_data: Number of RAPID data values sent back, in addition to the digital value (RobotWare 7).
        fields: Optional fields of EgmRobot to omit, separated by commas: tm, planned, cartesian, time, motorState,
            mciState, rapidExecState, mciConvergenceMet, utilizationRate.
        force: Send the wrench on the tool as measuredForce, in the layout of the RobotWare version.
        lagging: Simulate only the kinematics: the arm follows its reference with a dead time of two cycles and a lag of
            8 ms, without torques. Always used for robots without masses.
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
                f"Expected --rapid-data from 0 to 40, and only with --robotware 7, got {self.rapid_data} and RobotWare "
                f"{self.robotware}."
            )

    def names(self, robots: Sequence[str], count: int) -> tuple[str, ...]:
        if self.axes and robots:
            raise ConfigError(f"Expected robot names or --axes, got both: {', '.join(robots)} and {self.axes}.")
        return (_AXES[self.axes],) * count if self.axes else tuple(robots)


@dataclass(frozen=True)
class SurroundingOptions:
    """External events.

    Attributes:
        operator: CSV file of the wrench applied to the first robot, with columns t,fx,fy,fz,mx,my,mz: time since the
            start of guidance [s], then force [N] and moment [N m] in base axes at the tool point. Rows are interpolated
            linearly.
        hand: With --program lead-through: CSV file of the path along which a hand leads the first robot, t,q1,q2,... in
            rad; default: a random smooth path.
        grip: START,END in guidance time [s]: interval in which a hand holds the tool of the first robot in place.
        motors: Motor state over robot time: on, off or undefined, such as on, or 0:on,2.5:off,4:on.
        rapid: RAPID state over robot time: running, stopped, or undefined (stuck, as after a restart).
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


@dataclass(frozen=True)
class RwsOptions:
    """Robot Web Services of the controller.

    Attributes:
        rws: TCP port on 127.0.0.1 for Robot Web Services: RWS 1.0 for RobotWare 6, 2.0 over TLS for RobotWare 7; 0
            selects a free port. The controller then starts with motors off and no program, and sends packets once RAPID
            runs. The user name and password are read from ARMLAB_RWS_USER and ARMLAB_RWS_PASSWORD; default: ABB's
            "Default User" and "robotics".
        rws_fault: Faults of the controller, separated by commas: version, password, option, manual,
            emergency-stop, guard-stop, motors, mastership, busy, main, module, file, semantic, device, address,
            interface.
    """

    rws: int | None = None
    rws_fault: str = ""

    def controller(
        self, names: Sequence[str], to: Sequence[tuple[str, int]], robotware: str, lockstep: bool
    ) -> VirtualController | None:
        faults = [word.strip() for word in self.rws_fault.split(",") if word.strip()]
        if self.rws is None:
            if faults:
                raise ConfigError(f"Expected --rws PORT together with --rws-fault, got {self.rws_fault} alone.")
            return None
        if not 0 <= self.rws < 65536 or lockstep:
            raise ConfigError(f"Expected --rws with a port from 0 to 65535 and without --lockstep, got {self.rws}.")
        from armlab.sim.controller.rws import VirtualController

        return VirtualController(names, to, robotware, faults)

    @contextmanager
    def serving(self, box: VirtualController | None) -> Iterator[None]:
        """Run the services inside the with block; RWS 2.0 uses a self-signed certificate, as on OmniCore
        controllers."""
        if box is None or self.rws is None:
            yield
            return
        from armlab.cli.bridge import self_signed
        from armlab.sim.controller.rws import RwsServer

        tls = None
        if box.is_rws2:
            with tempfile.TemporaryDirectory() as folder:
                tls = self_signed(Path(folder))
        user, password = os.environ.get("ARMLAB_RWS_USER"), os.environ.get("ARMLAB_RWS_PASSWORD")
        with closing(RwsServer(box, self.rws, user or "Default User", password or "robotics", tls)) as server:
            note(f"Robot Web Services: http{'s' if tls else ''}://127.0.0.1:{server.port}")
            yield


def pair(name: str, text: str) -> tuple[float, float]:
    words = text.split(",")
    try:
        first, second = (float(word) for word in words)
    except ValueError:
        raise ConfigError(f"Expected two numbers separated by a comma for --{name}, got {text!r}.") from None
    return first, second


_OPERATOR = ("t", "fx", "fy", "fz", "mx", "my", "mz")
_SHOWN = 80  # maximum number of characters quoted from an invalid line


def read_operator(path: Path) -> AppliedWrench:
    """Return the operator's wrench from a CSV file with the header ``t,fx,fy,fz,mx,my,mz``."""
    from armlab.sim.events import AppliedWrench

    table = _read(path, _OPERATOR, "an operator file")
    return AppliedWrench(table[:, 0], table[:, 1:])


def read_hand(path: Path, n: int) -> HandPath:
    """Return the path of a guiding hand from a CSV file with the header ``t,q1,q2,...``."""
    from armlab.sim.events import HandPath

    table = _read(path, ("t", *(f"q{i + 1}" for i in range(n))), "a hand path")
    if len(table) < 2:
        raise ConfigError(f"Expected at least two rows in {path}, got {len(table)}.")
    return HandPath(table[:, 0], table[:, 1:])


def _read(path: Path, names: Sequence[str], what: str) -> np.ndarray:
    """Return the numbers in a CSV file whose first column is strictly increasing time."""
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
                f"Expected increasing times in line {number} of {path}, got {row[0]:g} s after {rows[-1][0]:g} s."
            )
        rows.append(row)
    return np.array(rows).reshape(len(rows), len(names))


class TextFile:
    """New text file whose error messages include its path."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: TextIO = self._attempt(lambda: path.open("w", encoding="utf-8"))

    def write(self, text: str) -> None:
        self._attempt(lambda: self._file.write(text))

    def close(self) -> None:
        self._attempt(self._file.close)

    def _attempt(self, work: Callable[[], Any]) -> Any:
        try:
            return work()
        except OSError as error:
            raise LogError(
                f"Expected to write {self._path}, got: {error.strerror}. Free some space there or choose another file."
            ) from None


def truth_writer(file: TextFile, controller: SimulatedController) -> Callable[[UdpClient], None]:
    """Write the header of the truth file, and return a function that writes one row per packet."""
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
    services: Annotated[RwsOptions, _flat] = RwsOptions(),
    settings: Annotated[ControllerSettings, _flat] = ControllerSettings(),  # noqa: B008 - frozen
    faults: Annotated[FaultOptions, _flat] = FaultOptions(),
    outgoing: FaultOptions | None = None,
    incoming: FaultOptions | None = None,
    mismatch: Mismatch = Mismatch(),  # noqa: B008 - frozen
    parent: Annotated[int | None, Parameter(show=False)] = None,
) -> int:
    """Simulate arms and their EGM controllers.

    Masses are taken from the robot's description; friction and noise are synthetic.

    Parameters:
        robot: Library names or robot files, one per motion task. Omit them with --axes.
        to: HOST:PORT of the bridge; for several robots, one address each, separated by commas.
        lockstep: Wait for each reply, and run as fast as the bridge replies; runs with the same seed produce identical
            bytes.
        seed: Seed of the noise, the faults and the random hand; for several robots, optionally one seed each, separated
            by commas.
        seconds: Stop after this time, measured by the robot's clock [s]; default: run until Ctrl-C.
        extension: Also send velocities and torques (research extension, field 101), and accept torque and gain
            commands.
        phase: With several robots: delay of each robot's packets after those of the previous robot [s].
        truth: CSV output file for the exact state, friction and wrench of every packet (one robot only).
        stats: JSON output file for counters and round-trip times of each robot; repeated names are numbered.
        json: Print events as JSON, one object per line.
        patience: Timeout for a reply in lockstep [s].
        abb_defaults: Use ABB's default settings: speed deviation 1 deg/s, convergence after 1 s within 0.5 deg.
            Explicit options take precedence.
        content: Content of the packets.
        around: Environment of the arms.
        services: Robot Web Services of the controller.
        settings: Settings of the controller.
        faults: Network faults in both directions.
        outgoing: Faults of the robot's packets only, for example --outgoing.loss 0.1.
        incoming: Faults of the replies only.
        mismatch: Differences between the arms and their description, for example --mismatch.torque-constant 0.05.
        parent: Exit when this process ends; default: the parent process.
    """
    from armlab.sim.controller.cycles import Timing, run

    parent = os.getppid() if parent is None else parent  # first, because the parent may end at any time
    pace = Timing(lockstep, seconds, patience)
    if not 0.0 <= phase < math.inf:
        raise ConfigError(f"Expected a phase of at least 0 s, got {phase:g}.")
    if abb_defaults:
        settings = _with_abb_defaults(settings)
    tell = (lambda event: note(json_format.dumps(event._asdict()))) if json else (lambda event: note(str(event)))
    addresses = _addresses(to)
    names = content.names(robot, len(addresses))
    if not names or len(addresses) != len(names):
        raise ConfigError(
            f"Expected one address in --to per robot, got {len(names)} robots and {len(addresses)} addresses."
        )
    if truth is not None and len(names) > 1:
        raise ConfigError(f"Expected one robot together with --truth, got {len(names)}. Start one simulator per robot.")
    seeds = _seeds(seed, len(names))
    box = services.controller(names, addresses, content.robotware, lockstep)
    both = (outgoing or faults, incoming or faults)
    cell = _SharedOptions(content, around, settings, both, mismatch, extension, phase, tell, box)
    with ExitStack() as opened:
        channels: list[UdpClient] = []
        for i, (name, address) in enumerate(zip(names, addresses)):
            with deferred():  # SciPy loads here
                channels.append(cell.channel(name, address, i, [seeds[i], i]))
            opened.callback(channels[-1].close)
        summary, exact = (path and opened.enter_context(closing(TextFile(path))) for path in (stats, truth))
        observe = truth_writer(exact, channels[0].controller) if exact else None
        opened.enter_context(services.serving(box))
        try:
            # end with the parent process
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
    """Return the settings with ABB's defaults for all options that the user omitted."""
    ours, abb = ControllerSettings(), ControllerSettings.abb_defaults()
    omitted = [one.name for one in fields(settings) if getattr(settings, one.name) == getattr(ours, one.name)]
    return replace(settings, **{name: getattr(abb, name) for name in omitted})


def _seeds(seed: str, count: int) -> list[int]:
    words = [word.strip() for word in seed.split(",")]
    if len(words) not in (1, count) or not all(word.isascii() and word.isdigit() and len(word) < 20 for word in words):
        raise ConfigError(f"Expected --seed to be one integer of at least 0, or one per robot, got {seed!r}.")
    return [int(word) for word in words] * (count // len(words))


def _addresses(to: str) -> list[tuple[str, int]]:
    """Return the host and port of each robot."""
    found = []
    for word in to.split(","):
        host, _, port = word.strip().rpartition(":")
        if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
            raise ConfigError(f"Expected --to HOST:PORT with a port from 1 to 65535, got {word!r}.")
        found.append((host, int(port)))
    return found


@dataclass(frozen=True)
class _SharedOptions:
    """Options common to all robots of a command."""

    content: PacketOptions
    around: SurroundingOptions
    settings: ControllerSettings
    faults: tuple[FaultOptions, FaultOptions]
    mismatch: Mismatch
    extension: bool
    phase: float
    tell: Callable[[ControllerEvent], None]
    box: VirtualController | None

    def channel(self, name: str, address: tuple[str, int], index: int, seed: list[int]) -> UdpClient:
        from armlab.sim.controller.channel import Faults, UdpClient
        from armlab.sim.controller.controller import PacketBuilder, SimulatedController
        from armlab.wire.egm.robot_side import RobotSideCodec

        content, settings = self.content, self.settings
        robot = simulated(name)
        both: dict[str, Any] = {"force": content.force, "data": content.rapid_data}
        codec = RobotSideCodec(robot, content.robotware, self.extension, external=content.external, **both)
        packets = PacketBuilder(
            codec,
            settings.period,
            fields=[name.strip() for name in content.fields.split(",") if name.strip()],
            phase=index * self.phase,
            torque_reference=content.robotware == "7" and settings.level == 0 and not settings.only_streams,
            **both,
        )
        if self.around.hand and not index and settings.program != "lead-through":
            raise ConfigError(
                f"Expected --program lead-through with --hand, got {settings.program}. For a pushing hand, use "
                "--operator."
            )
        scene = self.around.scene(robot, index, [*seed, 3], content.external)
        if self.box is not None:
            scene = replace(scene, **self.box.scene(index))
        controller = SimulatedController(self._arm(robot, seed, index), packets, settings, scene, self.tell)
        rates = [options.rates() for options in self.faults]
        ways = [Faults(one, [*seed, i], settings.period) if one.any else None for i, one in enumerate(rates, 1)]
        return UdpClient(controller, *address, *ways, phase=index * self.phase)

    def _arm(self, robot: Robot, seed: list[int], index: int) -> SimulatedArm | LaggingArm:
        from armlab.sim.arm.arm import LaggingArm, SimulatedArm
        from armlab.sim.arm.truth import no_masses, synthetic_truth

        period = self.settings.period
        why = "--lagging simulates only the kinematics, without torques" if self.content.lagging else no_masses(robot)
        if not why:
            if robot.inertias is not None and math.inf in robot.tau_max:
                note(
                    f"note: {robot.name} has joints without an effort limit. Their "
                    "drives are scaled from the torque needed to hold the outstretched arm"
                )
            return SimulatedArm(robot, synthetic_truth(robot), period=period, seed=seed, mismatch=self.mismatch)
        unusable = {"operator": self.around.operator and not index, "grip": self.around.grip and not index}
        unusable["mismatch"] = self.mismatch != Mismatch(seed=self.mismatch.seed)
        if option := next((option for option, given in unusable.items() if given), None):
            raise ConfigError(f"Expected an arm with masses for --{option}, but {why}. Omit --{option}.")
        note(f"note: {why}. The arm follows references and ignores torque commands and external forces")
        return LaggingArm(robot, period)
