"""Warm-up of drive friction, identified from a long log without a temperature sensor (law: `WarmUp`).

    y = viscous qd + (of_viscous viscous) x qd + coulomb+ max(s, 0) + coulomb- min(s, 0) + offset + of_coulomb x c

with c the Coulomb torque of the model. For a given time constant and initial thermal state, x follows from the friction
power, and all other parameters are linear. The friction power and x converge in three iterations. The model keeps x
constant within each second, so only per-second sums of a log are stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlab.errors import NotExcited
from armlab.estimation import Excitation, Fit
from armlab.estimation.fit import value_of
from armlab.estimation.robust import block_seconds
from armlab.identify.drives.regularised import scattered
from armlab.identify.record import resting
from armlab.identify.residuals import (
    BIN,
    ModelResiduals,
    dry_torques,
    mean_power,
    model_residuals,
    relaxed,
    seconds,
    settled,
)
from armlab.identify.validation import FIFTHS, assess_again, fold_of
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.friction import WarmUp

MIN_SECONDS = 20 * 60.0
TIMES = 60.0 * np.geomspace(2.0, 60.0, 12)  # s, candidate time constants
ROUNDS = 3
HOTTEST = 3.0
FEWEST = 40  # minimum number of segments for a covariance of eight parameters
COLUMN = np.array([0, 1, 2, 3, 0, 4, 5])  # column index in the sums of each linear parameter, and of y
DEGREE = np.array([0, 0, 0, 0, 1, 1, 0])  # degree in x
STEPS = 20  # maximum number of Gauss-Newton steps
SMALL = 1e-6  # convergence limit in standard deviations
GAIN = 0.02  # minimum share of the variance that warm-up must explain
NAMES = ("viscous", "coulomb+", "coulomb-", "offset", "of_viscous", "of_coulomb", "time", "start")
UNITS = ("N m s/rad", "N m", "N m", "N m", "1", "1", "s", "1")


@dataclass(frozen=True, eq=False)
class _Seconds:
    """Sums per second for one joint: Gram matrix of the columns and y, power of the columns, number of rows."""

    gram: np.ndarray  # (B, 6, 6) of qd, max(s, 0), min(s, 0), 1, c, y
    power: np.ndarray  # (B, 3) mean of qd qd, c qd, rest qd
    rows: np.ndarray  # (B,)

    @classmethod
    def of(cls, found: ModelResiduals, model: TorqueModel, i: int) -> _Seconds:
        f, data = model.friction, found.data
        qd, s, number = data.qd[:, i], found.s[:, i], seconds(data.t)
        c, _ = dry_torques(model, i, qd, s)
        y = found.y[:, i] + f.viscous[i] * qd + c + f.offset[i]
        columns = np.stack([qd, np.maximum(s, 0), np.minimum(s, 0), np.ones_like(qd), c, y])
        gram = np.empty((int(number[-1]) + 1, 6, 6))
        for j, k in zip(*np.tril_indices(6)):
            gram[:, j, k] = gram[:, k, j] = np.bincount(number, weights=columns[j] * columns[k])
        return cls(gram, mean_power(model, i, qd, s, number), np.bincount(number).astype(float))


@dataclass(frozen=True, eq=False)
class _Warm:
    """Joint with warm-up: parameters (8,), covariance, reference power, and leave-one-fold-out parameters (5, 8)."""

    theta: np.ndarray
    cov: np.ndarray
    reference: float
    folds: np.ndarray


def _linear(sums: _Seconds, x: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, float]:
    """Return viscous, coulomb+, coulomb-, offset, of_viscous viscous, of_coulomb, and the residual sum of squares."""
    moments = (np.stack([used, used * x, used * x * x]) @ sums.gram.reshape(len(x), -1)).reshape(3, 6, 6)
    total = moments[DEGREE[:, None] + DEGREE, COLUMN[:, None], COLUMN]
    scale = np.sqrt(np.diag(total)[:6])
    scale[scale == 0] = 1.0
    k = np.linalg.lstsq(total[:6, :6] / np.outer(scale, scale), total[:6, 6] / scale, rcond=1e-10)[0] / scale
    return k, float(total[6, 6] - 2 * k @ total[:6, 6] + k @ total[:6, :6] @ k)


def _given(sums: _Seconds, time: float, start: float, used: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return linear parameters, residual sum of squares and reference power for a time constant and initial state."""
    power, x = sums.power.sum(axis=1), np.zeros(len(sums.rows))
    reference = float(np.median(power[sums.rows > 0]))
    k, left = np.zeros(6), np.inf
    for _ in range(ROUNDS):
        x = relaxed(np.abs(power) / reference, time, start)
        k, left = _linear(sums, x, used)
        power = (k[0] + k[4] * x) * sums.power[:, 0] + (1 + k[5] * x) * sums.power[:, 1] + sums.power[:, 2]
    return k, left, reference


