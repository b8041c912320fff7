"""Commands of ``armlab plot``, one per figure: logs, torque models, contact forces, fits, robots, primitives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

import armlab
from armlab.cli.plot.options import (
    BESIDE,
    OF_LOG,
    OF_MODEL,
    Estimate,
    FigureFile,
    FreeMotion,
    Joints,
    LogFigure,
    Model,
    ModelFigure,
    PoseColumn,
    PoseRobot,
    Primitive,
    RobotName,
    chosen_of,
    poses_in,
    torque_model,
)
from armlab.cli.support.options import joints_in, load_robot
from armlab.errors import ConfigError, LogError, ModelMismatchError, UnknownName


def table(log: Path, *columns: str, split: bool = False, figure: LogFigure = OF_LOG) -> int:
    """Plot columns of a log against time; commanded and sent values are dashed, and active limits are shaded.

    Parameters:
        log: Recording, or any file that `armlab log show` reads.
        columns: Names of the columns; default: q, qd, tau and wrench_hat if they are in the log.
        split: One panel per joint.
    """
    path = figure.path(log, "table")
    return figure.save(path, armlab.plots.table(figure.read(log), *columns, split=split))


def poses(log: Path, *, column: PoseColumn = None, robot: PoseRobot = None, figure: LogFigure = OF_LOG) -> int:
    """Plot the position and rotation vector of the tool against time.

    Parameters:
        log: Recording with poses, or with q if --robot is given.
    """
    path = figure.path(log, "poses")
    read = figure.read(log, robot)
    return figure.save(path, armlab.plots.poses(poses_in(read, log, column, robot), read.t))


def scene(
    *logs: Path,
    column: PoseColumn = None,
    robot: PoseRobot = None,
    cloud: list[Path] | None = None,
    plane: list[Path] | None = None,
    pose: list[Path] | None = None,
    frames: float = 0.0,
    figure: LogFigure = OF_LOG,
) -> int:
    """Draw tool paths, measured points, planes and frames in 3D.

    Parameters:
        logs: Recordings with poses, or with q if --robot is given. Each log is drawn as a path.
        cloud: File of points measured by a laser tracker.
        plane: File of a plane measured by a laser tracker.
        pose: MAT file that contains a frame, labelled with the file name.
        frames: Axis length of the frames drawn along paths [m]; 0 draws none.
    """
    from armlab.log import nikon

    sources = [*logs, *(cloud or ()), *(plane or ()), *(pose or ())]
    if not sources:
        raise ConfigError("Expected data to draw, got none. Pass logs, or --cloud, --plane or --pose with a file.")
    path = figure.path(sources[0], "scene")
    items: list[Any] = [poses_in(figure.read(log, robot), log, column, robot) for log in logs]
    items += [nikon.read_cloud(one).p for one in cloud or ()]
    items += [armlab.frames.Plane.of(read.normal, read.point) for read in map(nikon.read_plane, plane or ())]
    items += [{one.stem: nikon.read_matrix(one, project=True).T} for one in pose or ()]
    return figure.save(path, armlab.plots.scene(*items, frames=frames))


def latency(log: Path, *, figure: LogFigure = OF_LOG) -> int:
    """Plot histograms of the loop's response time, with missed and late ticks.

    Parameters:
        log: Recording of a run.
    """
    path = figure.path(log, "latency")
    read = figure.read(log)
    try:
        drawn = armlab.plots.latency(read)
    except UnknownName as error:  # a default column is missing
        raise LogError(str(error)) from error
    return figure.save(path, drawn)


def torque_fit(model: Model, log: FreeMotion, *, figure: ModelFigure = OF_MODEL) -> int:
    """Plot the measured and modelled torque of each joint, and the residual with its 2-sigma band."""
    path = figure.path(log, "torque_fit")
    return figure.save(path, armlab.plots.torque_fit(*figure.with_log(model, log)))


def friction(model: Model, log: FreeMotion | None = None, *, figure: ModelFigure = OF_MODEL) -> int:
    """Plot the friction of each joint against velocity with its uncertainty; log samples are drawn as points."""
    path = figure.path(model, "friction")
    fit = armlab.estimation.Fit.load(model, "torque_model")
    return figure.save(path, armlab.plots.friction(fit, None if log is None else figure.estimate(fit.value, log)))


def friction_map(model: Model, log: FreeMotion | None = None, *, joint: int, figure: ModelFigure = OF_MODEL) -> int:
    """Plot the friction of a joint against position and velocity; ranges without samples in the log are hatched.

    Parameters:
        joint: Joint number, from 1.
    """
    path = figure.path(model, f"friction_map_{joint}")
    known = torque_model(model)
    (number,) = joints_in(str(joint), known.n)
    table = None if log is None else figure.log_of(known, log)
    return figure.save(path, armlab.plots.friction_map(known, number, table))


def spectrum(model: Model, log: FreeMotion, *, joints: Joints = None, figure: ModelFigure = OF_MODEL) -> int:
    """Plot the torque residual against cycles per joint revolution, with and without the ripple model."""
    path = figure.path(log, "spectrum")
    known, drawn = chosen_of(model, joints)
    return figure.save(path, armlab.plots.spectrum(known, figure.log_of(known, log), drawn))


def velocity_covariance(model: Model, *, figure: FigureFile = BESIDE) -> int:
    """Plot the standard deviation of the torque error of each joint against its velocity."""
    path = figure.path(model, "velocity_covariance")
    return figure.save(path, armlab.plots.velocity_covariance(torque_model(model)))


def residual_speed(model: Model, log: FreeMotion, *, joints: Joints = None, figure: ModelFigure = OF_MODEL) -> int:
    """Plot the torque residual against velocity, with the 2-sigma curves of the model."""
    path = figure.path(log, "residual_speed")
    known, drawn = chosen_of(model, joints)
    residuals, covariances = figure.estimate(known, log), {"model": known.covariance}
    return figure.save(path, armlab.plots.residual_speed(residuals, covariances, drawn))


def autocorrelation(model: Model, log: FreeMotion, *, joints: Joints = None, figure: ModelFigure = OF_MODEL) -> int:
    """Plot the autocorrelation of the torque residual."""
    path = figure.path(log, "autocorrelation")
    known, drawn = chosen_of(model, joints)
    return figure.save(path, armlab.plots.autocorrelation(figure.estimate(known, log), drawn))


def wrench(log: Estimate, *, figure: LogFigure = OF_LOG) -> int:
    """Plot the estimated contact wrench with its 2-sigma band; contact intervals are shaded."""
    path = figure.path(log, "wrench")
    return figure.save(path, armlab.plots.wrench(figure.estimated(log)))


def wrenches(*logs: Path, figure: LogFigure = OF_LOG) -> int:
    """Plot the estimated forces of several arms side by side, on the same scale.

    Parameters:
        logs: Outputs of `armlab estimate`, or recordings with an estimate; one per arm.
    """
    if len({log.stem for log in logs}) < max(len(logs), 1):
        raise ConfigError(
            f"Expected logs with distinct names, one per arm, got {', '.join(map(str, logs)) or 'no log'}."
        )
    path = figure.path(logs[0], "wrenches")
    return figure.save(path, armlab.plots.wrenches({log.stem: figure.estimated(log) for log in logs}))


def observability(log: Estimate, *, figure: LogFigure = OF_LOG) -> int:
    """Plot the observability of each wrench axis; intervals with a weak axis are shaded."""
    path = figure.path(log, "observability")
    return figure.save(path, armlab.plots.observability(figure.estimated(log, "observability")))


def coverage(log: Path, *, model: Path | None = None, figure: ModelFigure = OF_MODEL) -> int:
    """Plot the fraction of wrench errors (with --model: of torque errors) within 2 sigma against speed.

    Parameters:
        log: Recording with an estimate and a force sensor; with --model, a recording of free motion.
        model: Model file written by `armlab identify`, to compare its torques with the log.
    """
    path = figure.path(log, "coverage")
    if model is not None:
        return figure.save(path, armlab.plots.coverage(armlab.identify.predict(*figure.with_log(model, log))))
    read = figure.read(log, figure.robot)
    if not {"wrench", "wrench_true"} & set(read.names):
        raise LogError(
            f"Expected a force sensor in {log}, column wrench, as a reference for the estimate, got no such column. "
            "Add --model MODEL to compare torques."
        )
    return figure.save(path, armlab.plots.coverage(read))


def hypotheses(
    model: Model, log: Annotated[Path, Parameter(help="Recording with contact.")], *, figure: ModelFigure = OF_MODEL
) -> int:
    """Plot the probabilities of the contact hypotheses: no contact, or contact at each location."""
    path = figure.path(log, "hypotheses")
    known = torque_model(model)
    believed = armlab.contact.hypotheses(figure.estimate(known, log), figure.robot_of(known))
    return figure.save(path, armlab.plots.hypotheses(believed))


def calibration(fit: Path, *, figure: FigureFile = BESIDE) -> int:
    """Plot the uncertainty of a calibration and the excitation of its samples.

    Parameters:
        fit: Result of `armlab calibrate`. The file contains no residuals; to draw residuals, use armlab calibrate
            --figure.
    """
    path = figure.path(fit, "calibration")
    found = armlab.estimation.Fit.load(fit)
    if isinstance(found.value, armlab.models.TorqueModel):
        raise ModelMismatchError(
            f"Expected a calibration file, got a torque model in {fit}. Use armlab plot torque_fit or friction."
        )
    return figure.save(path, armlab.plots.calibration(found))


def excitation(fit: Path, *, figure: FigureFile = BESIDE) -> int:
    """Plot the singular values of a fit, which show how well its samples determine the parameters.

    Parameters:
        fit: Result of `armlab identify` or `armlab calibrate`.
    """
    path = figure.path(fit, "excitation")
    return figure.save(path, armlab.plots.excitation(armlab.estimation.Fit.load(fit).excitation))


Posture = Annotated[Path | None, Parameter(help="Recording with joint positions q.")]


def robot(robot: RobotName, log: Posture = None, *, tool_path: bool = False, figure: LogFigure = OF_LOG) -> int:
    """Draw an arm as a stick figure in its home posture or along a log.

    Parameters:
        tool_path: Draw the tool path of the log.
    """
    path = figure.path(log or robot, "robot")
    return figure.save(path, armlab.plots.robot(load_robot(robot), figure.positions(log, robot), path=tool_path))


def workspace(robot: RobotName, *, figure: FigureFile = BESIDE) -> int:
    """Draw the workspace of an arm in side view, top view and 3D."""
    path = figure.path(robot, "workspace")
    return figure.save(path, armlab.plots.workspace(load_robot(robot)))


def manipulability(
    robot: RobotName,
    log: Posture = None,
    *,
    of: Literal["position", "rotation"] = "position",
    figure: LogFigure = OF_LOG,
) -> int:
    """Draw the velocity ellipsoid of the tool in the home posture or at up to eight configurations of a log.

    Parameters:
        of: position: velocity of the tool point. rotation: angular velocity of the tool.
    """
    path = figure.path(log or robot, "manipulability")
    return figure.save(path, armlab.plots.manipulability(load_robot(robot), figure.positions(log, robot), of))


def dmp(
    primitive: Primitive,
    *demos: Path,
    column: Annotated[str | None, Parameter(help="Column of the logs; default: q, or T_base_tool for poses.")] = None,
    robot: PoseRobot = None,
    figure: FigureFile = BESIDE,
) -> int:
    """Plot a movement primitive of any kind against time, with its demonstrations.

    Parameters:
        demos: Logs of the demonstrations, drawn without standstill; pass several logs for a distribution over motions.
    """
    from armlab.cli.dmp.teaching import MotionWindow, read_demonstration
    from armlab.motion import Dmp, PeriodicDmp, PoseDmp, ProMP, TwoDofDmp

    path = figure.path(primitive, "dmp")
    motion = armlab.models.load(primitive)
    motion = motion.dmp if isinstance(motion, TwoDofDmp) else motion
    if not isinstance(motion, Dmp | PoseDmp | PeriodicDmp | ProMP):
        raise ConfigError(f"Expected a movement-primitive file, got {primitive}. Choose another file.")
    kind = "pose" if isinstance(motion, PoseDmp) else "joints"
    columns = () if column is None else (column,)
    taught = [read_demonstration(log, kind, columns, robot, MotionWindow()) for log in demos]
    shown = [(demo.t, demo.y) for demo in taught]
    if isinstance(motion, ProMP):
        return figure.save(path, armlab.plots.promp(motion, shown))
    if len(shown) > 1:
        raise ConfigError(f"Expected one demonstration (except for promp), got {len(shown)}. Omit the others.")
    plots: Any = armlab.plots
    draw = {PoseDmp: plots.pose_dmp, PeriodicDmp: plots.periodic_dmp, Dmp: plots.dmp}[type(motion)]
    return figure.save(path, draw(motion, shown[0] if shown else None))


def dmp_phase(primitive: Primitive, *, figure: FigureFile = BESIDE) -> int:
    """Plot the phase plane of a joint-space movement primitive: velocity against position."""
    path = figure.path(primitive, "dmp_phase")
    return figure.save(path, armlab.plots.dmp_phase(armlab.motion.Dmp.load(primitive)))


def two_dof(
    primitive: Primitive,
    log: Path,
    *,
    disturbed: list[str] | None = None,
    joints: Joints = None,
    duration: float | None = None,
    goal: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    figure: FigureFile = BESIDE,
) -> int:
    """Plot the response of a movement primitive to a disturbance: arm, path, undisturbed motion and error.

    Parameters:
        log: Recording made by `armlab dmp play`.
        disturbed: Interval START,END of a disturbance [s], which is shaded.
        duration: Duration of the run [s]; default: duration of the demonstration.
        goal: Goal of the run, comma-separated; default: goal of the demonstration.
    """
    from armlab.cli.dmp.playing import numbers_in

    path = figure.path(log, "two_dof")
    motion = armlab.models.load(primitive)
    law = armlab.motion.TwoDofDmp(motion) if isinstance(motion, armlab.motion.Dmp) else motion
    if not isinstance(law, armlab.motion.TwoDofDmp):
        raise ConfigError(f"Expected a joint-space primitive in {primitive}, got a Cartesian one. Choose another file.")
    read = armlab.log.read(log)
    if "path_error" not in read:
        raise LogError(
            f"Expected a two-degree-of-freedom run in {log}, got a log "
            "without the columns of such a run. Record a run without --firm."
        )
    spans = [numbers_in(word, "disturbed") for word in disturbed or ()]
    if any(span is None or len(span) != 2 for span in spans):
        raise ConfigError(f"Expected --disturbed as START,END, got {' '.join(disturbed or ())}.")
    held = [(float(span[0]), float(span[1])) for span in spans if span is not None]
    run = law.recorded(read, held, duration=duration, g=numbers_in(goal, "goal"))
    return figure.save(path, armlab.plots.two_dof(run, None if joints is None else joints_in(joints, run.yc.shape[1])))
