"""Maximum likelihood on manifolds with unknown noise and outliers: what `fit_*` of calibrations call.

Noise that is not given is estimated per class c of measurement, in whitened quantities,

    sigma_c^2 <- sigma_c^2 r_c^T r_c / (n_c - trace(J_c P J_c^T))

until it stays. With `robust` a graduated Geman-McClure loss over whole samples comes first, weight
``(c^2 / (c^2 + rho^2))^2`` with c shrinking; then samples with rho^2 beyond the 99.9 % quantile are flagged and left
out, and the rest is fitted by plain maximum likelihood, whose covariance is the one returned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from armlab._numbers import make_read_only
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation.linear_problem import student_factor
from armlab.estimation.residual_tests import (
    ResidualCheck,
    Series,
    check_residuals,
    correlated_information,
)
from armlab.estimation.robust import majority_step
from armlab.estimation.tsqr import triangle


@dataclass(frozen=True, eq=False)
class Measurement:
    """Residuals of one kind of measurement at one value of the unknowns.

    Attributes
    ----------
    r : (m, k) residuals in SI, k numbers for each of m measurements.
    J : (m, k, d) their derivatives with respect to a step of `retract`.
    cov : (k,) variances, or (k, k) or (m, k, k) covariance of r; None when the noise is to be estimated, a deviation
        per class.
    classes : name of the noise class of each of the k numbers, for example ("t", "t", "t", "R", "R", "R").
    sample : (m,) number of the sample (pose, scan, point) that each measurement belongs to; 0 to m - 1 when left out.
        Outliers are found by samples.
    prior : True for what was known before: it is no sample, cannot be an outlier and does not enter the noise estimate.
    added : (k, k) or (m, k, k) covariance of a part of the noise that is known, beside the part that is to be
        estimated; None for none.
    """

    r: np.ndarray
    J: np.ndarray
    cov: np.ndarray | None
    classes: tuple[str, ...]
    sample: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    prior: bool = False
    added: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("r", "J", "sample", *(("cov",) if self.cov is not None else ())):
            if not isinstance(getattr(self, name), np.ndarray):
                raise ShapeError(f"Expected {name} of a measurement as a NumPy array. This is a fault of the residual.")
        m, k = self.r.shape if self.r.ndim == 2 else (0, 0)
        given = None if self.cov is None else self.cov.shape
        if not self.sample.size:
            object.__setattr__(self, "sample", np.arange(m))
        fits = self.r.ndim == 2 and self.J.shape[:2] == (m, k) and self.J.ndim == 3 and len(self.classes) == k
        if not fits or given not in (None, (k,), (k, k), (m, k, k)) or self.sample.shape != (m,):
            raise ShapeError(
                "Expected r (m, k), J (m, k, d), cov (k,), (k, k) or (m, k, k), k classes and sample (m,), got "
                f"{self.r.shape}, {self.J.shape}, {given}, {len(self.classes)} and {self.sample.shape}. "
                "This is a fault of the residual."
            )
        beside = None if self.added is None else self.added.shape
        if beside not in (None, (k, k), (m, k, k)) or (beside is not None and self.cov is not None):
            raise ShapeError(
                f"Expected added ({k}, {k}) or ({m}, {k}, {k}) beside noise that is estimated, got {beside}. "
                "This is a fault of the residual."
            )
        if self.prior and self.cov is None:
            raise ShapeError("Expected the covariance of a prior, got None. Say how surely it is known.")

    def roots(self, sigma: dict[str, float]) -> np.ndarray:
        """Return the whitening factor: the inverse of the Cholesky factor of the covariance.

        (k, k) or (m, k, k); (k,), its diagonal, where the numbers are independent.

        Parameters
        ----------
        sigma : deviation of each class whose noise is estimated.
        """
        if self.cov is None and self.added is None:
            return np.array([1.0 / sigma[name] for name in self.classes])
        if self.cov is None:
            return np.linalg.inv(np.linalg.cholesky(self.added + np.diag([sigma[name] ** 2 for name in self.classes])))
        if self.cov.ndim == 1 and np.all(self.cov > 0):
            return 1.0 / np.sqrt(self.cov)
        try:
            return np.linalg.inv(np.linalg.cholesky(np.diag(self.cov) if self.cov.ndim == 1 else self.cov))
        except np.linalg.LinAlgError:
            raise ShapeError(
                "Expected noise with a positive definite covariance, got one that is not. Give standard deviations "
                "above zero."
            ) from None

    def whitened(self, root: np.ndarray) -> np.ndarray:
        """Return the residuals (m, k) times their whitening factor, from `roots`."""
        return self.r * root if root.ndim == 1 else (root @ self.r[:, :, None])[:, :, 0]


@dataclass(frozen=True, eq=False)
class Whitened:
    """Whitened rows of all measurements: r (M,), J (M, d); `kept` marks those that were not left out, None for all."""

    r: np.ndarray
    J: np.ndarray
    measurements: tuple[Measurement, ...]
    kept: np.ndarray | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for one in self.measurements if not one.prior for name in one.classes))

    @cached_property
    def sample(self) -> np.ndarray:
        """Sample (M,) of each row, -1 for priors."""
        return self._rows(lambda one: np.repeat(np.full(len(one.r), -1) if one.prior else one.sample, one.r.shape[1]))

    @cached_property
    def label(self) -> np.ndarray:
        """Number (M,) of the noise class of each row, -1 for priors."""
        number = {name: i for i, name in enumerate(self.names)}
        return self._rows(lambda one: np.tile([-1 if one.prior else number[n] for n in one.classes], len(one.r)))

    @cached_property
    def channel(self) -> np.ndarray:
        """Number (M,) of the series of each row: a component of a measurement, and which of several in its sample."""
        found, first = [], 0
        for one in self.measurements:
            (m, k), rank = one.r.shape, np.zeros(len(one.r), dtype=int)
            if m and np.any(np.diff(one.sample) <= 0):
                order = np.argsort(one.sample, kind="stable")
                starts = np.flatnonzero(np.diff(one.sample[order], prepend=-1))
                rank[order] = np.arange(m) - np.repeat(starts, np.diff(np.append(starts, m)))
            found.append((first + rank[:, None] * k + np.arange(k)).ravel())
            first += k * (int(rank.max(initial=0)) + 1)
        whole = np.concatenate(found)
        return whole if self.kept is None else whole[self.kept]

    @cached_property
    def raw(self) -> np.ndarray:
        return self._rows(lambda one: one.r.ravel())

    def _rows(self, of: Callable[[Measurement], np.ndarray]) -> np.ndarray:
        whole = np.concatenate([of(one) for one in self.measurements])
        return whole if self.kept is None else whole[self.kept]

    def squares(self, count: int) -> np.ndarray:
        """Return the squared whitened residual (count,) of each sample."""
        return np.bincount(self.sample + 1, self.r**2, minlength=count + 1)[1:]  # priors are sample -1

    def numbers(self, count: int) -> np.ndarray:
        """Return how many numbers (count,) each sample has."""
        return np.bincount(self.sample + 1, minlength=count + 1)[1:]

    def times(self, weight: np.ndarray) -> Whitened:
        """Return rows times the root of the weight (N,) of their sample, without those of weight 0; priors as is."""
        if np.all(weight == 1.0):
            return self
        root = np.sqrt(np.append(weight, 1.0))[self.sample]
        kept = root > 0
        root = root[kept]
        return Whitened(self.r[kept] * root, self.J[kept] * root[:, None], self.measurements, kept)


def whiten(measurements: Sequence[Measurement], roots: Sequence[np.ndarray]) -> Whitened:
    """Put all measurements below each other, whitened by their factors from `Measurement.roots`."""
    r, J = [], []
    for one, root in zip(measurements, roots):
        r.append(one.whitened(root).ravel())
        J.append((one.J * root[:, None] if root.ndim == 1 else root @ one.J).reshape(r[-1].size, -1))
    return Whitened(np.concatenate(r), np.concatenate(J), tuple(measurements))


def cost(measurements: Sequence[Measurement], roots: Sequence[np.ndarray], weight: np.ndarray) -> float:
    """Return ``1/2 sum_i w_i r_i^T S_i^-1 r_i`` with weights (N,) of the samples, 1 for priors."""
    total = 0.0
    for one, root in zip(measurements, roots):
        r = one.whitened(root)
        squares = np.einsum("ij,ij->i", r, r)
        total += float(np.sum(squares) if one.prior else squares @ weight[one.sample])
    return 0.5 * total


def median_norm(dimension: int) -> float:
    """Return the median length of a standard normal vector; 1.5382 in three dimensions."""
    from scipy.special import gammaincinv

    return float(np.sqrt(2.0 * gammaincinv(0.5 * dimension, 0.5)))


Value = TypeVar("Value")

ITERATIONS = 100
STEP = 1e-9  # in deviations of the estimate
ROUNDING = 1e-13  # relative change of the cost that is rounding
IDLE, PATIENCE = 1e-3, 5  # steps so short that get no shorter, or lower nothing, are rounding too: exact data
EXACT = 1e-3  # and all steps are where residuals are a share so small of their deviation
MAX_DAMPING = 1e15
ROUNDED = 1e-9  # RMS of residuals in SI below which nothing was measured: they have the patterns of rounding
WELL = 1e7  # condition of a triangle below which its inverse serves
NULL = 1e-9  # relative singular value of the scaled Jacobian below which data see nothing
DAMPING = 1e-3  # first damping, relative to the largest singular value squared


@dataclass(frozen=True, eq=False)
class NonlinearProblem(Generic[Value]):
    """A fit on a manifold.

    Attributes
    ----------
    evaluate : value -> residuals with their Jacobian at zero step.
    retract : (value, x (d,)) -> value [+] x.
    scale : (d,) unit of each component of x, in which the smallest of equal steps is taken; the inverse norm of the
        columns when None.
    what : what is fitted, for messages.
    residue : deviation in SI below which residuals are rounding.
    """

    evaluate: Callable[[Value], Sequence[Measurement]]
    retract: Callable[[Value, np.ndarray], Value]
    scale: np.ndarray | None = None
    what: str = "model"
    residue: float = 1e-12


@dataclass(frozen=True, eq=False)
class Descent(Generic[Value]):
    """Where a descent ended.

    `rows`: whitened residuals and Jacobian there, weights of samples included. `basis`: (d, r) directions that the rows
    tell, ``J @ basis`` orthonormal; ``basis @ basis.T`` is the covariance. `null`: (d, d - r) orthonormal directions,
    in units of the scale, that they do not. `step`: length of the last step in deviations of the estimate.
    """

    value: Value
    rows: Whitened
    basis: np.ndarray
    null: np.ndarray
    step: float
    history: tuple[float, ...]

    @cached_property
    def U(self) -> np.ndarray:
        """Orthonormal columns (M, r): what the fit takes out of white residuals."""
        return self.rows.J @ self.basis

    @cached_property
    def freedom(self) -> np.ndarray:
        """Degrees of freedom (1 + classes,) that priors, then each class, have left."""
        label, count = self.rows.label + 1, 1 + len(self.rows.names)
        held = np.einsum("ij,ij->i", self.U, self.U)
        return np.bincount(label, minlength=count) - np.bincount(label, held, count)


def descend(
    problem: NonlinearProblem[Value],
    start: Value,
    sigma: dict[str, float],
    weight: np.ndarray,
    iterations: int = ITERATIONS,
    strict: bool = True,
) -> Descent[Value]:
    """Minimise the whitened cost from a start.

    The covariance of the residuals is that at the start of each step: a step is judged by the cost it promised to
    lower. Converged when the step is below 1e-9 deviations of the estimate, or the cost at its rounding floor.

    `sigma`: deviation of each noise class that is estimated. `weight`: (N,) weight of each sample, 0 to leave it out.
    `strict`: raise when that many did not converge; otherwise rows and basis are those before the last step. After
    Madsen, Nielsen and Tingleff (2004), Methods for non-linear least squares problems, algorithm 3.16.
    """
    value, now = start, problem.evaluate(start)
    damping, growth, here = 0.0, 2.0, None
    shortest, waited = np.inf, 0
    history: list[float] = []
    for _ in range(iterations):
        roots = [one.roots(sigma) for one in now]
        rows = whiten(now, roots).times(weight)
        height = 0.5 * float(rows.r @ rows.r)
        history.append(height)
        slope = _Slope.of(problem, rows)
        here = Descent(value, rows, slope.basis, slope.null, float(np.sqrt(slope.along @ slope.along)), tuple(history))
        waited = waited + 1 if here.step > 0.5 * shortest else 0
        shortest = min(shortest, here.step)
        idle = here.step < IDLE or 2.0 * height < EXACT**2 * len(rows.r)
        if here.step < STEP or (idle and waited > PATIENCE):
            return here
        rounding = 0.5 * here.step**2 < ROUNDING * height  # the cost cannot tell; the steps do, by their length
        while True:
            x, promise = slope.step(damping)
            trial = problem.retract(value, x)
            then = problem.evaluate(trial)
            fall = height - cost(then, roots, weight)
            if fall > 0 or rounding:
                break
            if idle and damping > 1.0:
                return here
            damping, growth = max(damping * growth, DAMPING), 2.0 * growth
            if damping > MAX_DAMPING:
                raise _stuck(problem, value, history)
        gain = fall / promise if fall > 0 else 1.0
        damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
        damping = damping if damping > 1e-12 else 0.0
        value, now = trial, then
    if strict or here is None:
        raise _stuck(problem, value, history)
    return replace(here, value=value)


def _stuck(problem: NonlinearProblem[Any], value: Any, history: list[float]) -> NotConverged:
    return NotConverged(
        f"Expected the fit of the {problem.what} to converge, got a cost of {history[-1]:.6g} after {len(history)} "
        "iterations. Give a better start, or look for wrong samples with robust=True.",
        best=value,
        history=history,
    )


@dataclass(frozen=True, eq=False)
class _Slope:
    """The linear problem at one value; singular values, which are slow, only where nearly singular or damped."""

    R: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, problem: NonlinearProblem[Any], rows: Whitened) -> _Slope:
        R = triangle(rows.J, rows.r)
        norms = np.sqrt(np.einsum("ij,ij->j", R[:, :-1], R[:, :-1]))
        return cls(R, problem.scale if problem.scale is not None else 1.0 / np.where(norms > 0, norms, 1.0))

    @cached_property
    def _inverse(self) -> np.ndarray | None:
        """Inverse of the scaled triangle, or None where it is nearly singular."""
        from scipy.linalg import lapack

        scaled = self.R[:-1, :-1] * self.scale
        inverse, fault = lapack.dtrtri(scaled)  # pyright: ignore
        size = np.vdot(scaled, scaled) * np.vdot(inverse, inverse)
        return inverse if not fault and size < WELL**2 else None

    @cached_property
    def _singular(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Basis (d, r), singular values (r,), null space (d, d - r), and slope (r,) of the cost along the basis."""
        U, singular, V = np.linalg.svd(self.R[:-1, :-1] * self.scale)
        rank = int(np.count_nonzero(singular > NULL * singular[0]))
        basis = (self.scale * V[:rank]).T / singular[:rank]
        return basis, singular[:rank], V[rank:].T, U[:, :rank].T @ self.R[:-1, -1]

    @cached_property
    def basis(self) -> np.ndarray:
        """Directions (d, r) that the rows tell: J times them is orthonormal."""
        return self._singular[0] if self._inverse is None else self.scale[:, None] * self._inverse

    @property
    def null(self) -> np.ndarray:
        """Directions (d, d - r), in units of the scale, that they do not."""
        return self._singular[2] if self._inverse is None else np.zeros((len(self.scale), 0))

    @property
    def along(self) -> np.ndarray:
        """Slope (r,) of the cost along the basis."""
        return self._singular[3] if self._inverse is None else self.R[:-1, -1]

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return the step (d,), damped by a share of the largest singular value squared, and the promised fall."""
        if damping == 0.0:
            return -self.basis @ self.along, 0.5 * float(self.along @ self.along)
        basis, singular, _, slope = self._singular
        shrink = singular**2 / (singular**2 + damping * singular[0] ** 2)
        return -basis @ (shrink * slope), float(slope @ (shrink * (1.0 - 0.5 * shrink) * slope))


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
CLEARLY = 1.3  # times less noise that another answer must leave


@dataclass(frozen=True, eq=False)
class NonlinearSolution(Generic[Value]):
    """A fitted value with its uncertainty.

    `cov`: (d, d) covariance of a step away from it, zero along unidentified directions, with Student's factor where
    noise is estimated, and the correlation of residuals where `check` finds it; `formal_cov`: without the latter, None
    where it is the same. `sigma`: deviation of the classes, degrees of freedom subtracted. `outliers`: (N,) samples
    that were left out. `squares`: (N,) whitened squared residual of every sample. `null`: (d, m) orthonormal
    directions, in units of the scale, that neither data nor prior tell. `history`: cost after each iteration of the
    last descent.
    """

    value: Value
    cov: np.ndarray
    formal_cov: np.ndarray | None
    check: ResidualCheck
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
        make_read_only(self, "cov", "sigma", "outliers", "squares", "null")


def nonlinear_least_squares(
    problem: NonlinearProblem[Value],
    start: Value,
    *,
    robust: bool = False,
    schedule: Sequence[float] = SCHEDULE,
    near: bool = False,
    majority: bool = False,
) -> NonlinearSolution[Value]:
    """Fit a value on a manifold by maximum likelihood.

    Parameters
    ----------
    problem : residuals with Jacobian, and retraction. Measurements without covariance have their noise estimated.
    start : first value.
    robust : find outliers among the samples; `outliers` marks them.
    schedule : values of c of the graduated loss, in deviations, for given noise.
    near : the start is that of the good samples: the loss begins narrow, where outliers cannot lead away from it.
    majority : with robust and unknown noise, look beside for what most samples agree on, near the solution: where a
        third of them is wrong in the same way, they lead the loss and the scale.

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
    ends = [_flagged(problem, start, sigma, weight, robust)]
    if robust and sigma and majority:
        found, sigma, _ = ends[0]
        rows = _rows(problem, found.value, sigma)
        start = problem.retract(found.value, majority_step(rows.J, rows.r, rows.sample, rows.label, count))
        sigma = _median_noise(_rows(problem, start, sigma), sigma, problem.residue)
        ends.append(_flagged(problem, start, sigma, _fits(problem, start, sigma, count), robust))
    sizes = [sum(np.log(size) for size in end[1].values()) for end in ends]
    found, sigma, weight = ends[-1 if sizes[-1] < sizes[0] - np.log(CLEARLY) else 0]
    return _solution(problem, found, sigma, weight, robust)