def _joint(sums: _Seconds, used: np.ndarray, guess: np.ndarray | None = None) -> tuple[np.ndarray, float, float]:
    """Return eight parameters, the residual sum of squares and the reference power from the selected one-second
    intervals (B,)."""
    from scipy.optimize import minimize

    grid = [(T, x0) for T in TIMES for x0 in (0.0, 1.0)] if guess is None else [(guess[6], guess[7])]
    scores = {(T, x0): _given(sums, T, x0, used)[1] for T, x0 in grid}
    T, x0 = min(scores, key=scores.__getitem__)
    best = minimize(
        lambda v: _given(sums, float(np.exp(v[0])), abs(float(v[1])), used)[1] / scores[T, x0],
        [np.log(T), x0],
        method="Nelder-Mead",
        bounds=[(np.log(TIMES[0]), np.log(TIMES[-1])), (0.0, HOTTEST)],
        options={"xatol": 1e-3, "fatol": 1e-9, "maxiter": 200},
    )
    T, x0 = float(np.exp(best.x[0])), abs(float(best.x[1]))
    k, left, reference = _given(sums, T, x0, used)
    of_viscous = k[4] / k[0] if k[0] else 0.0
    return np.array([*k[:4], of_viscous, k[5], T, x0]), left, reference


def fit_warm_up(table: Table | Sequence[Table], model: TorqueModel | Fit[TorqueModel]) -> Fit[TorqueModel]:
    """Fit the warm-up model together with viscous friction, Coulomb friction and offset of every joint.

    The warm-up term is kept if it reduces the squared error on held-out segments by at least 2 %; otherwise, the
    friction of the joint is unchanged.

    Parameters
    ----------
    table : log of at least 20 minutes of free motion with columns q, qd, tau.
    model : identified torque model of the recorded arm, or its fit.

    Returns
    -------
    Fit of `models.TorqueModel`, with updated torque covariance and fit quality; see `fit_friction`. The fit has eight
    parameters per joint with warm-up; their covariance comes from the scatter of segments longer than the residual
    autocorrelation.

    Raises
    ------
    NotExcited : a log of less than 20 minutes.
    ShapeError : NaN, a wrong joint count, or a velocity that is not the derivative of position.

    References
    ----------
    Bagge Carlson, Robertsson and Johansson, IROS 2015.
    """
    model = value_of(model)
    found = model_residuals(table, model)
    data = found.data
    if data.seconds < MIN_SECONDS or np.any(np.diff(data.t) <= 0):
        raise NotExcited(
            f"Expected one log of at least {MIN_SECONDS / 60:g} min for warm-up, got {data.seconds / 60:.1f} min in "
            f"{len(data.segments)} segments. Record a longer run from a cold start.",
            ["warm-up"],
            [f"{data.seconds / 60:.1f} min"],
        )
    fifth, kept = fold_of(data), dict[int, _Warm]()
    number = seconds(data.t)
    first = np.searchsorted(number, np.arange(int(number[-1]) + 1))
    for i in np.flatnonzero(~resting(data.q, model.prismatic)).tolist():
        sums = _Seconds.of(found, model, i)
        every = np.ones(len(sums.rows))
        theta, left, reference = _joint(sums, every)
        plain = _linear(sums, 0.0 * every, every)[1]
        if left >= (1.0 - GAIN) * plain:
            continue
        gain, folds = _held_out(sums, theta, reference, fifth[first])
        if gain > GAIN:
            theta = _polished(sums, theta, reference)
            kept[i] = _Warm(theta, _covariance(sums, theta, reference), reference, folds)
    warm = _with_warm_up(model, {i: (one.theta, one.reference) for i, one in kept.items()})
    if kept:
        parts = [{i: (one.folds[k], one.reference) for i, one in kept.items()} for k in range(FIFTHS)]
        warm = assess_again(model, warm, [_with_warm_up(model, part) for part in parts], data)
    names = tuple(f"{name} joint {i + 1}" for i in kept for name in NAMES)
    cov = np.zeros((len(names), len(names)))
    for k, one in enumerate(kept.values()):
        cov[8 * k : 8 * k + 8, 8 * k : 8 * k + 8] = one.cov
    left = model_residuals(table, warm).y
    return Fit(
        value=warm,
        names=names,
        units=UNITS * len(kept),
        parameters=np.concatenate([np.zeros(0), *(one.theta for one in kept.values())]),
        cov=cov,
        sigma=np.std(left, axis=0),
        residuals=left,
        n=len(data.t),
        excitation=Excitation.of_covariance(cov, names),
    )


