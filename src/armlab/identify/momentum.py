"""What the momentum estimators need to know of the residuals: memory, velocity noise, honest covariances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from armlab.estimation import correlation_time
from armlab.identify.preparation import Prepared
from armlab.identify.warmth import begun
from armlab.models import FORCE_RATES, PRIOR, MomentumNoise, TorqueModel

__all__ = ["momentum_noise", "stretches", "velocity_noise"]

COVERAGE, SIGMAS = 0.954, 2.0
ALPHA2_BOUNDS = (0.25, 25.0)
SEEN = 0.9  # observability of the axes whose coverage counts
LEAD = 0.5  # s, in which an estimator forgets how it began
ENOUGH, WINDOW = 50_000, 10.0  # rows for a factor, and s: of longer records every second window, or third, is run


def velocity_noise(data: Prepared) -> np.ndarray:
    """Return the deviation (n,) of the measured velocity [rad/s], from fourth differences, which motion hardly has.

    Parameters
    ----------
    data : the record.
    """
    steps = np.concatenate([np.diff(data.qd[a:b], 4, axis=0) for a, b in data.segments])
    return np.sqrt(np.mean(steps**2, axis=0) / 70.0)  # 70 = 1 + 16 + 36 + 16 + 1


def momentum_noise(
    model: TorqueModel, folds: Sequence[tuple[TorqueModel, np.ndarray]], errors: np.ndarray, data: Prepared
) -> MomentumNoise:
    """Return memory and velocity noise of a record, and factors that make the momentum estimators' 2 sigma hold.

    Parameters
    ----------
    model : with its torque covariance. folds : models and the rows (N,) that each did not see.
    errors : (N, n) held-out causal residuals [N m], NaN where they do not count. data : the record.
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
    told = moving.any(axis=0)
    judged: np.ndarray = np.all(moving[:, told], axis=1) if told.any() else np.zeros(len(errors), dtype=bool)
    ratios = [
        _normalised(*(values[judged[rows]] for values in found[:3]))
        for found, rows in _runs(held, noise, data, filters=True)
    ]
    return replace(noise, alpha2_kf=_factor(ratios))


def _runs(
    held: Sequence[tuple[TorqueModel, np.ndarray]], noise: MomentumNoise, data: Prepared, filters: bool
) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yield what the estimators of the folds find in rows that they did not see, and these rows, piece by piece."""
    prior, rate = np.square(PRIOR), np.square(FORCE_RATES["normal"])
    for model, rows in held:
        for one, a, b in begun(replace(model, momentum=noise), data, stretches(rows, data)):
            kernel = one.momentum_kernel(prior, rate, filters=filters)
            found = kernel.run(data.q[a:b], data.qd[a:b], data.tau[a:b], data.dt[a:b])
            yield tuple(values[rows[a:b]] for values in found[:5]), a + np.flatnonzero(rows[a:b])


def stretches(rows: np.ndarray, data: Prepared) -> Iterator[tuple[int, int]]:
    """Yield the stretches of the record that hold the rows, each with a lead of half a second where the segment has it.

    Parameters
    ----------
    rows : (N,) which are wanted. data : the record.
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
