"""How warm the drives of a model are along a record, second by second (models.WarmUp has the law).

Warmth is taken as constant over a second, so that sums over seconds are all that is kept of a record.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from armlab.identify.preparation import Prepared
from armlab.identify.residuals import friction_signs
from armlab.models import TorqueModel

__all__ = ["BIN", "begun", "dry_torques", "mean_power", "relaxed", "seconds", "settled"]

BIN = 1.0  # s
SETTLING = 8  # rounds of power and warmth for given parameters
FEWEST = 20  # rows of a second that tell its power


def begun(
    model: TorqueModel, data: Prepared, pieces: Iterable[tuple[int, int]]
) -> Iterator[tuple[TorqueModel, int, int]]:
    """Yield a model for each piece of a record, which begins as warm as the record before has made it, and the piece.

    Parameters
    ----------
    model : of the arm. data : the record. pieces : (start, stop) rows.
    """
    listed = list(pieces)
    if model.warm_up is None:
        yield from ((model, a, b) for a, b in listed)
        return
    warmth = _warmth_at(model, data, np.array([a for a, _ in listed], dtype=int))
    for (a, b), start in zip(listed, warmth):
        yield replace(model, warm_up=replace(model.warm_up, start=start)), a, b


def _warmth_at(model: TorqueModel, data: Prepared, rows: np.ndarray) -> np.ndarray:
    """Return the warmth (M, n) at rows (M,) of a record; every log in it begins with that of the model."""
    warm, f, s = model.warm_up, model.friction, friction_signs(model, data)
    if warm is None:
        return np.zeros((len(rows), model.n))
    x = np.tile(warm.start, (len(rows), 1))
    logs = [0, *(np.flatnonzero(np.diff(data.t) <= 0) + 1), len(data.t)]
    for a, b in pairwise(logs):
        some, here = slice(a, b, max(1, int(data.rate * BIN) // FEWEST)), (rows >= a) & (rows < b)
        for i in np.flatnonzero(warm.time > 0):
            power = mean_power(model, i, data.qd[some, i], s[some, i], seconds(data.t[some]))
            k = np.array([f.viscous[i], 0.0, 0.0, 0.0, f.viscous[i] * warm.of_viscous[i], warm.of_coulomb[i]])
            along = settled(power, k, float(warm.time[i]), float(warm.start[i]), float(warm.power[i]))
            middle = BIN * (np.arange(len(along)) + 0.5)
            x[here, i] = np.interp(data.t[rows[here]] - data.t[a], [0.0, *middle], [warm.start[i], *along])
    return x


def seconds(t: np.ndarray) -> np.ndarray:
    """Return the number (N,) of the second, from 0, that each row is in.

    Parameters
    ----------
    t : (N,) time [s], increasing.
    """
    return ((t - t[0]) / BIN).astype(int)


def dry_torques(model: TorqueModel, i: int | np.intp, qd: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Coulomb torque c (N,) of a cold joint, which warmth changes, and of the rest (N,), which it does not.

    Parameters
    ----------
    model : of the arm. i : joint, from 0. qd, s : (N,) velocity [rad/s] and the sign that friction goes by.
    """
    f = model.friction
    c = f.coulomb_pos[i] * np.maximum(s, 0) + f.coulomb_neg[i] * np.minimum(s, 0)
    rest = f.stribeck[i] * s * np.exp(-((qd / f.stribeck_speed[i]) ** 2)) + f.root[i] * s * np.sqrt(np.abs(qd))
    return c, rest


def mean_power(model: TorqueModel, i: int | np.intp, qd: np.ndarray, s: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the means (B, 3) of ``qd qd``, ``c qd`` and ``rest qd`` over the seconds, see `dry_torques`.

    Parameters
    ----------
    model, i, qd, s : see `dry_torques`. number : (N,) of `seconds`; seconds without rows have no power.
    """
    c, rest = dry_torques(model, i, qd, s)
    sums = [np.bincount(number, weights=torque * qd) for torque in (qd, c, rest)]
    return np.stack(sums, axis=1) / np.maximum(np.bincount(number), 1)[:, None]


def relaxed(heat: np.ndarray, time: float, start: float) -> np.ndarray:
    """Return x (B,) in the middle of every second for heat (B,) = power / reference.

    Parameters
    ----------
    heat : (B,). time : constant [s]. start : x at the beginning.
    """
    from scipy.signal import lfilter

    keep = float(np.exp(-BIN / time))
    x = lfilter([0.0, 1.0 - keep], [1.0, -keep], heat)
    x = np.asarray(x) + start * keep ** np.arange(len(heat))  # at its beginning
    return 0.5 * (1.0 + keep) * x + 0.5 * (1.0 - keep) * heat


def settled(power: np.ndarray, k: np.ndarray, time: float, start: float, reference: float) -> np.ndarray:
    """Return the warmth x (B,) of a joint, which settles with the power of its own friction.

    Parameters
    ----------
    power : (B, 3) of `mean_power`. k : (6,) viscous, coulomb+, coulomb-, offset, of_viscous viscous, of_coulomb.
    time : constant [s]. start : x at the beginning. reference : power at which x settles at 1 [W].
    """
    x = np.zeros(len(power))
    for _ in range(SETTLING):
        heat = (k[0] + k[4] * x) * power[:, 0] + (1 + k[5] * x) * power[:, 1] + power[:, 2]
        x = relaxed(np.abs(heat) / reference, time, start)
    return x
