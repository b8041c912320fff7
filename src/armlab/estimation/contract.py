"""Statistical contract of estimators: ten properties required of every `fit_*`, tested by one function.

The fit runs on many experiments with known ground truth, and the reported covariance C is compared with the actual
errors e. If C is correct, the normalised estimation error squared, NEES = e^T C^-1 e, averages to the number of
parameters (Bar-Shalom, Li and Kirubarajan 2001). The other properties concern sample order, units, error messages,
files and side effects.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armlab import models
from armlab._display import Shown
from armlab._numbers import flag, number
from armlab.errors import ConfigError, ModelMismatchError, NotExcited, ShapeError, UnknownName
from armlab.estimation.fit import Fit

Verdict = tuple[bool | None, str]

NORMAL_95 = 1.959963984540054
ENOUGH = 1000  # minimum number of runs for assessing coverage and efficiency, and for the benchmark limits
STANDARD_ERRORS = 3.0  # standard errors added to the limits for few runs
GAUGE = 1e-6  # component along an unidentifiable direction above which a parameter counts as gauge-dependent


@dataclass(frozen=True, eq=False)
class ContractTrial:
    """Arguments of `check_estimator`, and a cache of runs shared by several checks."""

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
    limits: ContractLimits
    done: dict[str, list[FitRun]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FitRun:
    """Error of one run, with the reported covariance in the same coordinates."""

    e: np.ndarray
    C: np.ndarray
    rank: int
    bound: np.ndarray | None

    @property
    def nees(self) -> float:
        """Squared error in the metric of the reported covariance, along identified directions only."""
        sd = _sd(self.C)
        values, vectors = np.linalg.eigh(self.C / np.outer(sd, sd))
        along = vectors.T @ (self.e / sd)
        identified = slice(len(values) - self.rank, None)
        return float(np.sum(along[identified] ** 2 / values[identified]))


def _sd(C: np.ndarray) -> np.ndarray:
    """Return the standard deviations of a covariance; 1 for zero variances."""
    sd = np.sqrt(np.diag(C))
    return np.where(sd > 0, sd, 1.0)


def error_of(trial: ContractTrial, fit: Fit[Any], truth: Any) -> tuple[np.ndarray, np.ndarray]:
    found = trial.error(fit, truth)
    e, C = found if isinstance(found, tuple) else (found, fit.cov)
    return np.atleast_1d(np.asarray(e, dtype=float)), np.asarray(C, dtype=float)


def _run(trial: ContractTrial, case: Experiment, fit: Fit[Any]) -> FitRun:
    return FitRun(*error_of(trial, fit, case.truth), fit.rank, case.bound)


def _runs(trial: ContractTrial, times: int) -> list[FitRun]:
    """Return the runs with `times` as many samples, cached after the first call."""
    key = f"runs {times}"
    if key not in trial.done:
        seeds = range(trial.seed, trial.seed + trial.runs)
        cases = (trial.experiment(seed, times * trial.n) for seed in seeds)
        trial.done[key] = [_run(trial, case, trial.fit(**case.data)) for case in cases]
    return trial.done[key]


def _weight(runs: list[FitRun]) -> np.ndarray:
    """Return the inverse of the mean reported covariance, which makes errors with different units comparable."""
    C = np.mean([r.C for r in runs], axis=0)
    sd = _sd(C)
    return np.linalg.pinv(C / np.outer(sd, sd), rcond=1e-9, hermitian=True) / np.outer(sd, sd)


def _rms(runs: list[FitRun], W: np.ndarray) -> float:
    return float(np.sqrt(np.mean([r.e @ W @ r.e for r in runs])))


def _bound(runs: list[FitRun], W: np.ndarray) -> float:
    return float(np.mean([np.vdot(W, r.bound) for r in runs if r.bound is not None]))


def _se(runs: list[FitRun]) -> float:
    """Return the relative standard error of an RMS over the runs."""
    return 1.0 / np.sqrt(2.0 * runs[0].rank * len(runs))


def consistent(trial: ContractTrial) -> Verdict:
    """With four times as many samples, the error halves or, if a Cramer-Rao bound is given, decreases in proportion to
    the bound."""
    few, many = _runs(trial, 1), _runs(trial, 4)
    W = _weight(few)
    ratio, found = _rms(many, W) / _rms(few, W), ""
    if all(r.bound is not None and r.bound.shape == W.shape for r in (*few, *many)):
        least = np.sqrt(_bound(many, W) / _bound(few, W))
        ratio, found = 0.5 * ratio / least, f" (measured {ratio:.3f}, bound {least:.3f})"
    low, high = trial.limits.consistent
    slack = STANDARD_ERRORS * np.sqrt(2.0) * _se(few) * 0.5
    low, high = min(low, 0.5 - slack), max(high, 0.5 + slack)
    text = f"error ratio for 4 N versus N samples: {ratio:.3f}{found}, accepted {low:.2f} to {high:.2f}"
    return bool(low <= ratio <= high), text


def honest(trial: ContractTrial) -> Verdict:
    """The mean NEES equals the number of identified directions, and 95 % intervals contain 95 % of the true values."""
    runs = _runs(trial, 1)
    dim = runs[0].rank
    nees = float(np.mean([r.nees / r.rank for r in runs]))
    low, high = trial.limits.honest
    slack = STANDARD_ERRORS * np.sqrt(2.0 / (dim * len(runs)))
    low, high = min(low, 1.0 - slack), max(high, 1.0 + slack)
    passed = low <= nees <= high
    text = f"NEES/{dim} {nees:.3f}, accepted {low:.2f} to {high:.2f}"
    inside = float(np.mean([np.abs(r.e) <= NORMAL_95 * np.sqrt(np.diag(r.C)) for r in runs]))
    text += f"; 95 % intervals contain {100 * inside:.1f} %"
    if len(runs) >= ENOUGH:
        low, high = trial.limits.covered
        passed &= low <= inside <= high
    return bool(passed), text


def efficient(trial: ContractTrial) -> Verdict:
    """The error reaches the Cramer-Rao bound."""
    runs = _runs(trial, 1)
    bounds = [r.bound for r in runs if r.bound is not None]
    if len(bounds) < len(runs):
        return False, "no Cramer-Rao bound: set Experiment.bound, or skip with a reason"
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
        parts.append(f"{name} {ratio:.3f} (limit {limit:.3f})")
    text = "ratio of the error to the Cramer-Rao bound: " + ", ".join(parts)
    return (bool(passed), text) if len(runs) >= ENOUGH else (None, text + f"; assessed only with {ENOUGH} or more runs")


def robust(trial: ContractTrial) -> Verdict:
    """Gross outliers in 5 % of the samples are flagged and have little effect."""
    if trial.spoil is None:
        return False, "no outliers to test with: pass spoil, or skip with a reason"
    clean = _runs(trial, 1)
    W = _weight(clean)
    spoilt, missed, false, good, share = [], 0, 0, 0, 0.0
    for i in range(trial.runs):
        seed = trial.seed + i
        case = trial.experiment(seed, trial.n)
        data, bad = trial.spoil(dict(case.data), np.random.default_rng([seed, 1]))
        fit = trial.fit(**data)
        spoilt.append(_run(trial, case, fit))
        if bad is not None:
            flags = fit.outliers if fit.outliers.size else np.zeros(len(bad), dtype=bool)
            missed += int(np.sum(bad & ~flags))
            false += int(np.sum(~bad & flags))
            good += int(np.sum(~bad))
            share += float(np.mean(bad)) / trial.runs
    ratio = _rms(spoilt, W) / _rms(clean, W) * np.sqrt(1.0 - share)
    limit = trial.limits.robust + STANDARD_ERRORS * _se(clean)
    text = f"error relative to the fit without outliers {ratio:.3f}, accepted {limit:.2f}"
    if not good:
        return bool(ratio <= limit), text
    found = missed == 0 and false <= trial.limits.false * good
    text += f"; {missed} outliers missed, {100 * false / good:.2f} % of good samples flagged"
    return bool(ratio <= limit and found), text


SAME, SEEDS = 1e-9, 3  # largest accepted change, in standard deviations or relative; number of experiments
EXACT = ("parameters", "cov", "sigma", "outliers")


def order_free(trial: ContractTrial) -> Verdict:
    """Permuted samples give the same estimate and the same outliers."""
    worst = 0.0
    for seed in range(trial.seed, trial.seed + SEEDS):
        case = trial.experiment(seed, trial.n)
        order = np.random.default_rng([seed, 2]).permutation(trial.n)
        mixed, changed = dict(case.data), 0
        for name, value in case.data.items():
            if isinstance(value, np.ndarray) and value.shape[:1] == (trial.n,):
                mixed[name] = value[order]
                changed += 1
        if not changed:
            return False, "no array with samples along axis 0: skip with a reason"
        first, second = trial.fit(**case.data), trial.fit(**mixed)
        (a, C), (b, _) = error_of(trial, first, case.truth), error_of(trial, second, case.truth)
        worst = max(worst, _length(b - a, C))
        if not np.array_equal(first.outliers[order] if first.outliers.size else first.outliers, second.outliers):
            return False, "flags depend on the order of the samples"
    text = f"permuting the samples changes the estimate by {worst:.1e} standard deviations, accepted {SAME:.0e}"
    return worst <= SAME, text


def _length(e: np.ndarray, C: np.ndarray) -> float:
    sd = _sd(C)
    inverse = np.linalg.pinv(C / np.outer(sd, sd), rcond=SAME, hermitian=True)
    return float(np.sqrt(max((e / sd) @ inverse @ (e / sd), 0.0)))


def gauge_free(trial: ContractTrial) -> Verdict:
    """The estimate transforms correctly under a change of frame or unit."""
    if not trial.gauges:
        return False, "no change of frame or unit to test with: pass gauges, or skip with a reason"
    parts, passed = [], True
    for gauge in trial.gauges:
        worst = 0.0
        for seed in range(trial.seed, trial.seed + SEEDS):
            data = dict(trial.experiment(seed, trial.n).data)
            there = trial.fit(**gauge.change(dict(data)))
            e, C = error_of(trial, there, gauge.expect(trial.fit(**data)))
            worst = max(worst, min(_length(e, C), _relative(e, there)))
        passed &= worst <= SAME
        parts.append(f"{gauge.name} {worst:.1e}")
    return bool(passed), f"deviation from the expected transformation: {', '.join(parts)}, accepted {SAME:.0e}"


def _relative(e: np.ndarray, fit: Fit[Any]) -> float:
    """Return the largest relative parameter error; infinity if the errors are not in parameter
    coordinates."""
    if e.shape != fit.parameters.shape:
        return np.inf
    return float(np.max(np.abs(e) / np.maximum(np.abs(fit.parameters), fit.sd)))


def refuses(trial: ContractTrial) -> Verdict:
    """For data that leave a direction undetermined, the fit raises NotExcited and names the direction."""
    if not trial.refusals:
        return False, "no data without excitation available for the test: pass refusals, or skip the test with a reason"
    wrong = []
    for words, data in trial.refusals.items():
        try:
            trial.fit(**data)
            wrong.append(f"{words!r} was accepted")
        except NotExcited as error:
            if not any(words in direction for direction in error.directions):
                wrong.append(f"{words!r} was reported as {'; '.join(error.directions)}")
        except Exception as error:  # any other exception is reported as a failure
            wrong.append(f"{words!r} raised {type(error).__name__}")
    return not wrong, "; ".join(wrong) or f"{len(trial.refusals)} cases raise NotExcited naming the direction"


def saves(trial: ContractTrial) -> Verdict:
    """A saved fit is restored bit-identically; loading it as a different kind fails."""
    fit = trial.fit(**trial.experiment(trial.seed, trial.n).data)
    with tempfile.TemporaryDirectory() as folder:
        path = fit.save(Path(folder) / "fit.toml")
        again = Fit.load(path)
        changed = [name for name in EXACT if getattr(again, name).tobytes() != getattr(fit, name).tobytes()]
        pairs = zip(_arrays(fit.value), _arrays(again.value), strict=True)
        changed += [f"value{a}" for (a, x), (_, y) in pairs if x.tobytes() != y.tobytes() or x.shape != y.shape]
        if changed:
            return False, f"changed by saving and loading: {', '.join(changed)}"
        try:
            models.load(path, kind="another kind")
        except ModelMismatchError:
            return True, "bit-identical after saving and loading; a different kind raises an error"
    return False, "a file of a different kind was accepted"


def explains(trial: ContractTrial) -> Verdict:
    """The report contains the unit and the standard deviation of every value."""
    fit = trial.fit(**trial.experiment(trial.seed, trial.n).data)
    text = fit.report()
    null = fit.excitation.null_space  # gauge-dependent values are meaningless
    shown = ~np.any(np.abs(null) > GAUGE, axis=1) if null.size else np.ones(len(fit.names), dtype=bool)
    missing = [name for name, needed in zip(fit.names, shown) if needed and name not in text]
    missing += [unit for unit, needed in zip(fit.units, shown) if needed and unit not in text]
    if missing:
        return False, f"not in the report: {', '.join(missing[:5])}"
    deviations = text.count("+-") + text.count("\N{PLUS-MINUS SIGN}")
    return deviations >= shown.sum(), f"{deviations} standard deviations for {shown.sum()} values in the report"


def clean(trial: ContractTrial) -> Verdict:
    """Inputs stay unchanged, outputs are read-only, results are reproducible, and errors name the row of a NaN."""
    data = dict(trial.experiment(trial.seed, trial.n).data)
    before = [(name, array.tobytes()) for name, array in _arrays(data)]
    fit = trial.fit(**data)
    faults = [f"input {name} changed" for (name, bits), (_, now) in zip(before, _arrays(data)) if bits != now.tobytes()]
    faults += [f"output {name} is writeable" for name, array in _arrays(fit) if array.flags.writeable]
    again = trial.fit(**trial.experiment(trial.seed, trial.n).data)
    faults += [f"{n} is not reproducible" for n in EXACT if getattr(fit, n).tobytes() != getattr(again, n).tobytes()]
    faults += _nan_faults(trial)
    good = "inputs unchanged, outputs read-only, results bit-identical, and an error names the row of a NaN"
    return not faults, "; ".join(faults) or good


def _nan_faults(trial: ContractTrial) -> list[str]:
    """Return the faults of the fit for sample arrays that contain NaN."""
    row, faults, tried = trial.n // 2, [], 0
    for name, data in _with_nan(dict(trial.experiment(trial.seed, trial.n).data), trial.n, row):
        tried += 1
        try:
            trial.fit(**data)
            faults.append(f"NaN in {name} accepted")
        except ShapeError as error:
            if str(row) not in str(error):
                faults.append(f"NaN in {name} raised an error that does not name the row")
        except Exception as error:  # any other exception is a finding
            faults.append(f"NaN in {name} raised {type(error).__name__}")
    return faults if tried else ["no array of samples available for the NaN test"]


def _with_nan(data: dict[str, Any], n: int, row: int) -> Iterator[tuple[str, dict[str, Any]]]:
    from armlab.log import Table  # a top-level import would double the import time of estimation

    for name, value in data.items():
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.shape[:1] == (n,):
            spoilt = value.copy()
            spoilt[row] = np.nan
            yield name, {**data, name: spoilt}
        if isinstance(value, Table):
            for column in value.names:
                if value[column].dtype.kind == "f":
                    spoilt = value[column].copy()
                    spoilt[row] = np.nan
                    yield f"{name}[{column!r}]", {**data, name: value.with_column(column, spoilt)}


def _arrays(item: Any, name: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Yield all arrays in the data or in a result, with their names."""
    from armlab.log import Table

    if isinstance(item, np.ndarray):
        yield name, item
    elif isinstance(item, Table):
        yield from ((f"{name}[{column!r}]", item[column]) for column in item.names)
    elif isinstance(item, dict):
        for key, part in item.items():
            yield from _arrays(part, f"{name}.{key}" if name else str(key))
    elif isinstance(item, (list, tuple)):
        for i, part in enumerate(item):
            yield from _arrays(part, f"{name}[{i}]")
    elif is_dataclass(item) and not isinstance(item, type):
        for one in fields(item):
            yield from _arrays(getattr(item, one.name), f"{name}.{one.name}" if name else one.name)


