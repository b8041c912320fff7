"""Residuals of a torque model along a record, thermal state, and the noise models fitted to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from armlab._numbers import numbers
from armlab.errors import ModelMismatchError, NotExcited, ShapeError, UnknownName
from armlab.estimation import Excitation, Fit
from armlab.estimation.bootstrap import correlation_time, effective_samples
from armlab.identify.record import Record, prepare
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel, velocity_covariance
from armlab.models.torque import FORCE_RATES, PRIOR, MomentumNoise, VelocityCovariance
from armlab.robots import Robot, from_links


@dataclass(frozen=True, eq=False)
class ModelResiduals:
    """Residuals of a model along logs.

    `y`: (N, n) measured minus modelled torque [N m], over the gains, unfiltered. `s`: (N, n) the sign that friction
    goes by: presliding state, or the smooth sign.
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
    """Return measured minus modelled torque of every row; the acceleration is low-passed at a tenth of the rate.

    `table`: one log or several, of free motion, with columns q, qd, tau. `joints`: numbers, from 0, of those that must
    move; all when left out. `robot`: the arm; its limits and gears, which the model does not know, tell a log in other
    units.
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
    return ModelResiduals(data, y, friction_signs(model, data))


def friction_signs(model: TorqueModel, data: Record) -> np.ndarray:
    """Return the sign (N, n) that friction goes by: the presliding state, or the smooth sign where a joint has one."""
    smooth, s = model.friction.smooth_speed, np.empty_like(data.q)
    for a, b in data.segments:
        s[a:b] = presliding(data.q[a:b], model.friction.delta, model.friction.resolution)
    return np.where(smooth > 0, np.tanh(data.qd / np.where(smooth > 0, smooth, 1.0)), s)


# How warm the drives of a model are along a record, second by second (models.friction.WarmUp has the law).
#
# The thermal state is taken as constant over a second, so that sums over seconds are all that is kept of a record.


BIN = 1.0  # s
SETTLING = 8  # rounds of power and thermal state for given parameters
FEWEST_SECONDS = 20  # rows of a second that tell its power


def begun(
    model: TorqueModel, data: Record, pieces: Iterable[tuple[int, int]]
) -> Iterator[tuple[TorqueModel, int, int]]:
    """Yield a model for each piece of a record, which begins as warm as the record before has made it, and the piece.

    `pieces`: (start, stop) rows.
    """
    listed = list(pieces)
    if model.warm_up is None:
        yield from ((model, a, b) for a, b in listed)
        return
    states = _thermal_state_at(model, data, np.array([a for a, _ in listed], dtype=int))
    for (a, b), start in zip(listed, states):
        yield replace(model, warm_up=replace(model.warm_up, start=start)), a, b


def _thermal_state_at(model: TorqueModel, data: Record, rows: np.ndarray) -> np.ndarray:
    """Return the thermal state (M, n) at rows (M,) of a record; every log in it begins with that of the model."""
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
    """Return the number (N,) of the second, from 0, that each row is in.

    `t`: (N,) time [s], increasing.
    """
    return ((t - t[0]) / BIN).astype(int)


def dry_torques(model: TorqueModel, i: int | np.intp, qd: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Coulomb torque c (N,) of a cold joint, which the thermal state changes, and the other torques (N,).

    `i`: joint, from 0. `qd`, `s`: (N,) velocity [rad/s] and the sign that friction goes by.
    """
    f = model.friction
    c = f.coulomb_pos[i] * np.maximum(s, 0) + f.coulomb_neg[i] * np.minimum(s, 0)
    rest = f.stribeck[i] * s * np.exp(-((qd / f.stribeck_speed[i]) ** 2)) + f.root[i] * s * np.sqrt(np.abs(qd))
    return c, rest


