"""Validation of a torque model: held-out residuals, their velocity-dependent covariance, and a per-joint report."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from armlab._numbers import numbers
from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.estimation import Excitation, Fit
from armlab.estimation.linear_problem import LinearSolution
from armlab.estimation.robust import correlation_time, effective_samples
from armlab.identify.record import Record, check_finite, resting, torque_outliers, without_outliers
from armlab.identify.residuals import thermal_state_at
from armlab.models import TorqueModel, velocity_covariance
from armlab.models.friction import FrictionBound
from armlab.models.torque import SPEED_EDGES, Training
from armlab.models.uncertainty import FORCE_RATES, PRIOR, MomentumNoise, VelocityCovariance

FIFTHS, STRETCHES = 5, 20

SETTLED = 0.01  # variance of the presliding state below which friction is known
NOTHING = 1e-18  # (N m)^2
ALPHA2_BOUNDS = (0.25, 25.0)
REST = 0.01  # fraction of the peak speed; the arm is at rest if all joints are slower
HALF = 1.0  # s, length of the segments that form the two halves for the coverage
UNMEASURED = 1e12  # (N m)^2, variance of an unmeasured torque
FEWEST = 100  # minimum number of sliding rows in each half
FAST = 0.1  # rad/s: above this speed, the friction bound covers the model error in motion


def held_out(folds: list[tuple[TorqueModel, np.ndarray]], data: Record) -> tuple[np.ndarray, np.ndarray]:
    """Return causal residuals (N, n) on held-out rows, and the motion mask (N, n).

    A joint is in motion once it has slid far enough since its last reversal or rest to determine its friction.
    """
    residuals = np.full(data.q.shape, np.nan)
    moving = np.zeros(data.q.shape, dtype=bool)
    nothing = np.full(data.q.shape[1], NOTHING)
    for model, rows in folds:  # only unknown friction contributes to the variance
        plain = replace(
            model,
            covariance=velocity_covariance("const", nothing, nothing),
            gain_cov=np.zeros_like(model.gain_cov),
            load_sd=np.zeros(model.n),
            parameters=None,
        )
        torque, variance = _causal(plain, data, rows)
        residuals[rows] = torque[rows]
        moving[rows] = variance[rows] - NOTHING <= SETTLED * model.friction.static**2
    moving[data.bridged] = False
    return residuals, moving & np.isfinite(residuals)


def _causal(model: TorqueModel, data: Record, rows: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Run the estimator's own residual filter; return filtered residuals and the variance from unknown friction.

    If rows (N,) are given, only the segments that contain them are run, each from its initial thermal state.
    """
    torque, variance = np.full((2, *data.q.shape), np.nan)
    pieces = data.segments if rows is None else stretches(rows, data)
    for one, a, b in begun(model, data, pieces):
        found = one.estimator_kernel(np.ones(6)).run(data.q[a:b], data.qd[a:b], data.tau[a:b], data.dt[a:b])
        torque[a:b], variance[a:b] = found[3], found[4]
    return torque, variance


