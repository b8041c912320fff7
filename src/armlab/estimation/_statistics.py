"""The properties of the contract that need many runs: consistent, honest, efficient, robust."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from armlab.estimation.contract import Error, Experiment, Gauge, Limits, Spoil
    from armlab.estimation.fit import Fit

Verdict = tuple[bool | None, str]

NORMAL_95 = 1.959963984540054
ENOUGH = 1000  # runs from which coverage and efficiency are judged
STANDARD_ERRORS = 3.0


@dataclass(frozen=True, eq=False)
class Trial:
    """What is checked, and on what: the arguments of `check_estimator`; `done` keeps runs that several judges need."""

    fit: Callable[..., Fit[Any]]
    experiment: Callable[[int, int], Experiment]
    runs: int
    n: int
    seed: int
    error: Error
    blocks: Mapping[str, Sequence[int]]
    gauges: Sequence[Gauge]
    refusals: Mapping[str, Mapping[str, Any]]
    spoil: Spoil | None
    limits: Limits
    done: dict[str, list[Run]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Run:
    """Error of one run with its stated covariance; both in the same coordinates."""

    e: np.ndarray
    C: np.ndarray
    rank: int
    bound: np.ndarray | None

    @property
    def nees(self) -> float:
        """Squared error over the stated covariance, of as many directions as its rank."""
        sd = np.sqrt(np.diag(self.C))
        sd = np.where(sd > 0, sd, 1.0)
        values, vectors = np.linalg.eigh(self.C / np.outer(sd, sd))
        along = vectors.T @ (self.e / sd)
        told = slice(len(values) - self.rank, None)
        return float(np.sum(along[told] ** 2 / values[told]))


def error_of(trial: Trial, fit: Fit[Any], truth: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the error of a fit and its covariance."""
    found = trial.error(fit, truth)
    e, C = found if isinstance(found, tuple) else (found, fit.cov)
    return np.atleast_1d(np.asarray(e, dtype=float)), np.asarray(C, dtype=float)


def run(trial: Trial, case: Experiment) -> Run:
    """Fit one experiment."""
    fit = trial.fit(**case.data)
    e, C = error_of(trial, fit, case.truth)
    return Run(e, C, fit.rank, case.bound)


def _runs(trial: Trial, times: int) -> list[Run]:
    """Return the runs with n times as many samples, made once."""
    key = f"runs {times}"
    if key not in trial.done:
        seeds = range(trial.seed, trial.seed + trial.runs)
        trial.done[key] = [run(trial, trial.experiment(seed, times * trial.n)) for seed in seeds]
    return trial.done[key]


def _weight(runs: list[Run]) -> np.ndarray:
    """Return the inverse of the mean stated covariance: it makes errors of many units one number."""
    C = np.mean([r.C for r in runs], axis=0)
    sd = np.sqrt(np.diag(C))
    sd = np.where(sd > 0, sd, 1.0)
    return np.linalg.pinv(C / np.outer(sd, sd), rcond=1e-9, hermitian=True) / np.outer(sd, sd)


def _rms(runs: list[Run], W: np.ndarray) -> float:
    return float(np.sqrt(np.mean([r.e @ W @ r.e for r in runs])))


def _bound(runs: list[Run], W: np.ndarray) -> float:
    return float(np.mean([np.vdot(W, r.bound) for r in runs if r.bound is not None]))


def _se(runs: list[Run]) -> float:
    """Return the relative standard error of an RMS over these runs."""
    return 1.0 / np.sqrt(2.0 * runs[0].rank * len(runs))


def consistent(trial: Trial) -> Verdict:
    """Four times the samples must halve the error; of experiments drawn at random, as far as it halves the bound."""
    few, many = _runs(trial, 1), _runs(trial, 4)
    W = _weight(few)
    ratio, found = _rms(many, W) / _rms(few, W), ""
    if all(r.bound is not None and r.bound.shape == W.shape for r in (*few, *many)):
        least = np.sqrt(_bound(many, W) / _bound(few, W))
        ratio, found = 0.5 * ratio / least, f" ({ratio:.3f}, of the bound {least:.3f})"
    low, high = trial.limits.consistent
    slack = STANDARD_ERRORS * np.sqrt(2.0) * _se(few) * 0.5
    low, high = min(low, 0.5 - slack), max(high, 0.5 + slack)
    text = f"error of 4 N over that of N: {ratio:.3f}{found}, accepted {low:.2f} to {high:.2f}"
    return bool(low <= ratio <= high), text