JUDGES = {
    "consistent": consistent, "honest": honest, "efficient": efficient, "order-free": order_free,
    "gauge-free": gauge_free, "refuses": refuses, "robust": robust, "saves": saves, "explains": explains,
    "clean": clean,
}  # fmt: skip
PROPERTIES = tuple(JUDGES)

Error = Callable[[Fit[Any], Any], Any]
Spoil = Callable[[dict[str, Any], np.random.Generator], tuple[dict[str, Any], np.ndarray | None]]


@dataclass(frozen=True, eq=False, repr=False)
class Experiment(Shown):
    """Experiment with known ground truth, for `check_estimator`.

    Attributes
    ----------
    data : keyword arguments of the fit: arrays with samples along axis 0, Tables, noise and options.
    truth : expected parameters (d,) of the fit, or any value that the function `error` accepts.
    bound : (d, d) Cramer-Rao bound of the errors; required to assess efficiency.
    """

    data: Mapping[str, Any]
    truth: Any
    bound: np.ndarray | None = None


@dataclass(frozen=True, repr=False)
class Gauge(Shown):
    """Change of frame or unit with a known effect on the estimate.

    Attributes
    ----------
    name : description.
    change : function that returns the data in other frames or units.
    expect : function that maps the fit of the original data to the expected result for the changed data.
    """

    name: str
    change: Callable[[dict[str, Any]], dict[str, Any]]
    expect: Callable[[Fit[Any]], Any]


