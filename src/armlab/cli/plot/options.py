"""Options of ``armlab plot``: output file, part of a log, joints, model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import armlab
from armlab.cli.support.options import joints_in
from armlab.cli.support.output import FIGURES, check_output, result, save_figure
from armlab.errors import LogError

if TYPE_CHECKING:
    import numpy as np

    from armlab.log import Table
    from armlab.models import TorqueModel
    from armlab.robots import Robot


POSES = ("T_base_tool", "T_frame_tool")

Model = Annotated[Path, Parameter(help="Model file of `armlab identify`.")]
FreeMotion = Annotated[Path, Parameter(help="Recording of free motion, preferably not used in the fit.")]
Estimate = Annotated[Path, Parameter(help="Output of `armlab estimate`, or recording of a run that estimated.")]
RobotName = Annotated[str, Parameter(help="Name in the library, or robot file.")]
PoseRobot = Annotated[str | None, Parameter(help="Name in the library or robot file: computes the poses from q.")]
PoseColumn = Annotated[str | None, Parameter(help="Column of poses; default: T_base_tool or T_frame_tool.")]
Primitive = Annotated[Path, Parameter(help="File of `armlab dmp fit`.")]
Joints = Annotated[str | None, Parameter(help="Numbers from 1 with commas between; default: all.")]


@Parameter(name="*")
@dataclass(frozen=True)
class FigureFile:
    """Where the figure goes.

    Attributes:
        output: PNG, SVG or PDF; default: beside the input, with its name and that of the figure.
        show: Open a window too.
        force: Replace an existing file.
    """

    output: Annotated[Path | None, Parameter(alias="-o")] = None
    show: bool = False
    force: bool = False

    def path(self, source: Path | str, name: str) -> Path:
        """Return where a figure of a source goes; refuse, before it is drawn, a file that cannot be written."""
        beside = Path(source)
        path = beside.with_name(f"{beside.stem}_{name}.png") if self.output is None else self.output
        check_output(path, self.force, FIGURES)
        return path

    def save(self, path: Path, drawn: Any) -> int:
        """Write a figure, print its path, open a window if asked; return the exit code."""
        save_figure(drawn, path)
        result(str(path))
        if self.show:
            from armlab.plots.style import show

            show()
        return 0


@Parameter(name="*")
@dataclass(frozen=True)
class LogPart:
    """Which part of a log.

    Attributes:
        start: First time [s]; default: the beginning.
        end: Last time [s]; default: the end.
        arm: Arm whose rows are read, of a recording of several.
    """

    start: float | None = None
    end: float | None = None
    arm: str | None = None

    def read(self, path: Path, robot: str | None = None) -> Table:
        """Return that part of a log."""
        from armlab.log.topics.reader import is_foreign, read_joints

        if robot is not None and is_foreign(path):
            whole = read_joints(path, armlab.robots.load(robot))
        else:
            whole = armlab.log.read(path, robot=self.arm)
        low, high = (-math.inf if self.start is None else self.start), (math.inf if self.end is None else self.end)
        if not len(whole):
            raise LogError(f"Expected rows in {path}, got a log without any. Nothing was recorded.")
        part, last = whole.between(low, high), whole.t[-1]
        if not len(part):
            raise LogError(f"Expected rows of {path} from {low:g} to {high:g} s, got none: it ends at {last:.3f} s.")
        return part

    def estimated(self, path: Path, column: str = "wrench_hat") -> Table:
        """Return that part of a log in which a wrench was estimated."""
        read = self.read(path)
        if column not in read:
            raise LogError(
                f"Expected an estimated wrench in {path}, column {column}, got {', '.join(read.names)}. "
                "Make one: armlab estimate ROBOT LOG --model MODEL -o force.mcap."
            )
        return read

    def positions(self, path: Path | None, robot: str) -> np.ndarray | None:
        """Return the joint positions (N, n) of that part, rows in which none is missing; None without a log."""
        import numpy as np

        if path is None:
            return None
        q = self.read(path, robot)["q"]
        return q[np.isfinite(q).all(axis=1)]


@Parameter(name="*")
@dataclass(frozen=True)
class LogFigure(LogPart, FigureFile):
    """A figure of a part of a log."""


@Parameter(name="*")
@dataclass(frozen=True)
class ModelFigure(LogFigure):
    """A figure of a torque model, and of a part of a log."""

    robot: Annotated[str | None, Parameter(help="Robot file, where the robot of the model is not in the library.")] = (
        None
    )

    def robot_of(self, model: TorqueModel) -> Robot:
        arm = armlab.robots.load(model.robot_name if self.robot is None else self.robot)
        model.check_robot(arm)
        return arm

    def log_of(self, model: TorqueModel, log: Path) -> Table:
        """Return that part of a log, the joints of another program's in the order of the model's robot."""
        if self.robot is not None:
            self.robot_of(model)  # refuses another
        return self.read(log, self.robot or model.robot_name)

    def estimate(self, model: TorqueModel, log: Path) -> Table:
        return armlab.contact.Estimator(model, self.robot_of(model)).run(self.log_of(model, log))

    def with_log(self, model: Path, log: Path) -> tuple[TorqueModel, Table]:
        """Return the torque model of a file, and that part of a log."""
        known = torque_model(model)
        return known, self.log_of(known, log)


BESIDE = FigureFile()
OF_LOG = LogFigure()
OF_MODEL = ModelFigure()


def torque_model(path: Path) -> TorqueModel:
    return armlab.models.load(path, "torque_model")


def chosen_of(model: Path, joints: str | None) -> tuple[TorqueModel, list[int] | None]:
    """Return the torque model of a file, and which of its joints to draw."""
    known = torque_model(model)
    return known, None if joints is None else joints_in(joints, known.n)


def poses_in(table: Table, path: Path, column: str | None, robot: str | None) -> np.ndarray:
    """Return the poses of the tool (N, 4, 4): of a robot, of a column, or of the usual ones."""
    if robot is not None:
        return armlab.kinematics.forward(armlab.robots.load(robot), table["q"])
    name = column or next((name for name in POSES if name in table), None)
    if name is None:
        raise LogError(
            f"Expected poses of the tool in {path}, column {' or '.join(POSES)}, got {', '.join(table.names)}. "
            "Add --robot NAME, whose kinematics make them of q, or name their --column."
        )
    return table[name]
