"""Maximum likelihood on manifolds with unknown noise and outliers: what `fit_*` of calibrations call.

Noise that is not given is estimated per class c of measurement, in whitened quantities,

    sigma_c^2 <- sigma_c^2 r_c^T r_c / (n_c - trace(J_c P J_c^T))

until it stays. With `robust` a graduated Geman-McClure loss over whole samples comes first, weight
``(c^2 / (c^2 + rho^2))^2`` with c shrinking; then samples with rho^2 beyond the 99.9 % quantile are flagged and left
out, and the rest is fitted by plain maximum likelihood, whose covariance is the one returned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from armlab.errors import NotExcited
from armlab.estimation.descent import Descent, Problem, descend
from armlab.estimation.measurements import Measurement, Whitened, median_norm, whiten

__all__ = ["SCHEDULE", "NonlinearSolution", "nonlinear_least_squares"]

Value = TypeVar("Value")

SCHEDULE = (200.0, 60.0, 20.0, 10.0)
UNKNOWN_NOISE = (1000.0, 10.0, 5.0, 5.0)
NARROW = 3  # last values of c that are left of a start that is near
REWEIGHTED = 20  # iterations per c
NEXT = 1e-2  # step in deviations below which c shrinks
SETTLED = 1e-6  # relative change of sigma
NOISE_ROUNDS = 20
MIXED_ROUNDS = 100  # it converges the slower, the larger the part that is known
FLAGGED = 0.999  # quantile of chi^2 beyond which a sample is an outlier
FLAG_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class NonlinearSolution(Generic[Value]):
    """A fitted value with its uncertainty.

    Attributes
    ----------
    value : the most likely one. cov : (d, d) covariance of a step away from it, zero along what nothing tells.
    classes : names of the noise classes. sigma : their deviations found, degrees of freedom subtracted.
    outliers : (N,) samples that were left out. squares : (N,) whitened squared residual of every sample.
    rows : whitened rows of the samples kept, at the value.
    null : (d, m) orthonormal directions, in units of the scale, that neither data nor prior tell.
    cost : half the whitened sum of squares. freedom : rows minus rank.
    history : cost after each iteration of the last descent.
    """

    value: Value
    cov: np.ndarray
    classes: tuple[str, ...]
    sigma: np.ndarray
    outliers: np.ndarray
    squares: np.ndarray
    rows: Whitened
    null: np.ndarray
    cost: float
    freedom: int
    history: tuple[float, ...]

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for name in ("cov", "sigma", "outliers", "squares", "null"):
            values = np.array(getattr(self, name))
            values.flags.writeable = False
            object.__setattr__(self, name, values)


def nonlinear_least_squares(
    problem: Problem[Value],
    start: Value,
    *,
    robust: bool = False,
    schedule: Sequence[float] = SCHEDULE,
    near: bool = False,
) -> NonlinearSolution[Value]:
    """Fit a value on a manifold by maximum likelihood.

    Parameters
    ----------
    problem : residuals with Jacobian, and retraction. Measurements without covariance have their noise estimated.
    start : first value.
    robust : find outliers among the samples; `outliers` marks them.
    schedule : values of c of the graduated loss, in deviations, for given noise.
    near : the start is that of the good samples: the loss begins narrow, where outliers cannot lead away from it.

    Raises
    ------
    NotConverged : the descent did not. NotExcited : fewer numbers than unknowns, outliers left out.

    References
    ----------
    Geman and McClure (1987); Yang, Antonante, Tzoumas and Carlone (2020), Graduated non-convexity.
    """
    problem = replace(problem, evaluate=_remembering(problem.evaluate))
    now = problem.evaluate(start)
    count = 1 + max(int(one.sample.max(initial=-1)) for one in now if not one.prior)
    sigma = _first_noise(now, problem.residue)
    weight = np.ones(count)
    if robust:
        steps = UNKNOWN_NOISE if sigma else schedule
        start, sigma, weight = _graduate(problem, start, sigma, weight, steps[-NARROW:] if near else steps)
    found, sigma = _with_noise(problem, start, sigma, weight)
    for _ in range(FLAG_ROUNDS if robust else 0):
        fresh = _fits(problem, found.value, sigma, count)
        if np.array_equal(fresh, weight):
            break
        weight = fresh
        found, sigma = _with_noise(problem, found.value, sigma, weight)
    return _solution(problem, found, sigma, weight)


def _remembering(evaluate: Callable[[Value], Sequence[Measurement]]) -> Callable[[Value], Sequence[Measurement]]:
    """Return `evaluate` that does not work twice in a row for the same object."""
    last: list[tuple[Value, Sequence[Measurement]]] = []

    def remembered(value: Value) -> Sequence[Measurement]:
        if not last or last[0][0] is not value:
            last[:] = [(value, evaluate(value))]
        return last[0][1]

    return remembered


def _first_noise(now: Sequence[Measurement], residue: float) -> dict[str, float]:
    """Return the root mean square of each class whose noise is not given."""
    found: dict[str, list[np.ndarray]] = {}
    for one in now:
        for column, name in enumerate(one.classes if one.cov is None else ()):
            found.setdefault(name, []).append(one.r[:, column])
    parts = {name: np.concatenate(part) for name, part in found.items()}
    return {name: max(float(np.sqrt(np.mean(part**2))), residue) for name, part in parts.items()}


def _graduate(
    problem: Problem[Value], value: Value, sigma: dict[str, float], weight: np.ndarray, schedule: Sequence[float]
) -> tuple[Value, dict[str, float], np.ndarray]:
    """Shrink the loss; return value, noise, and which samples (N,) fit at the end, as 0 or 1."""
    count = len(weight)
    for c in schedule:
        for _ in range(REWEIGHTED):
            rows = _rows(problem, value, sigma)
            if sigma:
                sigma = _median_noise(rows, sigma, problem.residue)
                rows = _rows(problem, value, sigma)
            weight = (c * c / (c * c + rows.squares(count))) ** 2
            found = descend(problem, value, sigma, weight, iterations=1, strict=False)
            value = found.value
            if found.step < NEXT:
                break
    return value, sigma, _fits(problem, value, sigma, count)


def _rows(problem: Problem[Value], value: Value, sigma: dict[str, float]) -> Whitened:
    now = problem.evaluate(value)
    return whiten(now, [one.roots(sigma) for one in now])


def _median_noise(rows: Whitened, sigma: dict[str, float], residue: float) -> dict[str, float]:
    """Return the deviation of each class from the median length of its residual, which outliers do not move."""
    found = {}
    for name in sigma:
        mine = rows.label == rows.names.index(name)
        numbers = np.bincount(rows.sample[mine])
        length = np.sqrt(np.bincount(rows.sample[mine], rows.raw[mine] ** 2))[numbers > 0]
        typical = median_norm(int(np.median(numbers[numbers > 0])))
        found[name] = max(float(np.median(length)) / typical, residue)
    return found


def _fits(problem: Problem[Value], value: Value, sigma: dict[str, float], count: int) -> np.ndarray:
    """Return 1 for samples (N,) whose squared residual is below the 99.9 % quantile, else 0."""
    from scipy.special import chdtri

    rows = _rows(problem, value, sigma)
    return (rows.squares(count) <= chdtri(np.maximum(rows.numbers(count), 1), 1.0 - FLAGGED)).astype(float)


def _with_noise(
    problem: Problem[Value], value: Value, sigma: dict[str, float], weight: np.ndarray
) -> tuple[Descent[Value], dict[str, float]]:
    """Alternate between the value and the noise of its classes."""
    found = descend(problem, value, sigma, weight)
    mixed = _is_mixed(found)
    for _ in range((MIXED_ROUNDS if mixed else NOISE_ROUNDS) if sigma else 0):
        before = sigma
        sizes = _mixed_sigma(found, sigma) if mixed else _class_sigma(found)
        sigma = {name: max(sizes[found.rows.names.index(name)], problem.residue) for name in before}
        found = descend(problem, found.value, sigma, weight)
        if all(abs(sigma[name] - before[name]) <= SETTLED * before[name] for name in sigma):
            break
    return found, sigma


def _class_sigma(found: Descent[Any]) -> np.ndarray:
    """Return the deviation (classes,) of the residuals in SI, each class with the degrees of freedom it has left."""
    rows, count = found.rows, 1 + len(found.rows.names)
    label, seen = rows.label + 1, rows.J @ found.basis  # priors are class 0
    left = np.bincount(label, minlength=count) - np.bincount(label, np.einsum("ij,ij->i", seen, seen), count)
    return np.sqrt(np.bincount(label, rows.raw**2, count) / np.maximum(left, np.finfo(float).eps))[1:]


def _is_mixed(found: Descent[Any]) -> bool:
    return any(one.added is not None for one in found.rows.measurements)


def _mixed_sigma(found: Descent[Any], sigma: dict[str, float]) -> np.ndarray:
    """Return the next deviation (classes,) where another part of the noise, S_i - diag(sigma^2), is known.

        sigma_c^2 <- sigma_c^2 sum_c (S^-1 r)^2 / (sum_c diag(S^-1) - |S^-1 J basis|^2)

    It is the law of whole classes where no other part is there; r of the last minimum, sums over the rows of class c.
    """
    rows, start = found.rows, 0
    kept = slice(None) if rows.kept is None else rows.kept
    whole = np.zeros((sum(one.r.size for one in rows.measurements), 1 + found.basis.shape[1]))
    whole[kept, 0], whole[kept, 1:] = rows.r, rows.J @ found.basis
    there = np.zeros(len(whole), dtype=bool)
    there[kept] = True
    above, below = (dict.fromkeys(rows.names, 0.0) for _ in range(2))
    for one in rows.measurements:
        m, k = one.r.shape
        part, used = whole[start : start + m * k].reshape(m, k, -1), there[start : start + m * k].reshape(m, k)
        start += m * k
        if one.cov is not None:
            continue
        root = one.roots(sigma)
        root = np.diag(root) if root.ndim == 1 else root
        back = np.swapaxes(root, -1, -2) @ part
        trace = np.broadcast_to(np.sum(root**2, axis=-2), (m, k)) * used.any(axis=1, keepdims=True)
        for column, name in enumerate(one.classes):
            above[name] += float(np.sum(back[:, column, 0] ** 2))
            below[name] += float(np.sum(trace[:, column]) - np.sum(back[:, column, 1:] ** 2))
    ratio = [above[name] / max(below[name], np.finfo(float).tiny) for name in rows.names]
    return np.array([sigma.get(name, np.nan) for name in rows.names]) * np.sqrt(ratio)


def _solution(
    problem: Problem[Value], found: Descent[Value], sigma: dict[str, float], weight: np.ndarray
) -> NonlinearSolution[Value]:
    rows, rank = found.rows, found.basis.shape[1]
    freedom = len(rows.r) - rank
    if freedom < 0 or (sigma and freedom < 1):
        raise NotExcited(
            f"Expected at least {rank + bool(sigma)} numbers to fit the {problem.what}, got {len(rows.r)} "
            f"({int(np.sum(weight == 0))} samples left out). Measure more samples.",
            ["everything"],
            [f"{len(rows.r)} numbers"],
        )
    return NonlinearSolution(
        value=found.value,
        cov=found.basis @ found.basis.T,
        classes=rows.names,
        sigma=np.array([sigma.get(n, np.nan) for n in rows.names]) if _is_mixed(found) else _class_sigma(found),
        outliers=weight == 0,
        squares=(rows if np.all(weight == 1.0) else _rows(problem, found.value, sigma)).squares(len(weight)),
        rows=rows,
        null=found.null,
        cost=found.history[-1],
        freedom=freedom,
        history=found.history,
    )
