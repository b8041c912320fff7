"""Torque covariance over velocity by maximum likelihood on free-motion residuals.

Minimise ``sum log s^2 + e^2 / s^2`` over C0, Cinf and the decay rate, per joint, in their logarithms. Residuals must
have passed the same causal filter as the estimator will use. Covariances of the parameters count effective samples; to
the information of the ratio and the rate that of a uniform distribution over their bounds is added, so that what the
data do not tell is uncertain, not exact.
"""

from __future__ import annotations

import numpy as np

from armlab._numbers import numbers
from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.estimation import Excitation, Fit, effective_samples
from armlab.models import VelocityCovariance, velocity_covariance

__all__ = ["fit_velocity_covariance"]

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
    Fit of `models.VelocityCovariance`; parameters are log Cinf, log(C0 / Cinf), log shape per joint.

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