def _flagged(
    problem: NonlinearProblem[Value], start: Value, sigma: dict[str, float], weight: np.ndarray, robust: bool
) -> tuple[Descent[Value], dict[str, float], np.ndarray]:
    """Fit the samples with weight, flag all again, and so on; return the descent, the noise, the weights (N,)."""
    found, sigma = _with_noise(problem, start, sigma, weight)
    for _ in range(FLAG_ROUNDS if robust else 0):
        fresh = _fits(problem, found.value, sigma, len(weight))
        if np.array_equal(fresh, weight):
            break
        weight = fresh
        found, sigma = _with_noise(problem, found.value, sigma, weight)
    return found, sigma, weight


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
    problem: NonlinearProblem[Value],
    value: Value,
    sigma: dict[str, float],
    weight: np.ndarray,
    schedule: Sequence[float],
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


def _rows(problem: NonlinearProblem[Value], value: Value, sigma: dict[str, float]) -> Whitened:
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


def _fits(problem: NonlinearProblem[Value], value: Value, sigma: dict[str, float], count: int) -> np.ndarray:
    """Return 1 for samples (N,) whose squared residual is below the 99.9 % quantile, else 0."""
    from scipy.special import chdtri

    rows = _rows(problem, value, sigma)
    return (rows.squares(count) <= chdtri(np.maximum(rows.numbers(count), 1), 1.0 - FLAGGED)).astype(float)


