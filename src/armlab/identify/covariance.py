"""Torque covariance over velocity by maximum likelihood on free-motion residuals.

Minimise ``sum log s^2 + e^2 / s^2`` over C0, Cinf and the decay rate, per joint, in their logarithms. Residuals must
have passed the same causal filter as the estimator will use. Covariances of the parameters count effective samples; to
the information of the ratio and the rate that of a uniform distribution over their bounds is added, so that what the
data do not tell is uncertain, not exact.
"""

from __future__ import annotations

import numpy as np

from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.estimation import Excitation, Fit, effective_samples
from armlab.models import VelocityCovariance, velocity_covariance

__all__ = ["fit_velocity_covariance"]

STARTS = (5.0, 30.0, 150.0)  # s/rad
RATE_BOUNDS = (1.0, 500.0)
MAX_LOG_RATIO = 15.0
UNIFORM = 12.0  # information of a uniform distribution, times its width squared
QUANTILES = np.linspace(0.02, 0.6, 30)


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
    """
    residuals, qd = np.asarray(residuals, dtype=float), np.asarray(qd, dtype=float)
    _check(residuals, qd)
    fitters = {"exp": _fit_exponential, "step": _fit_step, "const": _fit_constant}
    if kind not in fitters:
        raise UnknownName.among("covariance kind", kind, fitters)
    n = residuals.shape[1]
    solved = [fitters[kind](residuals[:, i], np.abs(qd[:, i])) for i in range(n)]
    theta = np.array([parameters for parameters, _ in solved])
    d = theta.shape[1]
    cov = np.zeros((n * d, n * d))
    for i, (_, information) in enumerate(solved):
        share = len(residuals) / effective_samples(residuals[:, i] ** 2)
        cov[i * d : (i + 1) * d, i * d : (i + 1) * d] = np.linalg.inv(information) * share
    Cinf = np.exp(theta[:, 0])
    C0 = Cinf * np.exp(theta[:, 1]) if d > 1 else Cinf
    value = velocity_covariance(kind, C0, Cinf, np.exp(theta[:, 2]) if d > 2 else None)
    labels = ("log Cinf", "log C0/Cinf", "log shape")[:d]
    names = tuple(f"{label} joint {i + 1}" for i in range(n) for label in labels)
    root = np.zeros_like(cov)
    for i, (_, information) in enumerate(solved):
        root[i * d : (i + 1) * d, i * d : (i + 1) * d] = np.linalg.cholesky(information).T
    excitation = Excitation.of(root, names)
    sigma = np.sqrt(np.mean(residuals**2, axis=0))
    return Fit(value, names, ("1",) * len(names), theta.ravel(), cov, sigma, residuals, len(residuals), excitation)


def _check(residuals: np.ndarray, qd: np.ndarray) -> None:
    if residuals.ndim != 2 or residuals.shape != qd.shape or not np.isfinite([residuals, qd]).all():
        raise ShapeError(f"Expected finite residuals and qd of one shape (N, n), got {residuals.shape} and {qd.shape}.")
    if len(residuals) < 100:
        raise NotExcited(f"Expected at least 100 residuals, got {len(residuals)}. Record for longer.", ["everything"])
    silent = np.flatnonzero(~residuals.any(axis=0))
    if len(silent):
        joints = [f"joint {i + 1}" for i in silent]
        raise NotExcited(f"Expected residuals with noise, got zeros for {', '.join(joints)}.", joints)


def _fit_constant(e: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.array([np.log(np.mean(e * e))]), np.array([[len(e) / 2]])


def _fit_step(e: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scan the threshold over quantiles of speed; the variances on both sides have closed forms."""
    best: tuple[float, np.ndarray] = (np.inf, np.zeros(3))
    thresholds = np.unique(np.quantile(speed, QUANTILES))
    for threshold in thresholds:
        slow = speed < threshold
        if slow.sum() < 20:
            continue
        outside = np.mean(e[~slow] ** 2)
        inside = max(np.mean(e[slow] ** 2), outside)
        cost = slow.sum() * (np.log(inside) + np.mean(e[slow] ** 2) / inside) + (~slow).sum() * (np.log(outside) + 1)
        if cost < best[0]:
            best = (cost, np.array([np.log(outside), np.log(inside / outside), np.log(threshold)]))
    if not np.isfinite(best[0]):
        raise NotExcited("Expected residuals at several speeds, got one speed. Record slow and fast motion.", ["speed"])
    theta = best[1]
    count = float(np.sum(speed < np.exp(theta[2])))
    spacing = np.log(thresholds[-1] / thresholds[thresholds > 0][0]) / len(thresholds)  # what the scan can tell apart
    information = np.array(
        [[len(e) / 2, count / 2, 0.0], [count / 2, count / 2, 0.0], [0.0, 0.0, UNIFORM / spacing**2]]
    )
    information[1, 1] += UNIFORM / MAX_LOG_RATIO**2
    return theta, information


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
