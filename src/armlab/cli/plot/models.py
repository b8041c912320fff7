"""Figures of torque models, their residuals, and fits."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from armlab.cli.support.figure_options import (
    BESIDE,
    WHOLE,
    FigureFile,
    Joints,
    OwnRobot,
    Part,
    arm_of,
    joints_in,
    torque_model,
)

if TYPE_CHECKING:
    from armlab.log import Table
    from armlab.models import TorqueModel


def torque_fit(
    model: Path, log: Path, *, robot: OwnRobot = None, part: Part = WHOLE, picture: FigureFile = BESIDE
) -> int:
    """Draw measured and modelled torque of each joint, and the residual with its 2-sigma band.

    Parameters
    ----------
    model : Path
        Model file of `armlab identify`.
    log : Path
        Recording of free motion, best one that was not fitted.
    """
    from armlab import plots

    path = picture.path(log, "torque_fit")
    known = torque_model(model)
    return picture.save(plots.torque_fit(known, _log_of(known, robot, log, part)), path)


def friction(
    model: Path,
    log: Path | None = None,
    *,
    robot: OwnRobot = None,
    part: Part = WHOLE,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw the friction of each joint over its velocity, and what is not known of it.

    Parameters
    ----------
    model : Path
        Model file of `armlab identify`.
    log : Path
        Recording of free motion, drawn as points.
    """
    from armlab import plots
    from armlab.estimation import Fit

    path = picture.path(model, "friction")
    fit = Fit.load(model, "torque_model")
    points = None if log is None else _estimate(fit.value, robot, log, part)
    return picture.save(plots.friction(fit, points), path)