def _with_noise(
    problem: NonlinearProblem[Value], value: Value, sigma: dict[str, float], weight: np.ndarray
) -> tuple[Descent[Value], dict[str, float]]:
    """Alternate between the value and the noise of its classes.

    Where one class alone would be fitted exactly, its noise would vanish: then classes keep the ratio they start with.
    """
    found = descend(problem, value, sigma, weight)
    mixed, pooled, first = _is_mixed(found), False, sigma
    for _ in range((MIXED_ROUNDS if mixed else NOISE_ROUNDS) if sigma else 0):
        before = sigma
        if not mixed and not pooled and _starved(found, sigma):
            pooled, sigma = True, first
            found = descend(problem, value, sigma, weight)
        if pooled:
            times = np.sqrt(2.0 * found.history[-1] / max(len(found.rows.r) - found.basis.shape[1], 1))
            sigma = {name: max(size * times, problem.residue) for name, size in sigma.items()}
        else:
            sizes = _mixed_sigma(found, sigma) if mixed else _class_sigma(found)
            sigma = {name: max(sizes[found.rows.names.index(name)], problem.residue) for name in before}
        found = descend(problem, found.value, sigma, weight)
        if all(abs(sigma[name] - before[name]) <= SETTLED * before[name] for name in sigma):
            break
    return found, sigma


