"""Evaluation of a torque model on a log: residuals, friction sign, and thermal state of the drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from armlab.errors import ModelMismatchError
from armlab.identify.record import Record, prepare, prepare_share, resting
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import Robot, from_links


@dataclass(frozen=True, eq=False)
class ModelResiduals:
    """Residuals of a model along logs.

    `y`: (N, n) measured minus modelled torque [N m], divided by the gains, unfiltered. `s`: (N, n) friction sign: the
    presliding state, or the smooth sign.
    """

    data: Record
    y: np.ndarray
    s: np.ndarray


def model_residuals(
    table: Table | Sequence[Table],
    model: TorqueModel,
    joints: Sequence[int] | None = None,
    robot: Robot | None = None,
) -> ModelResiduals:
    """Return measured minus modelled torque of logs; the acceleration is low-passed at a tenth of the rate.

    Joints may be at rest in these logs.
    """
    if not isinstance(model, TorqueModel):
        raise ModelMismatchError.no_model(model)
    if robot is None:
        names = [f"joint {i + 1}" for i in range(model.n)]
        robot = from_links(model.robot_name, model.frames, model.prismatic, gravity=model.gravity, joint_names=names)
    data = prepare_share(table, robot, joints)
    if resting(data.q, robot.prismatic).all():
        data = prepare(table, robot, joints)  # raises
    qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
    y = np.empty_like(data.q)
    for a, b in data.segments:
        left = data.tau[a:b] - model.torque(data.q[a:b], data.qd[a:b], qdd[a:b], data.dt[a:b])
        y[a:b] = left / model.gains
    return ModelResiduals(data, y, friction_signs(model, data))


def friction_signs(model: TorqueModel, data: Record) -> np.ndarray:
    """Return the friction sign (N, n): the presliding state, or the smooth sign for joints that use it."""
    smooth, s = model.friction.smooth_speed, np.empty_like(data.q)
    for a, b in data.segments:
        s[a:b] = presliding(data.q[a:b], model.friction.delta, model.friction.resolution)
    return np.where(smooth > 0, np.tanh(data.qd / np.where(smooth > 0, smooth, 1.0)), s)


def load_torque(model: TorqueModel, data: Record) -> np.ndarray:
    """Return the torque (N, n) transmitted to the links along a record, using the low-passed acceleration."""
    qdd = data.filter(data.differentiate(data.qd), data.rate / 10.0)
    return model.chain.rnea(data.q, data.qd, qdd, *model._weights)


# Thermal state of the drives of a model along a record, per second (law: models.friction.WarmUp).
#
# The thermal state is constant within each second, so only per-second sums of a record are stored.


BIN = 1.0  # s, duration of a bin
SETTLING = 8  # fixed-point iterations between power and thermal state
FEWEST_SECONDS = 20  # rows needed in a second to determine its power


def thermal_state_at(model: TorqueModel, data: Record, rows: np.ndarray) -> np.ndarray:
    """Return the thermal state (M, n) at rows (M,) of a record; every log begins in the initial state stored in the
    model."""
    warm, f, s = model.warm_up, model.friction, friction_signs(model, data)
    if warm is None:
        return np.zeros((len(rows), model.n))
    x = np.tile(warm.start, (len(rows), 1))
    logs = [0, *(np.flatnonzero(np.diff(data.t) <= 0) + 1), len(data.t)]
    for a, b in pairwise(logs):
        some, here = slice(a, b, max(1, int(data.rate * BIN) // FEWEST_SECONDS)), (rows >= a) & (rows < b)
        for i in np.flatnonzero(warm.time > 0):
            power = mean_power(model, i, data.qd[some, i], s[some, i], seconds(data.t[some]))
            k = np.array([f.viscous[i], 0.0, 0.0, 0.0, f.viscous[i] * warm.of_viscous[i], warm.of_coulomb[i]])
            along = settled(power, k, float(warm.time[i]), float(warm.start[i]), float(warm.power[i]))
            middle = BIN * (np.arange(len(along)) + 0.5)
            x[here, i] = np.interp(data.t[rows[here]] - data.t[a], [0.0, *middle], [warm.start[i], *along])
    return x


def seconds(t: np.ndarray) -> np.ndarray:
    """Return the second (N,), counted from 0, of each row at times t (N,)."""
    return ((t - t[0]) / BIN).astype(int)


def dry_torques(model: TorqueModel, i: int | np.intp, qd: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cold Coulomb torque (N,) of joint i, and the Stribeck and root terms (N,)."""
    f = model.friction
    c = f.coulomb_pos[i] * np.maximum(s, 0) + f.coulomb_neg[i] * np.minimum(s, 0)
    rest = f.stribeck[i] * s * np.exp(-((qd / f.stribeck_speed[i]) ** 2)) + f.root[i] * s * np.sqrt(np.abs(qd))
    return c, rest


def mean_power(model: TorqueModel, i: int | np.intp, qd: np.ndarray, s: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the means (B, 3) of ``qd qd``, ``c qd`` and ``rest qd`` over each second; 0 for seconds without rows."""
    c, rest = dry_torques(model, i, qd, s)
    sums = [np.bincount(number, weights=torque * qd) for torque in (qd, c, rest)]
    return np.stack(sums, axis=1) / np.maximum(np.bincount(number), 1)[:, None]


def relaxed(heat: np.ndarray, time: float, start: float) -> np.ndarray:
    """Return x (B,) at the middle of each second for a heat input (B,) = power / reference and a time constant [s]."""
    from scipy.signal import lfilter

    keep = float(np.exp(-BIN / time))
    x = lfilter([0.0, 1.0 - keep], [1.0, -keep], heat)
    x = np.asarray(x) + start * keep ** np.arange(len(heat))  # at the start of the second
    return 0.5 * (1.0 + keep) * x + 0.5 * (1.0 - keep) * heat


def settled(power: np.ndarray, k: np.ndarray, time: float, start: float, reference: float) -> np.ndarray:
    """Return the thermal state x (B,) of a joint, which depends on its friction power."""
    x = np.zeros(len(power))
    for _ in range(SETTLING):
        heat = (k[0] + k[4] * x) * power[:, 0] + (1 + k[5] * x) * power[:, 1] + power[:, 2]
        x = relaxed(np.abs(heat) / reference, time, start)
    return x
