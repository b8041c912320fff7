"""What an identified torque model leaves of a log: the ground that further parts of the drives are fitted on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab.errors import ModelMismatchError
from armlab.identify.preparation import Prepared, prepare
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import Robot, from_links

__all__ = ["Residuals", "friction_signs", "model_residuals"]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a model along logs.

    Attributes
    ----------
    data : the record. y : (N, n) measured minus modelled torque [N m], over the gains, unfiltered.
    s : (N, n) the sign that friction goes by: presliding state, or the smooth sign.
    """

    data: Prepared
    y: np.ndarray
    s: np.ndarray


def model_residuals(
    table: Table | Sequence[Table],
    model: TorqueModel,
    joints: Sequence[int] | None = None,
    robot: Robot | None = None,
) -> Residuals:
    """Return measured minus modelled torque of every row; the acceleration is low-passed at a tenth of the rate.

    Parameters
    ----------
    table : one log or several, of free motion, with columns q, qd, tau.
    model : of the arm that was logged.
    joints : numbers, from 0, of those that must move; all when left out.
    robot : the arm; its limits and gears, which the model does not know, tell a log in other units.

    Raises
    ------
    ShapeError, NotExcited : logs that `prepare` refuses.
    """
    if not isinstance(model, TorqueModel):
        raise ModelMismatchError.no_model(model)
    if robot is None:
        names = [f"joint {i + 1}" for i in range(model.n)]
        robot = from_links(model.robot_name, model.frames, model.prismatic, gravity=model.gravity, joint_names=names)
    data = prepare(table, robot, joints)
    qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
    y = np.empty_like(data.q)
    for a, b in data.segments:
        left = data.tau[a:b] - model.torque(data.q[a:b], data.qd[a:b], qdd[a:b], data.dt[a:b])
        y[a:b] = left / model.gains
    return Residuals(data, y, friction_signs(model, data))


def friction_signs(model: TorqueModel, data: Prepared) -> np.ndarray:
    """Return the sign (N, n) that friction goes by: the presliding state, or the smooth sign where a joint has one.

    Parameters
    ----------
    model : of the arm. data : the record.
    """
    smooth, s = model.friction.smooth_speed, np.empty_like(data.q)
    for a, b in data.segments:
        s[a:b] = presliding(data.q[a:b], model.friction.delta, model.friction.resolution)
    return np.where(smooth > 0, np.tanh(data.qd / np.where(smooth > 0, smooth, 1.0)), s)
