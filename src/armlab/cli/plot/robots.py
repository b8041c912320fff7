"""Figures of robots and of movement primitives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from armlab.cli.support.figure_options import BESIDE, WHOLE, FigureFile, Joints, Part, joints_in

if TYPE_CHECKING:
    import numpy as np

    from armlab.log import Table


def robot(
    robot: str, log: Path | None = None, *, tool_path: bool = False, part: Part = WHOLE, picture: FigureFile = BESIDE
) -> int:
    """Draw an arm as a stick figure: at home, or through a log, its end in full.

    Parameters
    ----------
    robot : str
        Name in the library, or robot file.
    log : Path
        Recording with q.
    tool_path : bool
        Draw the path of the tool through the log.
    """
    from armlab import plots, robots

    path = picture.path(robot if log is None else log, "robot")
    return picture.save(plots.robot(robots.load(robot), _positions(log, robot, part), path=tool_path), path)


def workspace(robot: str, *, picture: FigureFile = BESIDE) -> int:
    """Draw where the tool of an arm can be: from the side, from above, in space.

    Parameters
    ----------
    robot : str
        Name in the library, or robot file.
    """
    from armlab import plots, robots

    path = picture.path(robot, "workspace")
    return picture.save(plots.workspace(robots.load(robot)), path)


def manipulability(
    robot: str,
    log: Path | None = None,
    *,
    of: Literal["position", "rotation"] = "position",
    part: Part = WHOLE,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw how fast the tool can move in which direction: at home, or at up to eight places of a log.

    Parameters
    ----------
    robot : str
        Name in the library, or robot file.
    log : Path
        Recording with q.
    of : str
        position: velocity of the tool point. rotation: its angular velocity.
    """
    from armlab import plots, robots

    path = picture.path(robot if log is None else log, "manipulability")
    return picture.save(plots.manipulability(robots.load(robot), _positions(log, robot, part), of), path)


def _positions(log: Path | None, robot: str, part: Part) -> np.ndarray | None:
    """Return the joint positions (N, n) of a robot in a log, rows in which none is missing."""
    import numpy as np

    if log is None:
        return None
    q = part.read(log, robot)["q"]
    return q[np.isfinite(q).all(axis=1)]


def dmp(
    primitive: Path,
    *demos: Path,
    column: str | None = None,
    robot: str | None = None,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw a movement primitive of any kind over time, and the demonstrations that it was taught.

    Parameters
    ----------
    primitive : Path
        File of `armlab dmp fit`.
    demos : tuple of Path
        Logs of what it was taught, of the motion only; several for a distribution over motions.
    column : str
        What moved in those logs: q when not given, T_base_tool for poses.
    robot : str
        For poses: name in the library or robot file, whose kinematics make them of q.
    """
    from armlab import models, plots
    from armlab.cli.dmp.teaching import Window, read_demonstration
    from armlab.errors import ConfigError
    from armlab.motion import Dmp, PeriodicDmp, PoseDmp, ProMP, TwoDofDmp

    path = picture.path(primitive, "dmp")
    motion = models.load(primitive)
    motion = motion.dmp if isinstance(motion, TwoDofDmp) else motion
    if not isinstance(motion, Dmp | PoseDmp | PeriodicDmp | ProMP):
        raise ConfigError(f"Expected the file of a movement primitive, got another in {primitive}. Name the right one.")
    kind = "pose" if isinstance(motion, PoseDmp) else "joints"
    columns = () if column is None else (column,)
    taught = [read_demonstration(log, kind, columns, robot, Window()) for log in demos]
    shown = [(demo.t, demo.y) for demo in taught]
    if isinstance(motion, ProMP):
        return picture.save(plots.promp(motion, shown), path)
    if len(shown) > 1:
        raise ConfigError(f"Expected one demonstration of a primitive that is no distribution, got {len(shown)}.")
    demo = shown[0] if shown else None
    if isinstance(motion, PoseDmp):
        return picture.save(plots.pose_dmp(motion, demo), path)
    drawn = plots.periodic_dmp(motion, demo) if isinstance(motion, PeriodicDmp) else plots.dmp(motion, demo)
    return picture.save(drawn, path)


def dmp_phase(primitive: Path, *, picture: FigureFile = BESIDE) -> int:
    """Draw the phase plane of a movement primitive of joints: velocity over position.

    Parameters
    ----------
    primitive : Path
        File of `armlab dmp fit`.
    """
    from armlab import plots
    from armlab.motion import Dmp

    path = picture.path(primitive, "dmp_phase")
    return picture.save(plots.dmp_phase(Dmp.load(primitive)), path)


def two_dof(
    primitive: Path,
    log: Path,
    *,
    disturbed: list[str] | None = None,
    joints: Joints = None,
    duration: float | None = None,
    goal: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw how a movement primitive waited for an arm that was held: arm, path, undisturbed motion, error.

    Parameters
    ----------
    primitive : Path
        File of `armlab dmp fit`, or of a primitive with two degrees of freedom.
    log : Path
        Recording of `armlab dmp play`.
    disturbed : list of str
        START,END of a time when something held the arm [s], which is shaded.
    duration : float
        Of the run [s]; that of the demonstration when not given.
    goal : str
        Of the run, numbers with commas between; that of the demonstration when not given.
    """
    from armlab import log as logs
    from armlab import models, plots
    from armlab.cli.dmp.playing import numbers_in
    from armlab.errors import ConfigError, LogError
    from armlab.motion import Dmp, TwoDofDmp

    path = picture.path(log, "two_dof")
    motion = models.load(primitive)
    law = TwoDofDmp(motion) if isinstance(motion, Dmp) else motion
    if not isinstance(law, TwoDofDmp):
        raise ConfigError(f"Expected a primitive of joints, got another kind in {primitive}. Name the right file.")
    table: Table = logs.read(log)
    if "path_error" not in table:
        raise LogError(f"Expected a run that waits for its arm in {log}, got none. Record it without --firm.")
    spans = [numbers_in(word, "disturbed") for word in disturbed or ()]
    if any(span is None or len(span) != 2 for span in spans):
        raise ConfigError(f"Expected --disturbed as START,END, got {' '.join(disturbed or ())}.")
    held = [(float(span[0]), float(span[1])) for span in spans if span is not None]
    run = law.recorded(table, held, duration=duration, g=numbers_in(goal, "goal"))
    which = None if joints is None else joints_in(joints, run.yc.shape[1])
    return picture.save(plots.two_dof(run, which), path)