def assess(
    model: TorqueModel,
    folds: list[tuple[TorqueModel, np.ndarray]],
    data: Record,
    joints: np.ndarray | None = None,
    unseen: np.ndarray | None = None,
    before: TorqueModel | None = None,
    drift: np.ndarray | None = None,
) -> TorqueModel:
    """Return the model with its torque covariance and quality figures.

    The torque variance `drift` (J,) due to friction changes between logs is added to the covariance; this error is
    constant within a log, so filtering does not reduce it. Covariance and scale are fitted to one half of the segments
    and validated on the other half, in both directions. The model stores the values fitted to all segments. Joints
    without measured torque have no quality figures, and are assigned a standard deviation so large that estimators
    ignore them. If an earlier model `before` is given, joints at rest keep the quality figures of that model.

    The estimator adds the part of the torque variance due to parameter uncertainty that exceeds the mean over this
    record. Held-out errors already contain this part of the variance. The covariance is therefore fitted to errors
    divided by ``sqrt(1 + r)``. The factor r is chosen so that the two variances together cover the same share of the
    joint's errors as a covariance fitted to all errors.
    """
    errors, moving = held_out(folds, data)
    if unseen is not None:
        count = np.maximum(moving.sum(axis=0), 1)
        power = np.sum(errors**2, axis=0, where=moving) / count
        errors = errors * np.sqrt(1.0 + unseen / np.maximum(power, 1e-300))
    measured = np.ones(model.n, dtype=bool) if joints is None else np.isin(np.arange(model.n), joints)
    rest = resting(data.q, model.prismatic) & (before is not None)
    measured &= ~rest
    moving &= measured
    odd = (data.blocks(HALF) % 2 == 1)[:, None]
    halves = moving & odd, moving & ~odd
    _check_sliding(measured, np.min([half.sum(axis=0) for half in halves], axis=0))
    between = np.zeros(model.n)
    between[slice(None) if joints is None else joints] = 0.0 if drift is None else drift
    shown, beyond = _of_parameters(model, data, moving)
    ratio = _share(errors, beyond, data.qd, moving)
    left = errors / np.sqrt(1.0 + ratio)
    covariance = _covariance(left, data.qd, moving)
    inside = np.zeros(model.n)
    for half in halves:
        other = _covariance(left, data.qd, moving & ~half)
        inside += np.sum(half & (errors**2 < 4.0 * (other.variance(data.qd) + beyond)), axis=0)
    count = np.where(measured, moving.sum(axis=0), np.nan)
    quality = replace(
        model.quality,
        rms=np.sqrt(np.sum(_causal(model, data)[0] ** 2, axis=0, where=moving) / count),
        rms_cv=np.sqrt(np.sum(errors**2, axis=0, where=moving) / count),
        coverage=inside / count,
    )
    bound = _bound(model, covariance, errors, data.qd, moving)
    scaled = between / covariance.alpha2
    covariance = replace(covariance, C0=covariance.C0 + scaled, Cinf=covariance.Cinf + scaled)
    judged = replace(model, covariance=covariance, bound=bound, quality=quality)
    if model.parameters is not None:
        judged = replace(judged, parameters=replace(model.parameters, mean=shown))
    if before is not None and rest.any():
        return held_at_rest(judged, before, rest)
    if not measured.all():
        return judged  # momentum methods need all torques
    return replace(
        judged, momentum=momentum_noise(judged, folds, np.where(moving, errors, np.nan), data, between, ratio)
    )