def friction_map(
    model: Path,
    log: Path | None = None,
    *,
    joint: int,
    robot: OwnRobot = None,
    part: Part = WHOLE,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw the friction of one joint over position and velocity; what the log leaves open is hatched.

    Parameters
    ----------
    model : Path
        Model file of `armlab identify`.
    log : Path
        What the model was fitted to.
    joint : int
        Number from 1.
    """
    from armlab import plots

    path = picture.path(model, f"friction_map_{joint}")
    known = torque_model(model)
    (number,) = joints_in(str(joint), known.n)
    covered = None if log is None else _log_of(known, robot, log, part)
    return picture.save(plots.friction_map(known, number, covered), path)


def spectrum(
    model: Path,
    log: Path,
    *,
    joints: Joints = None,
    robot: OwnRobot = None,
    part: Part = WHOLE,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw what is left of the torque over cycles per turn, without and with the ripple that the model has.

    Parameters
    ----------
    model : Path
        Model file of `armlab identify`.
    log : Path
        Recording of free motion.
    """
    from armlab import plots

    path = picture.path(log, "spectrum")
    known = torque_model(model)
    drawn = None if joints is None else joints_in(joints, known.n)
    return picture.save(plots.spectrum(known, _log_of(known, robot, log, part), drawn), path)


def velocity_covariance(model: Path, *, picture: FigureFile = BESIDE) -> int:
    """Draw the standard deviation of the torque error of each joint over its velocity.

    Parameters
    ----------
    model : Path
        Model file of `armlab identify`.
    """
    from armlab import plots

    path = picture.path(model, "velocity_covariance")
    return picture.save(plots.velocity_covariance(torque_model(model)), path)


def residual_speed(
    model: Path,
    log: Path,
    *,
    joints: Joints = None,
    robot: OwnRobot = None,
    part: Part = WHOLE,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw what is left of the torque over velocity, with the 2-sigma curves of the model.

    Parameters
    ----------
    model : Path
        Model file of `armlab identify`.
    log : Path
        Recording of free motion.
    """
    from armlab import plots

    path = picture.path(log, "residual_speed")
    known = torque_model(model)
    drawn = None if joints is None else joints_in(joints, known.n)
    left = _estimate(known, robot, log, part)
    return picture.save(plots.residual_speed(left, {"model": known.covariance}, drawn), path)


def autocorrelation(
    model: Path,
    log: Path,
    *,
    joints: Joints = None,
    robot: OwnRobot = None,
    part: Part = WHOLE,
    picture: FigureFile = BESIDE,
) -> int:
    """Draw how long the residual of the torque remembers.

    Parameters
    ----------
    model : Path
        Model file of `armlab identify`.
    log : Path
        Recording of free motion.
    """
    from armlab import plots

    path = picture.path(log, "autocorrelation")
    known = torque_model(model)
    drawn = None if joints is None else joints_in(joints, known.n)
    left = _estimate(known, robot, log, part)
    return picture.save(plots.autocorrelation(left, drawn), path)


def coverage(
    log: Path, *, model: Path | None = None, robot: OwnRobot = None, part: Part = WHOLE, picture: FigureFile = BESIDE
) -> int:
    """Draw how many errors are inside 2 sigma, by speed: of the wrench against a sensor, of torques with --model.

    Parameters
    ----------
    log : Path
        Recording of a run that estimated, with a force sensor; or of free motion, with --model.
    model : Path
        Model file of `armlab identify`, whose torques are compared with those of the log.
    """
    from armlab import plots
    from armlab.errors import LogError
    from armlab.identify import predict

    path = picture.path(log, "coverage")
    known = None if model is None else torque_model(model)
    read = part.read(log, robot) if known is None else _log_of(known, robot, log, part)
    if known is None and not {"wrench", "wrench_true"} & set(read.names):
        raise LogError(
            f"Expected a force sensor in {log}, column wrench, to compare the estimate with, got none. "
            "Add --model MODEL to compare torques."
        )
    return picture.save(plots.coverage(read if known is None else predict(known, read)), path)


def hypotheses(
    model: Path, log: Path, *, robot: OwnRobot = None, part: Part = WHOLE, picture: FigureFile = BESIDE
) -> int:
    """Draw how probable it is that there is a contact, and where.

    Parameters
    ----------
    model : Path
        Model file of `armlab identify`.
    log : Path
        Recording with contact.
    """
    from armlab import contact, plots

    path = picture.path(log, "hypotheses")
    known = torque_model(model)
    arm = arm_of(known, robot)
    return picture.save(plots.hypotheses(contact.hypotheses(_estimate(known, robot, log, part), arm)), path)


def calibration(fit: Path, *, picture: FigureFile = BESIDE) -> int:
    """Draw how far a calibration may be off, and what its samples could tell.

    Parameters
    ----------
    fit : Path
        File of `armlab calibrate`; that command draws the residuals too, with --figure, for files keep none.
    """
    from armlab import plots
    from armlab.errors import ModelMismatchError
    from armlab.estimation import Fit
    from armlab.models import TorqueModel

    path = picture.path(fit, "calibration")
    found = Fit.load(fit)
    if isinstance(found.value, TorqueModel):
        raise ModelMismatchError(
            f"Expected the file of a calibration, got a torque model in {fit}. Draw its torque_fit or its friction."
        )
    return picture.save(plots.calibration(found), path)


def excitation(fit: Path, *, picture: FigureFile = BESIDE) -> int:
    """Draw how well the samples of a fit told its parameters apart.

    Parameters
    ----------
    fit : Path
        File of `armlab identify` or `armlab calibrate`.
    """
    from armlab import plots
    from armlab.estimation import Fit

    path = picture.path(fit, "excitation")
    return picture.save(plots.excitation(Fit.load(fit).excitation), path)


def _log_of(model: TorqueModel, robot: str | None, log: Path, part: Part) -> Table:
    """Return that part of a log, the joints of another program's in the order of the model's robot."""
    if robot is not None:
        arm_of(model, robot)  # refuses another
    return part.read(log, robot or model.robot_name)


def _estimate(model: TorqueModel, robot: str | None, log: Path, part: Part) -> Table:
    """Return that part of a log with what the estimator makes of it."""
    from armlab.contact import Estimator

    return Estimator(model, arm_of(model, robot)).run(_log_of(model, robot, log, part))
