"""Options shared by the commands of ``armlab plot``: output file, part of a log, joints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

if TYPE_CHECKING:
    import numpy as np

    from armlab.log import Table
    from armlab.models import TorqueModel
    from armlab.robots import Robot


POSES = ("T_base_tool", "T_frame_tool")

Joints = Annotated[str | None, Parameter(help="Numbers from 1 with commas between; all when not given.")]
"""Which joints are drawn."""
OwnRobot = Annotated[str | None, Parameter(help="Robot file, where the robot of the model is not in the library.")]
"""The robot of a model."""


@Parameter(name="*")
@dataclass(frozen=True)
class FigureFile:
    """Where the figure goes.

    Attributes
    ----------
    output : Path
        PNG, SVG or PDF; beside the input, with its name and that of the figure, when not given.
    show : bool
        Open a window too.
    force : bool
        Replace an existing file.
    """

    output: Annotated[Path | None, Parameter(alias="-o")] = None
    show: bool = False
    force: bool = False

    def path(self, source: Path | str, name: str) -> Path:
        """Return the name of the file, refused before the work begins."""
        from armlab.cli.support.output import FIGURES, check_output

        beside = Path(source)
        path = beside.with_name(f"{beside.stem}_{name}.png") if self.output is None else self.output
        check_output(path, self.force, FIGURES)
        return path

    def save(self, drawn: Any, path: Path) -> int:
        """Write the figure, print its path, open a window where one is wanted; return the exit code."""
        from armlab import plots
        from armlab.cli.support.output import result, save_figure

        save_figure(drawn, path)
        result(str(path))
        if self.show:
            plots.show()
        return 0


@Parameter(name="*")
@dataclass(frozen=True)
class Part:
    """Which part of a log.

    Attributes
    ----------
    start : float
        Time from which it counts [s]; its beginning when not given.
    end : float
        Time to which it counts [s]; its end when not given.
    arm : str
        Whose rows, of a recording of several arms.
    """

    start: float | None = None
    end: float | None = None
    arm: str | None = None

    def read(self, path: Path, robot: str | None = None) -> Table:
        """Return that part of a log."""
        from armlab import log, robots
        from armlab.errors import LogError
        from armlab.log.topics.reader import is_foreign, read_joints

        if robot is not None and is_foreign(path):
            whole = read_joints(path, robots.load(robot))
        else:
            whole = log.read(path, robot=self.arm)
        low, high = (-math.inf if self.start is None else self.start), (math.inf if self.end is None else self.end)
        if not len(whole):
            raise LogError(f"Expected rows in {path}, got a log without any. Nothing was recorded.")
        part, last = whole.between(low, high), whole.t[-1]
        if not len(part):
            raise LogError(f"Expected rows of {path} from {low:g} to {high:g} s, got none: it ends at {last:.3f} s.")
        return part


WHOLE = Part()
"""All of a log."""
BESIDE = FigureFile()
"""A file beside the input."""


def torque_model(path: Path) -> TorqueModel:
    """Return the torque model of a file of `armlab identify`."""
    from armlab import models

    return models.load(path, "torque_model")


def arm_of(model: TorqueModel, robot: str | None) -> Robot:
    """Return the robot of a model."""
    from armlab import robots

    arm = robots.load(model.robot_name if robot is None else robot)
    model.check_robot(arm)
    return arm


def poses_in(table: Table, path: Path, column: str | None, robot: str | None) -> np.ndarray:
    """Return the poses of the tool (N, 4, 4).

    `column`: of poses; the usual ones when None.
    """
    from armlab import kinematics, robots
    from armlab.errors import LogError

    if robot is not None:
        return kinematics.forward(robots.load(robot), table["q"])
    name = column or next((name for name in POSES if name in table), None)
    if name is None:
        raise LogError(
            f"Expected poses of the tool in {path}, column {' or '.join(POSES)}, got {', '.join(table.names)}. "
            "Add --robot NAME, whose kinematics make them of q, or name their --column."
        )
    return table[name]


def joints_in(words: str, n: int) -> list[int]:
    """Return numbers of joints from 0."""
    from armlab.errors import ConfigError

    numbers = [int(word) if word.strip().isdecimal() else 0 for word in words.split(",")]
    if not all(1 <= number <= n for number in numbers):
        raise ConfigError(f"Expected joints as numbers from 1 to {n} with commas between, got {words!r}.")
    return [number - 1 for number in numbers]