def _share(errors: np.ndarray, beyond: np.ndarray, qd: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Return r (n,) such that the covariance / (1 + r), plus `beyond`, covers as many errors as the original
    covariance."""
    variance, ratio = _covariance(errors, qd, moving).variance(qd), np.zeros(len(moving.T))
    for i, rows in enumerate(moving.T):
        if beyond[rows, i].any():
            excess = np.stack([errors[rows, i] ** 2, errors[rows, i] ** 2 - SIGMAS**2 * beyond[rows, i]])
            whole, rest = np.quantile(excess / variance[rows, i], COVERAGE, axis=1)
            ratio[i] = max(whole / rest - 1.0, 0.0) if rest > 0 else 0.0
    return ratio


def _of_parameters(model: TorqueModel, data: Record, moving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean torque variance (n,) of the parameters over rows in motion (N, n), and its excess (N, n)."""
    if model.parameters is None:
        return np.zeros(model.n), np.zeros(data.q.shape)
    exact = replace(model, gain_cov=np.zeros_like(model.gain_cov), load_sd=np.zeros(model.n), parameters=None)
    unknown = replace(exact, parameters=replace(model.parameters, mean=np.zeros(model.n)))
    shown = _causal(unknown, data)[1] - _causal(exact, data)[1]
    mean = np.maximum(np.mean(shown, axis=0, where=moving | ~moving.any(axis=0)), 0.0)
    return mean, np.maximum(shown - mean, 0.0)


def held_at_rest(model: TorqueModel, before: TorqueModel, rest: np.ndarray) -> TorqueModel:
    """Return a model whose joints at rest (n,) keep the friction, ripple, quality and ranges of an earlier model."""
    scale = before.covariance.alpha2 / model.covariance.alpha2

    def mixed(name: str, *but: str, scaled: float = 1.0) -> Any:
        own, other = getattr(model, name), getattr(before, name)
        arrays = {k: v for k, v in vars(own).items() if isinstance(v, np.ndarray) and k not in but}
        wide = {k: rest.reshape(-1, *[1] * (v.ndim - 1)) for k, v in arrays.items()}
        return replace(own, **{k: np.where(wide[k], scaled * getattr(other, k), v) for k, v in arrays.items()})

    covariance = mixed("covariance", "shape", scaled=scale)
    shape = np.where(rest, before.covariance.shape, model.covariance.shape)
    own = {name: mixed(name) for name in ("friction", "ripple", "bound", "quality", "training")}
    return replace(model, covariance=replace(covariance, shape=shape), momentum=before.momentum, **own)


def assess_again(before: TorqueModel, model: TorqueModel, folds: list[TorqueModel], data: Record) -> TorqueModel:
    """Return a model that adds terms to an earlier model, with a new torque covariance and quality figures.

    If `before` was identified from one of these logs, its parameters were fitted to rows that are held out in `folds`.
    Its excess squared error on held-out rows, ``rms_cv^2 - rms^2``, is therefore added to the errors.
    """
    data = replace(data, tau=without_outliers(data, torque_outliers(data), before))
    fold, quality = fold_of(data), before.quality
    known = np.isfinite(quality.rms_cv)
    measured = np.flatnonzero(known) if known.any() else None
    lost = np.where(known, np.maximum(quality.rms_cv**2 - quality.rms**2, 0.0), 0.0)
    seen = not set(data.sources).isdisjoint(before.sources)
    quality = replace(quality, torque_sd=np.std(data.tau, axis=0), seconds=data.seconds)
    sources = (*before.sources, *(source for source in data.sources if source not in before.sources))
    pairs = [(one, fold == k) for k, one in enumerate(folds)]
    model = replace(model, quality=quality, sources=sources)
    return assess(model, pairs, data, measured, lost if seen else None, before)


def fold_of(data: Record) -> np.ndarray:
    """Return the cross-validation fold (N,) of each row (from 0); twenty segments are assigned cyclically."""
    return data.blocks(data.seconds / STRETCHES) % FIFTHS


def _check_sliding(measured: np.ndarray, rows: np.ndarray) -> None:
    """Raise an error for joints that slide in fewer than 100 rows in either half of the log."""
    few = np.flatnonzero(measured & (rows < FEWEST))
    if len(few):
        names = [f"joint {i + 1}" for i in few]
        spread = [f"{rows[i]} rows" for i in few]
        listed = ", ".join(f"{name} ({got})" for name, got in zip(names, spread))
        raise NotExcited(
            f"Expected every joint to slide beyond its presliding distance in at least {2 * FEWEST} rows, spread "
            f"evenly over the log, got fewer rows for {listed}, so errors in "
            "motion cannot be assessed. Let these joints move further "
            "between reversals.",
            names,
            spread,
        )


def _covariance(errors: np.ndarray, qd: np.ndarray, moving: np.ndarray) -> VelocityCovariance:
    """Return each joint's velocity-dependent covariance, fitted to rows in motion and scaled to 95.4 % coverage."""
    unknown = VelocityCovariance("exp", np.array([UNMEASURED]), np.array([UNMEASURED]), np.ones(1))
    parts = [
        fit_velocity_covariance(errors[rows, i : i + 1], qd[rows, i : i + 1], "exp").value if rows.any() else unknown
        for i, rows in enumerate(moving.T)
    ]
    C0, Cinf, shape = (np.concatenate([getattr(part, name) for part in parts]) for name in ("C0", "Cinf", "shape"))
    plain = VelocityCovariance("exp", C0, Cinf, shape)
    ratio = (errors**2 / plain.variance(qd))[moving]
    return replace(plain, alpha2=float(np.clip(np.quantile(ratio, 0.954) / 4.0, *ALPHA2_BOUNDS)))


def _bound(
    model: TorqueModel, covariance: VelocityCovariance, e: np.ndarray, qd: np.ndarray, moving: np.ndarray
) -> FrictionBound:
    """Return the friction bound near rest; its floor is the 99 % quantile of errors in motion minus 2 sigma."""
    fast = np.where(moving & (np.abs(qd) > FAST), np.abs(e), np.nan)
    sigma = np.sqrt(covariance.alpha2 * covariance.Cinf)
    known = np.isfinite(fast).any(axis=0)
    largest = np.where(known, np.nanquantile(np.where(known, fast, 0.0), 0.99, axis=0), 0.0)
    return FrictionBound.of(model.friction, np.maximum(largest - 2.0 * sigma, 0.0))


def begun(
    model: TorqueModel, data: Record, pieces: Iterable[tuple[int, int]]
) -> Iterator[tuple[TorqueModel, int, int]]:
    """Yield each segment (start, stop) of a record, with the model at its initial thermal state."""
    listed = list(pieces)
    if model.warm_up is None:
        yield from ((model, a, b) for a, b in listed)
        return
    states = thermal_state_at(model, data, np.array([a for a, _ in listed], dtype=int))
    for (a, b), start in zip(listed, states):
        yield replace(model, warm_up=replace(model.warm_up, start=start)), a, b


def training(
    t: np.ndarray,
    q: np.ndarray,
    qd: np.ndarray,
    segments: tuple[tuple[int, int], ...],
    peak: np.ndarray | None = None,
) -> Training:
    """Return the ranges of the training data, given the (start, stop) rows of its segments."""
    scale = np.abs(qd).max(axis=0) if peak is None else peak
    return Training(q.min(axis=0), q.max(axis=0), scale, speed_shares(qd, scale), *rests(t, qd, scale, segments))


def speed_shares(qd: np.ndarray, peak: np.ndarray) -> np.ndarray:
    """Return the share (n, 2 bins) of samples per speed bin, with the negative direction and the slowest bin first."""
    bins = len(SPEED_EDGES)
    number = np.searchsorted(SPEED_EDGES[1:], np.abs(qd) / np.where(peak > 0, peak, 1.0), side="left")
    number = number + bins * (qd > 0)
    return np.stack([np.bincount(column, minlength=2 * bins) for column in number.T]) / len(qd)


def rests(
    t: np.ndarray, qd: np.ndarray, peak: np.ndarray, segments: tuple[tuple[int, int], ...]
) -> tuple[float, float]:
    """Return the share of samples with all joints at rest, and the duration of the longest such segment [s]."""
    still = np.all(np.abs(qd) < REST * peak, axis=1)
    longest = 0.0
    for a, b in segments:
        ends = np.flatnonzero(np.diff(np.concatenate([[0], still[a:b].astype(int), [0]])))
        for first, stop in ends.reshape(-1, 2) + a:
            longest = max(longest, float(t[stop - 1] - t[first]))
    return float(np.mean(still)), longest


# Maximum-likelihood torque covariance over velocity, per joint, for residuals filtered as in the estimator. The ratio
# and the rate are given the information of a uniform prior over their bounds, so undetermined values are uncertain
# rather than exact.


STARTS = (5.0, 30.0, 150.0)  # s/rad, initial decay rates
RATE_BOUNDS = (1.0, 500.0)
MAX_LOG_RATIO = 15.0
UNIFORM = 12.0  # information of a uniform distribution, times its width squared
SLOWEST, FASTEST = 0.02, 0.6  # range of the threshold in quantiles of speed
FEWEST_BELOW = 20  # samples below the threshold
AROUND = 50  # samples on either side of the threshold, for the speed density
TINY = 1e-12


def fit_velocity_covariance(residuals: np.ndarray, qd: np.ndarray, kind: str = "exp") -> Fit[VelocityCovariance]:
    """Fit the variance of the torque residual as a function of joint velocity.

    Parameters
    ----------
    residuals : (N, n) filtered torque residuals without contact [N m].
    qd : (N, n) joint velocities [rad/s].
    kind : "exp", "step" or "const".

    Returns
    -------
    Fit of `models.VelocityCovariance`; parameters are log Cinf, log(C0 / Cinf), log shape per joint.

    Raises
    ------
    ShapeError : shapes differ or values are not finite.
    NotExcited : fewer than 100 samples, or a joint whose residuals are all zero.
    UnknownName : unknown `kind`.

    References
    ----------
    Yao (1987), Approximating the distribution of the maximum likelihood estimate of the change-point in a sequence of
    independent random variables (covariance of a threshold).
    """
    residuals, qd = numbers(residuals, "residuals", ShapeError), numbers(qd, "qd", ShapeError)
    _check_residuals(residuals, qd)
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
    ratio = residuals**2 / value.variance(qd)  # removes the dependence of the variance on motion
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


def _check_residuals(residuals: np.ndarray, qd: np.ndarray) -> None:
    if residuals.ndim != 2 or residuals.shape != qd.shape or not residuals.shape[1]:
        raise ShapeError(f"Expected residuals and qd of the same shape (N, n), got {residuals.shape} and {qd.shape}.")
    check_finite("residuals and qd", residuals, qd, advice="Drop these rows.")
    if len(residuals) < 100:
        raise NotExcited(f"Expected at least 100 residuals, got {len(residuals)}. Record a longer log.", ["everything"])
    silent = np.flatnonzero(~residuals.any(axis=0))
    if len(silent):
        joints = [f"joint {i + 1}" for i in silent]
        raise NotExcited(f"Expected residuals with noise, got zeros for {', '.join(joints)}.", joints)


def _fit_constant(e: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.array([np.log(np.mean(e * e))]), np.array([[len(e) / 2]])


def _fit_step(e: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Try every sample as the threshold (variances have closed forms); return the logarithms of the parameters and
    their information matrix."""
    order = np.argsort(speed)
    speed, power = speed[order], np.cumsum(e[order] ** 2)
    slow = np.arange(max(FEWEST_BELOW, int(SLOWEST * len(e))), int(FASTEST * len(e)))  # samples below the threshold
    slow = slow[speed[slow] > speed[slow - 1]]
    if not len(slow):
        raise NotExcited(
            "Expected residuals at several speeds, got one speed. Record both slow and fast motion.", ["speed"]
        )
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
    """Return the variance of the number of samples on the wrong side of the threshold, given the ratio of variances.

    The variance is ``1 + 6.5 / (L1 L2)``, where L1 and L2 are the expected losses of log likelihood per sample on the
    wrong side of the threshold. For small losses, this formula is the asymptotic law of a change-point estimate; for
    large losses, it tends to one sample.
    """
    log = np.log(ratio)
    losses = 0.25 * (ratio - 1.0 - log) * (1.0 / ratio - 1.0 + log)
    return 1.0 + 6.5 / max(losses, TINY)


def _fit_exponential(e: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimise the negative log-likelihood from three initial decay rates; return the logarithms of the parameters and
    their information matrix."""
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
    """Return s^2 (N,) and its gradient (3, N) with respect to log Cinf, log(C0 / Cinf) and log rate."""
    floor, ratio, rate = np.exp(theta)
    decay = np.exp(-rate * speed)
    variance = floor * (1.0 + (ratio - 1.0) * decay)
    return variance, np.stack([variance, floor * ratio * decay, -floor * (ratio - 1.0) * decay * rate * speed])


COVERAGE, SIGMAS = 0.954, 2.0
SEEN = 0.9  # smallest observability of axes included in the coverage
LEAD = 0.5  # s, transient of an estimator
WAVES = np.array([0.05, 0.07, 0.06, 0.08, 0.09, 0.1])  # Hz, frequencies of the known wrench
ENOUGH, WINDOW = 50_000, 10.0  # rows used for a factor; s, length of the windows subsampled from longer records


def velocity_noise(data: Record) -> np.ndarray:
    """Return the SD (n,) of the measured velocity [rad/s] from fourth differences, which suppress motion."""
    steps = np.concatenate([np.diff(data.qd[a:b], 4, axis=0) for a, b in data.segments])
    return np.sqrt(np.mean(steps**2, axis=0) / 70.0)  # 70 = 1 + 16 + 36 + 16 + 1


def momentum_noise(
    model: TorqueModel,
    folds: Sequence[tuple[TorqueModel, np.ndarray]],
    errors: np.ndarray,
    data: Record,
    drift: np.ndarray | float = 0.0,
    ratio: np.ndarray | float = 0.0,
) -> MomentumNoise:
    """Return the correlation time and velocity noise of a record, and factors for 95.4 % coverage of the estimators.

    `drift`: torque variance (n,) of friction that changes between logs, in addition to the `errors`. `ratio`: variance
    (n,) added by the estimator itself, relative to the squared errors.
    """
    step, drift = float(np.median(data.dt)), np.broadcast_to(drift, model.n)
    known = [column[np.isfinite(column)] for column in errors.T]
    memory = np.array([correlation_time(column, step) if len(column) > 1 else step for column in known])
    noise = MomentumNoise(memory, velocity_noise(data))
    some = data.blocks(WINDOW) % -(-len(data.t) // ENOUGH) == 0
    sure = {"gain_cov": np.zeros((model.n, model.n)), "load_sd": np.zeros(model.n)}  # for a known wrench
    held = [
        (replace(fold, covariance=model.covariance, parameters=model.parameters, **sure), rows & some)
        for fold, rows in folds
    ]
    noise = replace(noise, alpha2_observer=_factor_of_observer(model, held, noise, errors, data, drift, ratio))
    moving = np.isfinite(errors)
    measured = moving.any(axis=0)
    judged: np.ndarray = np.all(moving[:, measured], axis=1) if measured.any() else np.zeros(len(errors), dtype=bool)
    ratios = []
    for found, rows in _runs(held, noise, data, filters=True, drift=drift):
        F, P, seen = (values[judged[rows]] for values in found[:3])
        error = F - known_wrench(data.t[rows][judged[rows]])
        ratios.append((error**2 / np.einsum("kii->ki", P))[seen > SEEN])
    return replace(noise, alpha2_kf=max(_factor(ratios), 1.0))


def _factor_of_observer(
    model: TorqueModel,
    held: Sequence[tuple[TorqueModel, np.ndarray]],
    noise: MomentumNoise,
    errors: np.ndarray,
    data: Record,
    drift: np.ndarray,
    ratio: np.ndarray | float,
) -> float:
    """Return the covariance factor of the observer, which averages the errors of the log, but not the drift."""
    variance = model.covariance.variance(data.qd) / model.covariance.alpha2
    parts = [
        np.stack([np.where(np.isfinite(errors[rows]), found[3] ** 2, np.nan), variance[rows]])
        for found, rows in _runs(held, noise, data, filters=False)
    ]
    squares, spread = np.concatenate([np.zeros((2, 0, model.n)), *parts], axis=1)
    known = np.isfinite(squares)
    mean = np.sum(squares, axis=0, where=known) / np.maximum(known.sum(axis=0), 1)
    widening = 1.0 + drift / np.maximum(mean, NOTHING)
    return _factor([(widening * squares / (1.0 + ratio) / spread)[known]])


def known_wrench(t: np.ndarray) -> np.ndarray:
    """Return the smooth wrench (N, 6) at times (N,) for the calibration of the Kalman filter."""
    return 0.5 * np.array(PRIOR) * np.sin(2.0 * np.pi * WAVES * t[:, None] + np.arange(6.0))


def with_wrench(model: TorqueModel, data: Record, a: int, b: int) -> np.ndarray:
    """Return the torque (b - a, n) of rows a to b of a record with the known wrench added."""
    q, qd = data.q[a:b], data.qd[a:b]
    qdd = np.gradient(qd, data.t[a:b], axis=0)
    load = model.chain.rnea(q, qd, qdd, *model._weights)
    pushed = np.einsum("kim,ki->km", model.chain.jacobian(q), known_wrench(data.t[a:b]))
    rubs = model.friction.load * np.sign(qd) * (np.abs(load - pushed) - np.abs(load))
    return data.tau[a:b] + model.gains * (rubs - pushed)


def _runs(
    held: Sequence[tuple[TorqueModel, np.ndarray]],
    noise: MomentumNoise,
    data: Record,
    filters: bool,
    drift: np.ndarray | float = 0.0,
) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yield, segment by segment, the estimates of each fold on its held-out rows, together with these rows.

    The filter receives the known wrench and, in each segment, a constant torque error of variance `drift` (n,).
    """
    prior, rate, draw = np.square(PRIOR), np.square(FORCE_RATES["normal"]), np.random.default_rng(0)
    for model, rows in held:
        for one, a, b in begun(replace(model, momentum=noise), data, stretches(rows, data)):
            kernel = one.momentum_kernel(prior, rate, filters=filters)
            lasting = np.sqrt(drift) * draw.standard_normal(model.n)
            tau = with_wrench(one, data, a, b) + one.gains * lasting if filters else data.tau[a:b]
            found = kernel.run(data.q[a:b], data.qd[a:b], tau, data.dt[a:b])
            yield tuple(values[rows[a:b]] for values in found[:5]), a + np.flatnonzero(rows[a:b])


def stretches(rows: np.ndarray, data: Record) -> Iterator[tuple[int, int]]:
    """Yield the segments (start, stop) that contain the rows (N,), extended by up to half a second before the rows."""
    lead = int(LEAD * data.rate)
    for first, last in data.segments:
        counts = np.concatenate([rows[first:last], np.zeros(lead, dtype=bool)])
        wanted = np.convolve(counts, np.ones(lead + 1))[lead : lead + last - first] > 0.5
        edges = np.flatnonzero(np.diff(wanted.astype(int), prepend=0, append=0))
        for a, b in edges.reshape(-1, 2):
            yield first + int(a), first + int(b)


def _factor(ratios: list[np.ndarray]) -> float:
    """Return the covariance factor for which a fraction `COVERAGE` of the ratios is below SIGMAS^2; 1 if there are no
    ratios."""
    known = np.concatenate([np.zeros(0), *(part.ravel() for part in ratios)])
    return float(np.clip(np.quantile(known, COVERAGE) / SIGMAS**2, *ALPHA2_BOUNDS)) if known.size else 1.0


def parameter_rows(fit: Fit[TorqueModel]) -> list[tuple[str, str, str, str]]:
    """Return the value, SD, unit and name of each parameter as text: base parameters first, then drives."""
    columns = zip(fit.parameters, fit.sd, fit.units, fit.names, strict=True)
    return [(f"{value:.4g}", f"{sd:.2g}", unit, name) for value, sd, unit, name in columns]


def parameter_text(fit: Fit[TorqueModel]) -> str:
    """Return one line per parameter, with the numbers first because names vary in length."""
    head, rows = ("value", "sd", "unit", "parameter"), parameter_rows(fit)
    value, sd, unit = (max(map(len, column)) for column in list(zip(head, *rows))[:3])
    lines = [f"{head[0]:>{value}}    {head[1]:<{sd}}  {head[2]:<{unit}}  {head[3]}"]
    lines += [f"{x:>{value}} +- {deviation:<{sd}}  {of:<{unit}}  {name}" for x, deviation, of, name in rows]
    return "\n".join(lines)


def report(fit: Fit[TorqueModel], solution: LinearSolution | None = None) -> str:
    """Return all parameters as text, then for each joint the torque, residuals in % of the torque SD, and friction."""
    model, q = fit.value, fit.value.quality
    header = ("joint", "torque sd", "rms", "fit", "held-out", "viscous", "coulomb +", "coulomb -", "sign", "in 2 sigma")
    units = ("", "", "", "% of sd", "% of sd", "", "", "", "", "%")
    rows, judged = [], np.flatnonzero(np.isfinite(q.rms_cv))  # joints with measured torque
    for i, own in zip(judged, _deviations(fit)):
        both = own.get("coulomb", 0.0)
        rows.append(
            (
                f"{i + 1}",
                f"{q.torque_sd[i]:.3f}",
                f"{q.rms[i]:.3f}",
                f"{100 * q.rms[i] / q.torque_sd[i]:.2f}",
                f"{100 * q.rms_cv[i] / q.torque_sd[i]:.2f}",
                f"{model.friction.viscous[i]:.3f} +- {own.get('viscous', 0.0):.3f}",
                f"{model.friction.coulomb_pos[i]:.3f} +- {own.get('coulomb+', both):.3f}",
                f"{model.friction.coulomb_neg[i]:.3f} +- {own.get('coulomb-', both):.3f}",
                _sign(model, i),
                f"{100 * q.coverage[i]:.1f}",
            )
        )
    widths = [max(map(len, column)) for column in zip(header, units, *rows)]
    lines = ["  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths)) for row in (header, units, *rows)]
    lines += ["torque in N m, friction in N m and N m s/rad (prismatic joints: N and m); sign: distance or speed"]
    lines += [f"torque gain per joint (common scale factor not identifiable): {_gains(model, judged)}"]
    if solution is not None and solution.active:
        lines += [bound.text() for bound in solution.active]
        lines += [f"parameter bounds increase the residual by {100 * solution.growth:.2g} %"]
    last = (f"{fit.n} samples, {q.seconds:.1f} s", fit.excitation.text())
    return "\n".join([parameter_text(fit), "", *lines, *last])


def _gains(model: TorqueModel, joints: np.ndarray) -> str:
    """Return the relative gains of the joints with standard deviations, without the common factor."""
    apart = np.eye(len(joints)) - 1.0 / len(joints)
    sd = np.sqrt(np.diag(apart @ model.gain_cov[np.ix_(joints, joints)] @ apart.T))
    return ", ".join(f"{gain:.3f} +- {deviation:.3f}" for gain, deviation in zip(model.gains[joints], sd))


def places_of_joints(fit: Fit[TorqueModel]) -> list[np.ndarray]:
    """Return the indices of each joint's parameters, starting with viscous; empty for joints without torque."""
    first, last = len(fit.value.base_names), len(fit.names)
    own = [k for k in range(first, last) if " of motor " not in fit.names[k]]
    begins = [k for k in own if fit.names[k].startswith("viscous ")]
    return [np.arange(a, b) for a, b in pairwise([*begins, own[-1] + 1])] if begins else []


def _deviations(fit: Fit[TorqueModel]) -> list[dict[str, float]]:
    """Return the standard deviations of the joint-specific parameters by kind."""
    return [{fit.names[k].split()[0]: float(fit.sd[k]) for k in places[::-1]} for places in places_of_joints(fit)]


def _sign(model: TorqueModel, i: int | np.intp) -> str:
    """Describe the friction structure of a joint."""
    f = model.friction
    words = f"tanh {f.smooth_speed[i]:.2g}" if f.smooth_speed[i] > 0 else f"presliding {f.delta[i]:.1e}"
    words += f", stribeck {f.stribeck_speed[i]:.2g}" if f.stribeck[i] else ""
    words += f", load {100 * f.load[i]:.1f} %" if f.load[i] else ""
    return words + (", root" if f.root[i] else "")
