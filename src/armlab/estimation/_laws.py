"""The properties of the contract that are laws: order, gauge, refusals, files, words, clean hands."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armlab import models
from armlab.errors import ModelMismatchError, NotExcited, ShapeError
from armlab.estimation._statistics import Trial, Verdict, error_of
from armlab.estimation.fit import Fit

SAME = 1e-9  # deviations of the estimate, or relative
SEEDS = 3
EXACT = ("parameters", "cov", "sigma", "outliers")


def order_free(trial: Trial) -> Verdict:
    """Samples in another order must give the same answer and flags."""
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
            return False, "no array with samples along axis 0: skip with the reason"
        first, second = trial.fit(**case.data), trial.fit(**mixed)
        worst = max(worst, _apart(trial, first, second, case.truth))
        if not np.array_equal(first.outliers[order] if first.outliers.size else first.outliers, second.outliers):
            return False, "other flags in another order of the samples"
    return worst <= SAME, f"permuted samples move the answer by {worst:.1e} deviations, accepted {SAME:.0e}"


def _apart(trial: Trial, first: Fit[Any], second: Fit[Any], truth: Any) -> float:
    """Return the step between two fits, in deviations of the estimate."""
    (a, C), (b, _) = error_of(trial, first, truth), error_of(trial, second, truth)
    return _length(b - a, C)


def _length(e: np.ndarray, C: np.ndarray) -> float:
    sd = np.sqrt(np.diag(C))
    sd = np.where(sd > 0, sd, 1.0)
    inverse = np.linalg.pinv(C / np.outer(sd, sd), rcond=SAME, hermitian=True)
    return float(np.sqrt(max((e / sd) @ inverse @ (e / sd), 0.0)))


def gauge_free(trial: Trial) -> Verdict:
    """Another frame or unit must change the answer as it must."""
    if not trial.gauges:
        return False, "no change of frame or unit to test with: give gauges, or skip with the reason"
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
    return bool(passed), f"change of the answer beyond what must be: {', '.join(parts)}, accepted {SAME:.0e}"


def _relative(e: np.ndarray, fit: Fit[Any]) -> float:
    """Return the largest error relative to its parameter; infinite where errors are not those of the parameters."""
    if e.shape != fit.parameters.shape:
        return np.inf
    return float(np.max(np.abs(e) / np.maximum(np.abs(fit.parameters), fit.sd)))


def refuses(trial: Trial) -> Verdict:
    """Data that do not tell a direction must be refused with its name."""
    if not trial.refusals:
        return False, "nothing that must be refused: give refusals, or skip with the reason"
    wrong = []
    for words, data in trial.refusals.items():
        try:
            trial.fit(**data)
            wrong.append(f"{words!r} was accepted")
        except NotExcited as error:
            if not any(words in direction for direction in error.directions):
                wrong.append(f"{words!r} was called {'; '.join(error.directions)}")
        except Exception as error:  # the wrong refusal is a finding
            wrong.append(f"{words!r} raised {type(error).__name__}")
    return not wrong, "; ".join(wrong) or f"{len(trial.refusals)} cases refused by name"


def saves(trial: Trial) -> Verdict:
    """A saved fit must come back bit-equal, and not as something else."""
    fit = trial.fit(**trial.experiment(trial.seed, trial.n).data)
    with tempfile.TemporaryDirectory() as folder:
        path = fit.save(Path(folder) / "fit.toml")
        again = Fit.load(path)
        changed = [name for name in EXACT if getattr(again, name).tobytes() != getattr(fit, name).tobytes()]
        pairs = zip(_arrays(fit.value), _arrays(again.value), strict=True)
        changed += [f"value{a}" for (a, x), (_, y) in pairs if x.tobytes() != y.tobytes() or x.shape != y.shape]
        if changed:
            return False, f"not bit-equal after a file: {', '.join(changed)}"
        try:
            models.load(path, kind="another kind")
        except ModelMismatchError:
            return True, "bit-equal after a file; another kind is refused"
    return False, "a file of another kind was accepted"


def explains(trial: Trial) -> Verdict:
    """The report must have unit and deviation of every value."""
    fit = trial.fit(**trial.experiment(trial.seed, trial.n).data)
    text = fit.report()
    missing = [name for name in fit.names if name not in text]
    missing += [unit for unit in dict.fromkeys(fit.units) if unit not in text]
    if missing:
        return False, f"not in the report: {', '.join(missing[:5])}"
    deviations = text.count("+-") + text.count("\N{PLUS-MINUS SIGN}")
    return deviations >= len(fit.names), f"{deviations} deviations for {len(fit.names)} values in the report"


def clean(trial: Trial) -> Verdict:
    """Inputs stay, outputs are read-only, the same input gives the same bits, NaN is refused with its row."""
    data = dict(trial.experiment(trial.seed, trial.n).data)
    before = [(name, array.tobytes()) for name, array in _arrays(data)]
    fit = trial.fit(**data)
    faults = [f"input {name} changed" for (name, bits), (_, now) in zip(before, _arrays(data)) if bits != now.tobytes()]
    faults += [f"output {name} can be written to" for name, array in _arrays(fit) if array.flags.writeable]
    again = trial.fit(**trial.experiment(trial.seed, trial.n).data)
    faults += [f"other bits of {n} twice" for n in EXACT if getattr(fit, n).tobytes() != getattr(again, n).tobytes()]
    faults += _nan_faults(trial)
    return not faults, "; ".join(faults) or "inputs unchanged, outputs read-only, same bits twice, NaN refused by row"


def _nan_faults(trial: Trial) -> list[str]:
    """Return what is wrong with the refusal of NaN in any array of samples."""
    row, faults, tried = trial.n // 2, [], 0
    for name, data in _with_nan(dict(trial.experiment(trial.seed, trial.n).data), trial.n, row):
        tried += 1
        try:
            trial.fit(**data)
            faults.append(f"NaN in {name} accepted")
        except ShapeError as error:
            if str(row) not in str(error):
                faults.append(f"NaN in {name} refused without its row")
        except Exception as error:  # the wrong refusal is a finding
            faults.append(f"NaN in {name} raised {type(error).__name__}")
    return faults if tried else ["no array of samples to put NaN into"]


def _with_nan(data: dict[str, Any], n: int, row: int) -> Iterator[tuple[str, dict[str, Any]]]:
    from armlab.log import Table  # fits need no logs: half the time of their import

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
    """Yield all arrays inside data or a result, with names."""
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