def honest(trial: Trial) -> Verdict:
    """The mean NEES must be its dimension; intervals of 95 % must hold 95 %."""
    runs = _runs(trial, 1)
    dim = runs[0].rank
    nees = float(np.mean([r.nees / r.rank for r in runs]))
    low, high = trial.limits.honest
    slack = STANDARD_ERRORS * np.sqrt(2.0 / (dim * len(runs)))
    low, high = min(low, 1.0 - slack), max(high, 1.0 + slack)
    passed = low <= nees <= high
    text = f"NEES/{dim} {nees:.3f}, accepted {low:.2f} to {high:.2f}"
    inside = float(np.mean([np.abs(r.e) <= NORMAL_95 * np.sqrt(np.diag(r.C)) for r in runs]))
    text += f"; stated 95 % covers {100 * inside:.1f} %"
    if len(runs) >= ENOUGH:
        low, high = trial.limits.covered
        passed &= low <= inside <= high
    return bool(passed), text


def efficient(trial: Trial) -> Verdict:
    """The error must be that of the Cramer-Rao bound."""
    runs = _runs(trial, 1)
    bounds = [r.bound for r in runs if r.bound is not None]
    if len(bounds) < len(runs):
        return False, "no Cramer-Rao bound: give Experiment.bound, or skip with the reason"
    e = np.array([r.e for r in runs])
    variance = np.array([np.diag(bound) for bound in bounds])
    blocks = trial.blocks or {"all": range(e.shape[1])}
    parts, passed = [], True
    for name, which in blocks.items():
        index = list(which)
        scale = np.mean(variance[:, index], axis=0)
        ratio = float(np.sqrt(np.mean(e[:, index] ** 2 / scale) / np.mean(variance[:, index] / scale)))
        limit = trial.limits.efficient + STANDARD_ERRORS / np.sqrt(2.0 * len(index) * len(runs))
        passed &= ratio <= limit
        parts.append(f"{name} {ratio:.3f} (accepted {limit:.3f})")
    text = "error over the Cramer-Rao bound: " + ", ".join(parts)
    return (bool(passed), text) if len(runs) >= ENOUGH else (None, text + f"; judged from {ENOUGH} runs on")


def robust(trial: Trial) -> Verdict:
    """Five per cent of gross outliers must be flagged and do little harm."""
    if trial.spoil is None:
        return False, "no outliers to test with: give spoil, or skip with the reason"
    clean = _runs(trial, 1)
    W = _weight(clean)
    spoilt, missed, false, good, share = [], 0, 0, 0, 0.0
    for i in range(trial.runs):
        seed = trial.seed + i
        case = trial.experiment(seed, trial.n)
        data, bad = trial.spoil(dict(case.data), np.random.default_rng([seed, 1]))
        fit = trial.fit(**data)
        e, C = error_of(trial, fit, case.truth)
        spoilt.append(Run(e, C, fit.rank, case.bound))
        if bad is not None:
            flags = fit.outliers if fit.outliers.size else np.zeros(len(bad), dtype=bool)
            missed += int(np.sum(bad & ~flags))
            false += int(np.sum(~bad & flags))
            good += int(np.sum(~bad))
            share += float(np.mean(bad)) / trial.runs
    ratio = _rms(spoilt, W) / _rms(clean, W) * np.sqrt(1.0 - share)
    limit = trial.limits.robust + STANDARD_ERRORS * _se(clean)
    text = f"error over that without outliers {ratio:.3f}, accepted {limit:.2f}"
    if not good:
        return bool(ratio <= limit), text
    found = missed == 0 and false <= trial.limits.false * good
    text += f"; {missed} outliers missed, {100 * false / good:.2f} % of the good flagged"
    return bool(ratio <= limit and found), text