@dataclass(frozen=True, repr=False)
class ContractLimits(Shown):
    """Acceptance limits of the contract.

    For few runs, two-sided limits widen to three standard errors. One-sided limits are widened by three standard
    errors.

    Attributes
    ----------
    consistent : ratio of the error with 4 N samples to the error with N samples.
    honest : NEES divided by its dimension.
    covered : coverage of the reported 95 % intervals.
    efficient : ratio of the error to the Cramer-Rao bound.
    robust : ratio of the error with 5 % outliers to the error with only the good samples.
    false : largest fraction of good samples that may be flagged as outliers.
    """

    consistent: tuple[float, float] = (0.40, 0.60)
    honest: tuple[float, float] = (0.80, 1.25)
    covered: tuple[float, float] = (0.93, 0.97)
    efficient: float = 1.05
    robust: float = 1.25
    false: float = 0.005

    @classmethod
    def of(cls, runs: int, noise_given: bool) -> ContractLimits:
        """Return the limits of the test suite or, for at least 1000 runs, of the benchmark.

        Parameters
        ----------
        runs : number of runs.
        noise_given : False if the fit estimates the noise, which increases the NEES.
        """
        noise_given = flag(noise_given, "noise_given")
        if number(runs, "the number of runs") < ENOUGH:
            return cls(honest=(0.80, 1.25 if noise_given else 1.30))
        return cls((0.44, 0.54), (0.95, 1.05 if noise_given else 1.10), robust=1.06)


