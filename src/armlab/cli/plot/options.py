"""Options of ``armlab plot``: output file, log segment, joints, model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import armlab
from armlab.cli.support.options import Columns, OptionalOutput, joints_in, load_robot
from armlab.cli.support.output import FIGURES, check_output, result, save_figure
from armlab.errors import LogError

if TYPE_CHECKING:
    import numpy as np

    from armlab.log import Table
    from armlab.models import TorqueModel
    from armlab.robots import Robot

POSES = ("T_base_tool", "T_frame_tool")

Model = Annotated[Path, Parameter(help="Model file written by `armlab identify`.")]
FreeMotion = Annotated[Path, Parameter(help="Recording of free motion, preferably not used in the fit.")]
Estimate = Annotated[Path, Parameter(help="Output of `armlab estimate`, or a recording with an estimate.")]
RobotName = Annotated[str, Parameter(help="Library name or robot file.")]
PoseRobot = Annotated[str | None, Parameter(help="Library name or robot file, to compute the poses from q.")]
PoseColumn = Annotated[str | None, Parameter(help="Column of poses; default: T_base_tool or T_frame_tool.")]
Primitive = Annotated[Path, Parameter(help="Primitive file written by `armlab dmp fit`.")]
Joints = Annotated[str | None, Parameter(help="Comma-separated joint numbers from 1; default: all joints.")]


@Parameter(name="*")
@dataclass(frozen=True)
class FigureFile:
    """Output options of a figure.

    Attributes:
        output: PNG, SVG or PDF; default: in the folder of the input, named after the input and the figure.
        show: Also show the figure in a window.
        force: Replace an existing file, and accept a recording of another robot.
    """

    output: OptionalOutput = None
    show: bool = False
    force: bool = False

    def path(self, source: Path | str, name: str) -> Path:
        """Return the output path of a figure; raise an error if it is not writable."""
        beside = Path(source)
        path = beside.with_name(f"{beside.stem}_{name}.png") if self.output is None else self.output
        check_output(path, self.force, FIGURES)
        return path

    def save(self, path: Path, drawn: Any) -> int:
        """Write a figure, print its path, open a window if requested, and return the exit code."""
        save_figure(drawn, path)
        result(str(path))
        if self.show:
            from armlab.plots.style import show

            show()
        return 0


@Parameter(name="*")
@dataclass(frozen=True)
class LogPart:
    """Part of a log.

    Attributes:
        start: First time [s]; default: the beginning.
        end: Last time [s]; default: the end.
        arm: Arm to select from a recording of several arms.
        where: Column names in a file from another program; see armlab log export.
    """

    start: float | None = None
    end: float | None = None
    arm: str | None = None
    where: Annotated[Columns, Parameter(name="--columns")] = None

    def read(self, path: Path, robot: str | None = None, model: TorqueModel | None = None) -> Table:
        """Return the selected part of a log; reject a recording of a robot other than the given or modelled robot."""
        from armlab.cli.support.log_input import check_log
        from armlab.log.topics.reader import is_foreign, read_joints

        if robot is not None and is_foreign(path):
            whole = read_joints(path, load_robot(robot))
        else:
            if model is not None or robot is not None:
                check_log(path, load_robot(robot or "") if model is None else model, getattr(self, "force", False))
            whole = armlab.log.read(path, self.where, robot=self.arm)
        low, high = (-math.inf if self.start is None else self.start), (math.inf if self.end is None else self.end)
        if not len(whole):
            raise LogError(f"Expected rows in {path}, got an empty log. Choose another log.")
        part, last = whole.between(low, high), whole.t[-1]
        if not len(part):
            raise LogError(
                f"Expected rows of {path} from {low:g} to {high:g} s, "
                f"got no rows: the log ends at {last:.3f} s. Correct --start or --end."
            )
        return part

    def estimated(self, path: Path, column: str = "wrench_hat") -> Table:
        """Return the selected part of a log with an estimated wrench."""
        read = self.read(path)
        if column not in read:
            raise LogError(
                f"Expected an estimated wrench in {path}, column {column}, got {', '.join(read.names)}. "
                "Create an estimate: armlab estimate ROBOT LOG --model MODEL -o force.mcap."
            )
        return read

    def positions(self, path: Path | None, robot: str) -> np.ndarray | None:
        """Return the complete joint positions (N, n) in the selected part of a log; None without a log."""
        import numpy as np

        if path is None:
            return None
        q = self.read(path, robot)["q"]
        return q[np.isfinite(q).all(axis=1)]


@Parameter(name="*")
@dataclass(frozen=True)
class LogFigure(LogPart, FigureFile):
    """Options of log figures."""


@Parameter(name="*")
@dataclass(frozen=True)
class ModelFigure(LogFigure):
    """Options of figures that show a torque model with a log."""

    robot: Annotated[str | None, Parameter(help="Robot file, if the model's robot is not in the library.")] = None

    def robot_of(self, model: TorqueModel) -> Robot:
        arm = load_robot(model.robot_name if self.robot is None else self.robot)
        model.check_robot(arm)
        return arm

    def log_of(self, model: TorqueModel, log: Path) -> Table:
        """Return the selected part of a log, with its joints in the order of the model's robot."""
        if self.robot is not None:
            self.robot_of(model)  # raises an error for another robot
        return self.read(log, self.robot or model.robot_name, model)

    def estimate(self, model: TorqueModel, log: Path) -> Table:
        return armlab.contact.Estimator(model, self.robot_of(model)).run(self.log_of(model, log))

    def with_log(self, model: Path, log: Path) -> tuple[TorqueModel, Table]:
        """Load a torque model and the selected part of a log."""
        known = torque_model(model)
        return known, self.log_of(known, log)


BESIDE = FigureFile()
OF_LOG = LogFigure()
OF_MODEL = ModelFigure()


def torque_model(path: Path) -> TorqueModel:
    return armlab.models.load(path, "torque_model")


def chosen_of(model: Path, joints: str | None) -> tuple[TorqueModel, list[int] | None]:
    known = torque_model(model)
    return known, None if joints is None else joints_in(joints, known.n)


def poses_in(table: Table, path: Path, column: str | None, robot: str | None) -> np.ndarray:
    """Return the tool poses (N, 4, 4): computed from q with a robot, otherwise from the given or default column."""
    if robot is not None:
        return armlab.kinematics.forward(load_robot(robot), table["q"])
    name = column or next((name for name in POSES if name in table), None)
    if name is None:
        raise LogError(
            f"Expected tool poses in {path}, column {' or '.join(POSES)}, got {', '.join(table.names)}. "
            "Add --robot NAME to compute the poses from q, or select their column with --column."
        )
    return table[name]