def mean_power(model: TorqueModel, i: int | np.intp, qd: np.ndarray, s: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the means (B, 3) of ``qd qd``, ``c qd`` and ``rest qd`` over the seconds, see `dry_torques`.

    `number`: (N,) of `seconds`; seconds without rows have no power.
    """
    c, rest = dry_torques(model, i, qd, s)
    sums = [np.bincount(number, weights=torque * qd) for torque in (qd, c, rest)]
    return np.stack(sums, axis=1) / np.maximum(np.bincount(number), 1)[:, None]


def relaxed(heat: np.ndarray, time: float, start: float) -> np.ndarray:
    """Return x (B,) in the middle of every second for heat (B,) = power / reference.

    `heat`: (B,). `time`: constant [s].
    """
    from scipy.signal import lfilter

    keep = float(np.exp(-BIN / time))
    x = lfilter([0.0, 1.0 - keep], [1.0, -keep], heat)
    x = np.asarray(x) + start * keep ** np.arange(len(heat))  # at its beginning
    return 0.5 * (1.0 + keep) * x + 0.5 * (1.0 - keep) * heat


def settled(power: np.ndarray, k: np.ndarray, time: float, start: float, reference: float) -> np.ndarray:
    """Return the thermal state x (B,) of a joint, which settles with the power of its own friction.

    `power`: (B, 3) of `mean_power`. `k`: (6,) viscous, coulomb+, coulomb-, offset, of_viscous viscous, of_coulomb.
    `time`: constant [s]. `reference`: power at which x settles at 1 [W].
    """
    x = np.zeros(len(power))
    for _ in range(SETTLING):
        heat = (k[0] + k[4] * x) * power[:, 0] + (1 + k[5] * x) * power[:, 1] + power[:, 2]
        x = relaxed(np.abs(heat) / reference, time, start)
    return x


# Torque covariance over velocity by maximum likelihood on free-motion residuals.
#
# Minimise ``sum log s^2 + e^2 / s^2`` over C0, Cinf and the decay rate, per joint, in their logarithms. Residuals must
# have passed the same causal filter as the estimator will use. Covariances of the parameters count effective samples;
# to the information of the ratio and the rate that of a uniform distribution over their bounds is added, so that what
# the data do not tell is uncertain, not exact.


STARTS = (5.0, 30.0, 150.0)  # s/rad
RATE_BOUNDS = (1.0, 500.0)
MAX_LOG_RATIO = 15.0
UNIFORM = 12.0  # information of a uniform distribution, times its width squared
SLOWEST, FASTEST, FEWEST = 0.02, 0.6, 20  # quantiles of speed between which a threshold lies, and samples below it
AROUND = 50  # samples on either side of the threshold that tell how densely speeds lie
TINY = 1e-12


def fit_velocity_covariance(residuals: np.ndarray, qd: np.ndarray, kind: str = "exp") -> Fit[VelocityCovariance]:
    """Fit how the variance of the torque residual depends on joint velocity.

    Parameters
    ----------
    residuals : (N, n) filtered torque residuals without contact [N m].
    qd : (N, n) joint velocities [rad/s].
    kind : "exp", "step" or "const".

    Returns
    -------
    Fit of `models.torque.VelocityCovariance`; parameters are log Cinf, log(C0 / Cinf), log shape per joint.

    Raises
    ------
    ShapeError : shapes differ or values are not finite. NotExcited : fewer than 100 samples, or a joint whose residuals
    are all zero. UnknownName : another kind.

    References
    ----------
    Yao (1987), Approximating the distribution of the maximum likelihood estimate of the change-point in a sequence of
    independent random variables, for the covariance of a threshold.
    """
    residuals, qd = numbers(residuals, "residuals", ShapeError), numbers(qd, "qd", ShapeError)
    _check(residuals, qd)
    fitters = {"exp": _fit_exponential, "step": _fit_step, "const": _fit_constant}
    if kind not in fitters:
        raise UnknownName.among("covariance kind", kind, fitters)
    n = residuals.shape[1]
    solved = [fitters[kind](residuals[:, i], np.abs(qd[:, i])) for i in range(n)]
    theta = np.array([parameters for parameters, _ in solved])
    d = theta.shape[1]
    Cinf = np.exp(theta[:, 0])
    C0 = Cinf * np.exp(theta[:, 1]) if d > 1 else Cinf
    value = velocity_covariance(kind, C0, Cinf, np.exp(theta[:, 2]) if d > 2 else None)
    ratio = residuals**2 / value.variance(qd)  # the variance follows the motion: its own rhythm is no memory
    cov = np.zeros((n * d, n * d))
    for i, (_, information) in enumerate(solved):
        share = len(residuals) / effective_samples(ratio[:, i])
        cov[i * d : (i + 1) * d, i * d : (i + 1) * d] = np.linalg.inv(information) * share
    labels = ("log Cinf", "log C0/Cinf", "log shape")[:d]
    names = tuple(f"{label} joint {i + 1}" for i in range(n) for label in labels)
    root = np.zeros_like(cov)
    for i, (_, information) in enumerate(solved):
        root[i * d : (i + 1) * d, i * d : (i + 1) * d] = np.linalg.cholesky(information).T
    excitation = Excitation.of(root, names)
    sigma = np.sqrt(np.mean(residuals**2, axis=0))
    return Fit(value, names, ("1",) * len(names), theta.ravel(), cov, sigma, residuals, len(residuals), excitation)


def _check(residuals: np.ndarray, qd: np.ndarray) -> None:
    if residuals.ndim != 2 or residuals.shape != qd.shape or not residuals.shape[1]:
        raise ShapeError(f"Expected residuals and qd of one shape (N, n), got {residuals.shape} and {qd.shape}.")
    bad = np.flatnonzero(~(np.isfinite(residuals) & np.isfinite(qd)).all(axis=1))
    if len(bad):
        raise ShapeError(
            f"Expected finite residuals and qd, got NaN or Inf in {len(bad)} rows, first {bad[:5].tolist()}. "
            "Drop these rows."
        )
    if len(residuals) < 100:
        raise NotExcited(f"Expected at least 100 residuals, got {len(residuals)}. Record for longer.", ["everything"])
    silent = np.flatnonzero(~residuals.any(axis=0))
    if len(silent):
        joints = [f"joint {i + 1}" for i in silent]
        raise NotExcited(f"Expected residuals with noise, got zeros for {', '.join(joints)}.", joints)


def _fit_constant(e: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.array([np.log(np.mean(e * e))]), np.array([[len(e) / 2]])


def _fit_step(e: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Try every sample as the threshold: both variances have closed forms; return log parameters and information."""
    order = np.argsort(speed)
    speed, power = speed[order], np.cumsum(e[order] ** 2)
    slow = np.arange(max(FEWEST, int(SLOWEST * len(e))), int(FASTEST * len(e)))  # samples below the threshold
    slow = slow[speed[slow] > speed[slow - 1]]
    if not len(slow):
        raise NotExcited("Expected residuals at several speeds, got one speed. Record slow and fast motion.", ["speed"])
    below, fast = power[slow - 1], len(e) - slow
    outside = np.maximum((power[-1] - below) / fast, TINY * power[-1] / len(e))
    inside = np.maximum(below / slow, outside)
    best = int(np.argmin(slow * np.log(inside) + below / inside + fast * (np.log(outside) + 1.0)))
    count, ratio = int(slow[best]), float(inside[best] / outside[best])
    threshold = 0.5 * (speed[count - 1] + speed[count])
    theta = np.log([outside[best], ratio, threshold])
    information = np.array([[len(e) / 2, count / 2, 0.0], [count / 2, count / 2, 0.0], [0.0, 0.0, 0.0]])
    information[1, 1] += UNIFORM / MAX_LOG_RATIO**2
    near = speed[max(count - AROUND, 0) : count + AROUND + 1]
    near = near[near > 0]
    spacing = np.log(near[-1] / near[0]) / (len(near) - 1) if len(near) > 1 else 1.0
    width = np.log(speed[slow[-1]] / speed[slow[0]]) + spacing
    information[2, 2] = 1.0 / (spacing**2 * _misplaced(ratio)) + UNIFORM / width**2
    return theta, information


def _misplaced(ratio: float) -> float:
    """Return the variance of the number of samples on the wrong side of the threshold, for the ratio of variances.

    With L1 and L2 the expected loss of likelihood by a sample on the wrong side, ``1 + 6.5 / (L1 L2)``: where the loss
    is small the limit law of a change point (its variance is 26 where noise and drift are 1 and 1/2), and one sample
    where it is large. Between ratios of 1.5 and 1000 the deviation of drawn samples is within 21 % of its root.
    """
    log = np.log(ratio)
    losses = 0.25 * (ratio - 1.0 - log) * (1.0 / ratio - 1.0 + log)
    return 1.0 + 6.5 / max(losses, TINY)


def _fit_exponential(e: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimise the negative log-likelihood from three decay rates; return log parameters and Fisher information."""
    from scipy.optimize import minimize

    power = e * e
    start = np.log(np.mean(power))
    bounds = [(start - 20, start + 10), (0.0, MAX_LOG_RATIO), tuple(np.log(RATE_BOUNDS))]

    def cost(theta: np.ndarray) -> tuple[float, np.ndarray]:
        variance, gradient = _exponential(theta, speed)
        ratio = power / variance
        return float(np.mean(np.log(variance) + ratio)), gradient @ ((1 - ratio) / variance) / len(e)

    results = [
        minimize(cost, np.array([start, 1.0, np.log(rate)]), jac=True, method="L-BFGS-B", bounds=bounds)
        for rate in STARTS
    ]
    theta = min(results, key=lambda r: r.fun).x
    variance, gradient = _exponential(theta, speed)
    relative = gradient / variance
    widths = np.array([MAX_LOG_RATIO, np.log(RATE_BOUNDS[1] / RATE_BOUNDS[0])])
    return theta, 0.5 * relative @ relative.T + np.diag([0.0, *(UNIFORM / widths**2)])


def _exponential(theta: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return s^2 (N,) and its gradient (3, N) over log Cinf, log(C0 / Cinf), log rate."""
    floor, ratio, rate = np.exp(theta)
    decay = np.exp(-rate * speed)
    variance = floor * (1.0 + (ratio - 1.0) * decay)
    return variance, np.stack([variance, floor * ratio * decay, -floor * (ratio - 1.0) * decay * rate * speed])


# What the momentum estimators need to know of the residuals: memory, velocity noise, honest covariances.


COVERAGE, SIGMAS = 0.954, 2.0
ALPHA2_BOUNDS = (0.25, 25.0)
SEEN = 0.9  # observability of the axes whose coverage counts
LEAD = 0.5  # s, in which an estimator forgets how it began
ENOUGH, WINDOW = 50_000, 10.0  # rows for a factor, and s: of longer records every second window, or third, is run


def velocity_noise(data: Record) -> np.ndarray:
    """Return the deviation (n,) of the measured velocity [rad/s], from fourth differences, which motion hardly has."""
    steps = np.concatenate([np.diff(data.qd[a:b], 4, axis=0) for a, b in data.segments])
    return np.sqrt(np.mean(steps**2, axis=0) / 70.0)  # 70 = 1 + 16 + 36 + 16 + 1


def momentum_noise(
    model: TorqueModel, folds: Sequence[tuple[TorqueModel, np.ndarray]], errors: np.ndarray, data: Record
) -> MomentumNoise:
    """Return memory and velocity noise of a record, and factors that make the momentum estimators' 2 sigma hold.

    `folds`: models and the rows (N,) that each did not see. `errors`: (N, n) held-out causal residuals [N m], NaN where
    they do not count.
    """
    step = float(np.median(data.dt))
    known = [column[np.isfinite(column)] for column in errors.T]
    memory = np.array([correlation_time(column, step) if len(column) > 1 else step for column in known])
    noise = MomentumNoise(memory, velocity_noise(data))
    some = data.blocks(WINDOW) % -(-len(data.t) // ENOUGH) == 0
    held = [(replace(fold, covariance=model.covariance), rows & some) for fold, rows in folds]
    variance = model.covariance.variance(data.qd) / model.covariance.alpha2
    ratios = [
        (found[3] ** 2 / variance[rows])[np.isfinite(errors[rows] + found[3])]
        for found, rows in _runs(held, noise, data, filters=False)
    ]
    noise = replace(noise, alpha2_observer=_factor(ratios))
    moving = np.isfinite(errors)
    measured = moving.any(axis=0)
    judged: np.ndarray = np.all(moving[:, measured], axis=1) if measured.any() else np.zeros(len(errors), dtype=bool)
    ratios = [
        _normalised(*(values[judged[rows]] for values in found[:3]))
        for found, rows in _runs(held, noise, data, filters=True)
    ]
    return replace(noise, alpha2_kf=_factor(ratios))


def _runs(
    held: Sequence[tuple[TorqueModel, np.ndarray]], noise: MomentumNoise, data: Record, filters: bool
) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yield what the estimators of the folds find in rows that they did not see, and these rows, piece by piece."""
    prior, rate = np.square(PRIOR), np.square(FORCE_RATES["normal"])
    for model, rows in held:
        for one, a, b in begun(replace(model, momentum=noise), data, stretches(rows, data)):
            kernel = one.momentum_kernel(prior, rate, filters=filters)
            found = kernel.run(data.q[a:b], data.qd[a:b], data.tau[a:b], data.dt[a:b])
            yield tuple(values[rows[a:b]] for values in found[:5]), a + np.flatnonzero(rows[a:b])


def stretches(rows: np.ndarray, data: Record) -> Iterator[tuple[int, int]]:
    """Yield the stretches of the record that hold the rows, each with a lead of half a second where the segment has it.

    `rows`: (N,) which are wanted.
    """
    lead = int(LEAD * data.rate)
    for first, last in data.segments:
        counts = np.concatenate([rows[first:last], np.zeros(lead, dtype=bool)])
        wanted = np.convolve(counts, np.ones(lead + 1))[lead : lead + last - first] > 0.5
        edges = np.flatnonzero(np.diff(wanted.astype(int), prepend=0, append=0))
        for a, b in edges.reshape(-1, 2):
            yield first + int(a), first + int(b)


def _normalised(F: np.ndarray, P: np.ndarray, observability: np.ndarray) -> np.ndarray:
    """Return F_i^2 / P_ii of the axes that can be seen: in free motion the wrench is the error."""
    return (F**2 / np.einsum("kii->ki", P))[observability > SEEN]


def _factor(ratios: list[np.ndarray]) -> float:
    """Return the factor on the covariance by which `COVERAGE` of the ratios are below SIGMAS^2; 1 without any."""
    known = np.concatenate([np.zeros(0), *(part.ravel() for part in ratios)])
    return float(np.clip(np.quantile(known, COVERAGE) / SIGMAS**2, *ALPHA2_BOUNDS)) if known.size else 1.0