@dataclass(frozen=True)
class Property:
    """Property of the contract; `passed` is None if it was not checked."""

    name: str
    passed: bool | None
    text: str


@dataclass(frozen=True, repr=False)
class Contract(Shown):
    """Result of `check_estimator`.

    Attributes
    ----------
    properties : results for all ten properties.
    runs : number of experiments.
    """

    properties: tuple[Property, ...]
    runs: int

    @property
    def passed(self) -> bool:
        """Whether all checked properties passed."""
        return all(one.passed is not False for one in self.properties)

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the properties that failed."""
        return tuple(one.name for one in self.properties if one.passed is False)

    def __getitem__(self, name: str) -> Property:
        for one in self.properties:
            if one.name == name:
                return one
        raise UnknownName.among("property", name, PROPERTIES)

    def text(self) -> str:
        """Return one line per property, with verdict, name and measured values."""
        verdicts = {True: "passed", False: "FAILED", None: "-"}
        lines = [f"{verdicts[one.passed]:7s}{one.name:11s} {one.text}" for one in self.properties]
        return "\n".join([*lines, f"{self.runs} runs"])


def difference(fit: Fit[Any], truth: Any) -> np.ndarray:
    """Return the parameter error (d,) of a fit, given the true parameters (d,)."""
    return fit.parameters - np.asarray(truth)


def check_estimator(
    fit: Callable[..., Fit[Any]],
    experiment: Callable[[int, int], Experiment],
    runs: int = 200,
    *,
    n: int = 50,
    error: Error = difference,
    blocks: Mapping[str, Sequence[int]] | None = None,
    gauges: Sequence[Gauge] = (),
    refusals: Mapping[str, Mapping[str, Any]] | None = None,
    spoil: Spoil | None = None,
    noise_given: bool = True,
    limits: ContractLimits | None = None,
    skip: Mapping[str, str] | None = None,
    seed: int = 0,
) -> Contract:
    """Test a fit against the ten properties of the statistical contract; the result lists the failures.

    Parameters
    ----------
    fit : function that takes `Experiment.data` as keyword arguments and returns a `Fit`.
    experiment : function of (seed, n) that returns an `Experiment` of n samples; equal seeds give equal experiments.
    runs : number of experiments. With at least 1000 runs, narrower benchmark limits apply and efficiency is assessed.
    n : number of samples per experiment; the consistency test also runs experiments with 4 n samples.
    error : function of (fit, truth) that returns the error (d,) in the coordinates of `fit.cov`, or an error (m,) and
        its covariance (m, m). If `fit.cov` is rank-deficient, return for example the errors at validation poses.
    blocks : indices of error components whose efficiency is assessed separately, keyed by name; default: the whole
        error.
    gauges : changes of frame or unit to test.
    refusals : data for which the fit must raise `NotExcited`, keyed by words that the name of a direction must contain.
    spoil : function of (data, rng) that returns the data with 5 % gross outliers and outlier detection enabled, and the
        outlier mask (N,); the mask is None if the fit does not flag outliers.
    noise_given : False if the fit estimates the noise; NEES then exceeds 1 by about 2 / (degrees of freedom).
    limits : acceptance limits; default: `ContractLimits.of` for this number of runs.
    skip : reasons for skipping properties, keyed by property name.
    seed : seed of the first experiment.

    Raises
    ------
    UnknownName : `skip` names an unknown property.
    ConfigError : a reason is missing.
    """
    reasons = dict(skip or {})
    for name, reason in reasons.items():
        if name not in PROPERTIES:
            raise UnknownName.among("property", name, PROPERTIES)
        if not reason.strip():
            raise ConfigError(f"Expected a reason for skipping {name!r}, got an empty string. Give the reason.")
    accepted = limits or ContractLimits.of(runs, noise_given)
    trial = ContractTrial(fit, experiment, runs, n, seed, error, blocks or {}, gauges, refusals or {}, spoil, accepted)
    found = []
    for name, judge in JUDGES.items():
        try:
            verdict = (None, f"skipped: {reasons[name]}") if name in reasons else judge(trial)
        except Exception as fault:  # any exception raised by a fit is reported as a failure
            verdict = False, f"raised {type(fault).__name__}: {fault}"
        found.append(Property(name, *verdict))
    return Contract(tuple(found), runs)