def _starved(found: Descent[Any], sigma: dict[str, float]) -> bool:
    """Return whether some of several classes of unknown noise has less than one degree of freedom left."""
    if len(sigma) < 2:
        return False
    return bool(found.freedom[1:][[name in sigma for name in found.rows.names]].min() < 1.0)


def _class_sigma(found: Descent[Any]) -> np.ndarray:
    """Return the deviation (classes,) of the residuals in SI, each class with the degrees of freedom it has left."""
    left = np.maximum(found.freedom, np.finfo(float).eps)
    return np.sqrt(np.bincount(found.rows.label + 1, found.rows.raw**2, len(left)) / left)[1:]


def _is_mixed(found: Descent[Any]) -> bool:
    return any(one.added is not None for one in found.rows.measurements)


def _mixed_sigma(found: Descent[Any], sigma: dict[str, float]) -> np.ndarray:
    """Return the next deviation (classes,) where another part of the noise, S_i - diag(sigma^2), is known.

    ``sigma_c^2 <- sigma_c^2 sum_c (S^-1 r)^2 / (sum_c diag(S^-1) - |S^-1 J basis|^2)``, sums over the rows of class c.
    """
    rows, start = found.rows, 0
    kept = slice(None) if rows.kept is None else rows.kept
    whole = np.zeros((sum(one.r.size for one in rows.measurements), 1 + found.basis.shape[1]))
    whole[kept, 0], whole[kept, 1:] = rows.r, found.U
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
    problem: NonlinearProblem[Value], found: Descent[Value], sigma: dict[str, float], weight: np.ndarray, robust: bool
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
    by_rounds = _is_mixed(found) or _starved(found, sigma)
    cov, formal, check = covariance_of(rows, found.basis, found.U, frozenset(sigma), robust)
    return NonlinearSolution(
        value=found.value, cov=cov, formal_cov=formal, check=check, classes=rows.names,
        sigma=np.array([sigma.get(n, np.nan) for n in rows.names]) if by_rounds else _class_sigma(found),
        outliers=weight == 0,
        squares=(rows if np.all(weight == 1.0) else _rows(problem, found.value, sigma)).squares(len(weight)), rows=rows,
        null=found.null, cost=found.history[-1], freedom=freedom, history=found.history,
    )  # fmt: skip