def _held_out(sums: _Seconds, guess: np.ndarray, reference: float, fifth: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the relative reduction in the held-out squared error due to warm-up, and the leave-one-fold-out
    parameters."""
    plain, warm, thetas = 0.0, 0.0, []
    zero = np.zeros(len(sums.rows))
    for k in range(FIFTHS):
        out = (fifth == k).astype(float)
        thetas.append(_joint(sums, 1.0 - out, guess)[0])
        warm += _left(sums, thetas[-1], reference, out)
        plain += _squares(sums, _linear(sums, zero, 1.0 - out)[0], zero, out)
    return 1.0 - warm / plain if plain > 0 else 0.0, np.array(thetas)


def _warm(sums: _Seconds, theta: np.ndarray, reference: float) -> tuple[np.ndarray, np.ndarray]:
    """Return viscous ... of_coulomb (6,) and the thermal state x (B,) for the resulting friction power."""
    k = np.array([*theta[:4], theta[4] * theta[0], theta[5]])
    return k, settled(sums.power, k, theta[6], theta[7], reference)


def _along(k: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return v (B, 6) such that the residuals of each second are the columns of that second times v."""
    constant = np.broadcast_to(k[1:4, None], (3, len(x)))
    return np.stack([k[0] + k[4] * x, *constant, k[5] * x, np.full(len(x), -1.0)], axis=1)


def _left(sums: _Seconds, theta: np.ndarray, reference: float, used: np.ndarray) -> float:
    return _squares(sums, *_warm(sums, theta, reference), used)


def _squares(sums: _Seconds, k: np.ndarray, x: np.ndarray, used: np.ndarray) -> float:
    """Return the residual sum of squares over the selected one-second intervals."""
    v = _along(k, x)
    return float(np.einsum("b,bi,bij,bj->", used, v, sums.gram, v))


def _slopes(sums: _Seconds, theta: np.ndarray, reference: float) -> tuple[np.ndarray, np.ndarray]:
    """Return v (B, 6) and its derivatives (B, 6, 8) with respect to the parameters, by finite differences."""

    def at(values: np.ndarray) -> np.ndarray:
        return _along(*_warm(sums, values, reference))

    steps = 1e-4 * np.maximum(np.abs(theta), 0.1)
    apart = [(at(theta + h) - at(theta - h)) / (2.0 * step) for h, step in zip(np.diag(steps), steps)]
    return at(theta), np.stack(apart, axis=2)


def _polished(sums: _Seconds, theta: np.ndarray, reference: float) -> np.ndarray:
    """Return the Gauss-Newton least-squares parameters, accounting for their effect on the thermal state."""
    every = np.ones(len(sums.rows))
    least = _left(sums, theta, reference, every)
    for _ in range(STEPS):
        v, J = _slopes(sums, theta, reference)
        H, g = np.einsum("bip,bij,bjq->pq", J, sums.gram, J), np.einsum("bip,bij,bj->p", J, sums.gram, v)
        scale = np.sqrt(np.diag(H))
        step = -np.linalg.lstsq(H / np.outer(scale, scale), g / scale, rcond=1e-12)[0] / scale
        trial = theta + step
        trial[6:] = np.clip(trial[6:], (TIMES[0], 0.0), (TIMES[-1], HOTTEST))
        left = _left(sums, trial, reference, every)
        if not left < least:
            break
        small = np.all(np.abs(trial - theta) * scale < SMALL * np.sqrt(left / sums.rows.sum()))
        theta, least = trial, left
        if small:
            break
    return theta


def _covariance(sums: _Seconds, theta: np.ndarray, reference: float) -> np.ndarray:
    """Return the covariance (8, 8) from the scatter of segments longer than the residual autocorrelation."""
    v, J = _slopes(sums, theta, reference)
    means = np.einsum("bi,bi->b", v, sums.gram[:, 3]) / np.maximum(sums.rows, 1.0)
    length = max(1, round(min(block_seconds(means[:, None], BIN), BIN * len(means) / FEWEST) / BIN))
    H = np.einsum("bip,bij,bjq->pq", J, sums.gram, J)
    moments = np.einsum("bip,bij,bj->bp", J, sums.gram, v)
    return scattered(H, np.add.reduceat(moments, np.arange(0, len(moments), length), axis=0))


def _with_warm_up(model: TorqueModel, kept: dict[int, tuple[np.ndarray, float]]) -> TorqueModel:
    if not kept:
        return model
    f, zero = model.friction, np.zeros(model.n)
    friction = {name: getattr(f, name).copy() for name in ("viscous", "coulomb_pos", "coulomb_neg", "offset")}
    warm = {name: zero.copy() for name in ("of_coulomb", "of_viscous", "time", "power", "start")}
    warm["power"] += 1.0  # for drives without warm-up
    for i, (theta, reference) in kept.items():
        viscous, positive, negative, offset, of_viscous, of_coulomb, time, start = theta
        for name, value in zip(friction, (viscous, positive, negative, offset)):
            friction[name][i] = value
        mean, before = 0.5 * (positive + negative), 0.5 * (f.coulomb_pos[i] + f.coulomb_neg[i])
        relative = of_coulomb * before / mean if mean else 0.0  # relative to the current Coulomb friction
        for name, value in zip(warm, (relative, of_viscous, time, reference, start)):
            warm[name][i] = value
    return replace(model, friction=replace(f, **friction), warm_up=WarmUp(**warm))
