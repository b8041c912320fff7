"""Options of ``armlab sim`` that belong together: faults, content of the packets, what happens around the arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from armlab.errors import ConfigError
from armlab.sim.controller.settings import FaultRates

if TYPE_CHECKING:
    from armlab.robots import Robot
    from armlab.sim import Surroundings

__all__ = ["Around", "Content", "FaultOptions", "pair"]

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
        """Return the rates, or raise ConfigError for what makes no sense."""
        given: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        return FaultRates(**{**given, "delay": pair("delay", self.delay), "pause": pair("pause", self.pause)})


_, _, _attributes = (FaultRates.__doc__ or "").partition("    Attributes\n")  # the help is written once, there
FaultOptions.__doc__ = f"{FaultOptions.__doc__}\n\n    Attributes\n{_attributes.partition('    Raises')[0]}"


@dataclass(frozen=True)
class Content:
    """What the packets hold.

    Attributes
    ----------
    robotware : str
        Flavour: 6.06 sends radians and no time, 6.07 time, 6.10 the utilization, 7 what came later.
    axes : str
        A robot without a name: 6 for irb1200, 7 for yumi_right, scara for an invented robot of four axes.
    external : int
        External axes beyond those of the robot.
    rapid_data : int
        How many of the numbers that RAPID hears it sends back, with the digital value (RobotWare 7).
    fields : str
        Fields of EgmRobot to leave out, with commas between: tm, planned, cartesian, time, motorState, mciState,
        rapidExecState, mciConvergenceMet, utilizationRate.
    force : bool
        Send the wrench on the tool as measuredForce, in the layout of the RobotWare.
    lagging : bool
        No masses: the arm follows its reference through a dead time of two cycles and a lag of 8 ms, without torques.
        So do all robots of which no masses are assumed.
    """

    robotware: Literal["6.06", "6.07", "6.10", "7"] = "6.10"
    axes: Literal["6", "7", "scara"] | None = None
    external: int = 0
    rapid_data: int = 0
    fields: str = ""
    force: bool = False
    lagging: bool = False

    def __post_init__(self) -> None:
        """Check what RAPID sends back."""
        if not 0 <= self.rapid_data <= 40 or (self.rapid_data and self.robotware != "7"):
            raise ConfigError(
                f"Expected --rapid-data from 0 to 40, with --robotware 7 only, got {self.rapid_data} and RobotWare "
                f"{self.robotware}."
            )

    def names(self, robots: Sequence[str], count: int) -> tuple[str, ...]:
        """Return the names of the robots.

        Parameters
        ----------
        robots : names given. count : of the addresses.

        Raises
        ------
        ConfigError : both names and axes.
        """
        if self.axes and robots:
            raise ConfigError(f"Expected names of robots or --axes, got both: {', '.join(robots)} and {self.axes}.")
        return (_AXES[self.axes],) * count if self.axes else tuple(robots)

    @property
    def left_out(self) -> list[str]:
        """Names of the fields to leave out."""
        return [name.strip() for name in self.fields.split(",") if name.strip()]


@dataclass(frozen=True)
class Around:
    """What happens around the arms.

    Attributes
    ----------
    operator : Path
        CSV file of the wrench that a hand exerts on the first robot, t,fx,fy,fz,mx,my,mz: seconds since guidance began,
        N and N m in base axes at the tool point, linear between rows.
    hand : Path
        CSV file of the posture to which a hand leads the first robot with --program lead-through, t,q1,q2,... in rad;
        without it the path is random and smooth.
    grip : str
        START,END [s] of guidance time: a hand takes the tool of the first robot, holds it where it is, and lets go.
    motors : str
        State of the motors over robot time, as on, or 0:on,2.5:off,4:on. Also: undefined.
    rapid : str
        State of RAPID over robot time: running, stopped or undefined (stuck, as after a restart).
    """

    operator: Path | None = None
    hand: Path | None = None
    grip: str | None = None
    motors: str = "on"
    rapid: str = "running"

    def scene(self, robot: Robot, index: int, seed: list[int], external: int) -> Surroundings:
        """Return what happens around one robot.

        Parameters
        ----------
        robot : its description. index : 0 for the first, which the files are for. seed : of a random hand.
        external : number of external axes.

        Raises
        ------
        ConfigError, UnknownName : a file or a state that makes no sense.
        """
        from armlab.cli.sim_files import read_hand, read_operator
        from armlab.sim import MOTORS, RAPID, AppliedWrench, Grip, HandPath, StateScript, Surroundings

        operator = AppliedWrench.idle() if self.operator is None or index else read_operator(self.operator)
        hand = HandPath.random(robot, seed) if self.hand is None or index else read_hand(self.hand, robot.n)
        grip = None if self.grip is None or index else Grip(*pair("grip", self.grip))
        return Surroundings(
            operator, hand, StateScript(self.motors, MOTORS), StateScript(self.rapid, RAPID), external, grip
        )


def pair(name: str, text: str) -> tuple[float, float]:
    """Return the two numbers of an option.

    Parameters
    ----------
    name : of the option, for the message. text : as typed, "1,2".

    Raises
    ------
    ConfigError : the text is not two numbers.
    """
    words = text.split(",")
    try:
        first, second = (float(word) for word in words)
    except ValueError:
        raise ConfigError(f"Expected two numbers with a comma between for --{name}, got {text!r}.") from None
    return first, second