def covariance_of(
    rows: Whitened, basis: np.ndarray, U: np.ndarray, estimated: frozenset[str], robust: bool
) -> tuple[np.ndarray, np.ndarray | None, ResidualCheck]:
    """Return the covariance, that of white residuals where it is another one, and what the residuals say.

    `basis`: (d, r) with U = J basis orthonormal. `estimated`: classes whose noise is estimated. `robust`: whether
    outliers were looked for.
    """
    sizes = np.bincount(rows.label + 1, rows.raw**2) / np.maximum(np.bincount(rows.label + 1), 1)
    r = np.where(sizes[rows.label + 1] > ROUNDED**2, rows.r, 0.0)
    series = Series(r, U, rows.label, rows.channel, rows.sample, rows.names)
    check = check_residuals(series, robust, given=not estimated)
    count, held = len(series.classes), np.einsum("ij,ij->i", U, U)
    d = np.bincount(series.label + 1, held, count + 1)[1:]
    nu = np.bincount(series.label + 1, minlength=count + 1)[1:] - d
    known = np.array([name not in estimated for name in series.classes])
    if np.count_nonzero(~known) > 1 and nu[~known].min() < 1.0:  # these share one unknown factor
        d, nu = np.append(d[known], d[~known].sum()), np.append(nu[known], nu[~known].sum())
        known = np.append(known[known], False)
    nu[known] = np.inf
    formal = student_factor(d, nu) * basis @ basis.T
    if not check.suspicious.any():
        return formal, None, check
    correlated = correlated_information(series, np.flatnonzero(check.suspicious).tolist())
    cov = student_factor(d, nu) * basis @ correlated @ basis.T
    sd, usual = np.sqrt(np.diag(cov)), np.sqrt(np.diag(formal))
    growth = float(np.max(sd[usual > 0] / usual[usual > 0], initial=1.0))
    return cov, formal, replace(check, growth=growth)
