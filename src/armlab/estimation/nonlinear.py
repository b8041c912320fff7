"""Maximum-likelihood estimation on manifolds with unknown noise and outliers; used by all calibration fits.

The unknown noise of each measurement class c is estimated iteratively, in whitened quantities:

    sigma_c^2 <- sigma_c^2 r_c^T r_c / (n_c - trace(J_c P J_c^T))

With `robust`, the fit begins with a graduated Geman-McClure loss over whole samples, with weight
``(c^2 / (c^2 + rho^2))^2`` and decreasing c. Samples with rho^2 beyond the 99.9 % quantile are then flagged and
excluded. The remaining samples are fitted by plain maximum likelihood, which also gives the covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from armlab._display import Shown
from armlab._numbers import make_read_only
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation.linear_problem import student_factor
from armlab.estimation.residual_tests import ResidualCheck, Series, check_residuals, correlated_information
from armlab.estimation.robust import majority_step
from armlab.estimation.tsqr import triangle


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(Shown):
    """Residuals of one kind of measurement at given values of the unknowns.

    Attributes
    ----------
    r : (m, k) residuals in SI units, k components for each of m measurements.
    J : (m, k, d) derivatives of the residuals with respect to a step of `retract`.
    cov : (k,) variances, or (k, k) or (m, k, k) covariance of r; None to estimate one standard deviation per class.
    classes : noise class of each of the k components, for example ("t", "t", "t", "R", "R", "R").
    sample : (m,) index of the sample (pose, scan or point) of each measurement; default: 0 to m - 1. Outliers are
        detected per sample.
    prior : True for prior knowledge, which cannot be an outlier and does not enter the noise estimate.
    added : (k, k) or (m, k, k) known part of the noise covariance, added to the estimated part; None: no known part.
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
                raise ShapeError(
                    f"Expected a NumPy array as {name} of a measurement. This is a bug in the residual function."
                )
        m, k = self.r.shape if self.r.ndim == 2 else (0, 0)
        given = None if self.cov is None else self.cov.shape
        if not self.sample.size:
            object.__setattr__(self, "sample", np.arange(m))
        fits = self.r.ndim == 2 and self.J.shape[:2] == (m, k) and self.J.ndim == 3 and len(self.classes) == k
        if not fits or given not in (None, (k,), (k, k), (m, k, k)) or self.sample.shape != (m,):
            raise ShapeError(
                "Expected r (m, k), J (m, k, d), cov (k,), (k, k) or (m, k, k), k classes and sample (m,), got "
                f"{self.r.shape}, {self.J.shape}, {given}, {len(self.classes)} and {self.sample.shape}. "
                "This is a bug in the residual function."
            )
        beside = None if self.added is None else self.added.shape
        if beside not in (None, (k, k), (m, k, k)) or (beside is not None and self.cov is not None):
            raise ShapeError(
                f"Expected added of shape ({k}, {k}) or ({m}, {k}, {k}) in addition to estimated noise, got {beside}. "
                "This is a bug in the residual function."
            )
        if self.prior and self.cov is None:
            raise ShapeError("Expected the covariance of a prior, got None. Pass its covariance.")

    def roots(self, sigma: dict[str, float]) -> np.ndarray:
        """Return the whitening factor: the inverse Cholesky factor of the covariance, (k, k) or (m, k, k).

        For independent components, only the diagonal (k,) of the factor is returned.

        Parameters
        ----------
        sigma : standard deviation of each class with estimated noise.
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
                "Expected noise with a positive definite covariance, got an indefinite or singular covariance. Pass "
                "standard deviations above zero."
            ) from None

    def whitened(self, root: np.ndarray) -> np.ndarray:
        """Return the whitened residuals (m, k), given the whitening factor from `roots`."""
        return self.r * root if root.ndim == 1 else (root @ self.r[:, :, None])[:, :, 0]


@dataclass(frozen=True, eq=False)
class Whitened:
    """Whitened rows of all measurements: r (M,), J (M, d), and a mask `kept` of the included rows (None: all)."""

    r: np.ndarray
    J: np.ndarray
    measurements: tuple[Measurement, ...]
    kept: np.ndarray | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for one in self.measurements if not one.prior for name in one.classes))

    @cached_property
    def sample(self) -> np.ndarray:
        """Sample index (M,) of each row; -1 for priors."""
        sample = ((np.full(len(one.r), -1) if one.prior else one.sample) for one in self.measurements)
        return self._included([np.repeat(s, one.r.shape[1]) for s, one in zip(sample, self.measurements)])

    @cached_property
    def label(self) -> np.ndarray:
        """Index (M,) of the noise class of each row; -1 for priors."""
        number = {name: i for i, name in enumerate(self.names)}
        labels = ([-1 if one.prior else number[n] for n in one.classes] for one in self.measurements)
        return self._included([np.tile(label, len(one.r)) for label, one in zip(labels, self.measurements)])

    @cached_property
    def channel(self) -> np.ndarray:
        """Time series index (M,) of each row, from its measurement component and its position within the sample."""
        found, first = [], 0
        for one in self.measurements:
            (m, k), rank = one.r.shape, np.zeros(len(one.r), dtype=int)
            if m and np.any(np.diff(one.sample) <= 0):
                order = np.argsort(one.sample, kind="stable")
                starts = np.flatnonzero(np.diff(one.sample[order], prepend=-1))
                rank[order] = np.arange(m) - np.repeat(starts, np.diff(np.append(starts, m)))
            found.append((first + rank[:, None] * k + np.arange(k)).ravel())
            first += k * (int(rank.max(initial=0)) + 1)
        return self._included(found)

    @cached_property
    def raw(self) -> np.ndarray:
        return self._included([one.r.ravel() for one in self.measurements])

    def _included(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        whole = np.concatenate(parts)
        return whole if self.kept is None else whole[self.kept]

    def squares(self, count: int) -> np.ndarray:
        """Return the squared whitened residual (count,) of each sample."""
        return np.bincount(self.sample + 1, self.r**2, minlength=count + 1)[1:]  # priors have sample -1

    def numbers(self, count: int) -> np.ndarray:
        """Return the number of components (count,) of each sample."""
        return np.bincount(self.sample + 1, minlength=count + 1)[1:]

    def times(self, weight: np.ndarray) -> Whitened:
        """Scale the rows by the square root of the sample weights (N,) and drop rows of weight 0; priors stay
        unscaled."""
        if np.all(weight == 1.0):
            return self
        root = np.sqrt(np.append(weight, 1.0))[self.sample]
        kept = root > 0
        root = root[kept]
        return Whitened(self.r[kept] * root, self.J[kept] * root[:, None], self.measurements, kept)


def whiten(measurements: Sequence[Measurement], roots: Sequence[np.ndarray]) -> Whitened:
    """Stack all measurements, whitened by the factors from `Measurement.roots`."""
    r, J = [], []
    for one, root in zip(measurements, roots):
        r.append(one.whitened(root).ravel())
        J.append((one.J * root[:, None] if root.ndim == 1 else root @ one.J).reshape(r[-1].size, -1))
    return Whitened(np.concatenate(r), np.concatenate(J), tuple(measurements))


def cost(measurements: Sequence[Measurement], roots: Sequence[np.ndarray], weight: np.ndarray) -> float:
    """Return ``1/2 sum_i w_i r_i^T S_i^-1 r_i``, with sample weights w (N,) and weight 1 for priors."""
    total = 0.0
    for one, root in zip(measurements, roots):
        r = one.whitened(root)
        squares = np.einsum("ij,ij->i", r, r)
        total += float(np.sum(squares) if one.prior else squares @ weight[one.sample])
    return 0.5 * total


def median_norm(dimension: int) -> float:
    """Return the median norm of a standard normal vector (1.5382 in three dimensions)."""
    from scipy.special import gammaincinv

    return float(np.sqrt(2.0 * gammaincinv(0.5 * dimension, 0.5)))


Value = TypeVar("Value")

ITERATIONS = 100
STEP = 1e-9  # step at convergence, in standard deviations of the estimate
ROUNDING = 1e-13  # relative rounding error of the cost
IDLE, PATIENCE = 1e-3, 5  # rounding floor: step in standard deviations, and number of steps without progress
EXACT = 1e-3  # RMS of the whitened residuals below which all steps are rounding errors
MAX_DAMPING = 1e15
ROUNDED = 1e-9  # RMS of residuals in SI units below which they are rounding errors, not noise
WELL_CONDITIONED = 1e7  # condition number of a triangular factor below which its inverse is accurate
NULL = 1e-9  # relative singular value of the scaled Jacobian below which a direction is unobservable
DAMPING = 1e-3  # first damping, relative to the largest singular value squared


@dataclass(frozen=True, eq=False, repr=False)
class NonlinearProblem(Shown, Generic[Value]):
    """Least-squares problem on a manifold.

    Attributes
    ----------
    evaluate : function that returns the residuals of a value and their Jacobian at zero step.
    retract : function that returns a value moved by a step x (d,).
    scale : (d,) unit of each component of x, for the minimum-norm step; default: inverse norms of the columns of J.
    what : name of the fitted quantity, for messages.
    residue : standard deviation in SI units below which residuals are regarded as rounding errors.
    """

    evaluate: Callable[[Value], Sequence[Measurement]]
    retract: Callable[[Value, np.ndarray], Value]
    scale: np.ndarray | None = None
    what: str = "model"
    residue: float = 1e-12


@dataclass(frozen=True, eq=False)
class Descent(Generic[Value]):
    """Result of a Gauss-Newton descent."""

    value: Value
    rows: Whitened  # whitened residuals and Jacobian, including sample weights
    basis: np.ndarray  # (d, r) determined directions, J @ basis orthonormal; basis @ basis.T is the covariance
    null: np.ndarray  # (d, d - r) orthonormal undetermined directions, in units of the scale
    step: float  # length of the last step in standard deviations of the estimate
    history: tuple[float, ...]  # cost before each step

    @cached_property
    def U(self) -> np.ndarray:
        """Orthonormal columns (M, r) that span the part of the residuals removed by the fit."""
        return self.rows.J @ self.basis

    @cached_property
    def freedom(self) -> np.ndarray:
        """Remaining degrees of freedom (1 + classes,) of the priors and of each class."""
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
    """Minimise the whitened cost by damped Gauss-Newton steps (Madsen, Nielsen and Tingleff 2004, algorithm 3.16).

    The covariance stays fixed during a step, so that the actual and predicted decreases in cost are comparable. The
    descent has converged when the step is below 1e-9 standard deviations of the estimate, or the cost is at its
    rounding floor. Unless `strict` is set, the descent may stop earlier; the rows and the basis are then those before
    the last step.
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
        slope = _Linearised.of(problem, rows)
        here = Descent(value, rows, slope.basis, slope.null, float(np.sqrt(slope.along @ slope.along)), tuple(history))
        waited = waited + 1 if here.step > 0.5 * shortest else 0
        shortest = min(shortest, here.step)
        idle = here.step < IDLE or 2.0 * height < EXACT**2 * len(rows.r)
        if here.step < STEP or (idle and waited > PATIENCE):
            return here
        rounding = 0.5 * here.step**2 < ROUNDING * height  # only step lengths show progress; the cost is rounded
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
                raise _not_converged(problem, value, history)
        gain = fall / promise if fall > 0 else 1.0
        damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
        damping = damping if damping > 1e-12 else 0.0
        value, now = trial, then
    if strict or here is None:
        raise _not_converged(problem, value, history)
    return replace(here, value=value)


def _not_converged(problem: NonlinearProblem[Any], value: Any, history: list[float]) -> NotConverged:
    return NotConverged(
        f"Expected the fit of the {problem.what} to converge, got a cost of {history[-1]:.6g} after {len(history)} "
        "iterations. Provide a better initial guess, or detect outliers with robust=True.",
        best=value,
        history=history,
    )


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Linearised problem; singular values are costly and computed only for nearly singular or damped problems."""

    R: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, problem: NonlinearProblem[Any], rows: Whitened) -> _Linearised:
        R = triangle(rows.J, rows.r)
        norms = np.sqrt(np.einsum("ij,ij->j", R[:, :-1], R[:, :-1]))
        return cls(R, problem.scale if problem.scale is not None else 1.0 / np.where(norms > 0, norms, 1.0))

    @cached_property
    def _inverse(self) -> np.ndarray | None:
        """Inverse of the scaled triangular factor, or None if nearly singular."""
        from scipy.linalg import lapack

        scaled = self.R[:-1, :-1] * self.scale
        inverse, fault = lapack.dtrtri(scaled)  # pyright: ignore
        size = np.vdot(scaled, scaled) * np.vdot(inverse, inverse)
        return inverse if not fault and size < WELL_CONDITIONED**2 else None

    @cached_property
    def _singular(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Basis (d, r), singular values (r,), null space (d, d - r), and gradient (r,) of the cost along the basis."""
        U, singular, V = np.linalg.svd(self.R[:-1, :-1] * self.scale)
        rank = int(np.count_nonzero(singular > NULL * singular[0]))
        basis = (self.scale * V[:rank]).T / singular[:rank]
        return basis, singular[:rank], V[rank:].T, U[:, :rank].T @ self.R[:-1, -1]

    @cached_property
    def basis(self) -> np.ndarray:
        """Determined directions (d, r), scaled so that J times these directions is orthonormal."""
        return self._singular[0] if self._inverse is None else self.scale[:, None] * self._inverse

    @property
    def null(self) -> np.ndarray:
        """Undetermined directions (d, d - r), in units of the scale."""
        return self._singular[2] if self._inverse is None else np.zeros((len(self.scale), 0))

    @property
    def along(self) -> np.ndarray:
        """Gradient (r,) of the cost along the basis."""
        return self._singular[3] if self._inverse is None else self.R[:-1, -1]

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return the step (d,) and the predicted decrease of the cost."""
        if damping == 0.0:
            return -self.basis @ self.along, 0.5 * float(self.along @ self.along)
        basis, singular, _, slope = self._singular
        shrink = singular**2 / (singular**2 + damping * singular[0] ** 2)
        return -basis @ (shrink * slope), float(slope @ (shrink * (1.0 - 0.5 * shrink) * slope))


SCHEDULE = (200.0, 60.0, 20.0, 10.0)
UNKNOWN_NOISE = (1000.0, 10.0, 5.0, 5.0)
NARROW = 3  # number of final values of c, the only ones used for a near start
REWEIGHTED = 20  # iterations per c
NEXT = 1e-2  # step in standard deviations below which c decreases
SETTLED = 1e-6  # relative change of sigma at convergence
NOISE_ROUNDS, MIXED_ROUNDS = 20, 100  # maximum number of noise iterations, without and with a known noise part
FLAGGED, FLAG_ROUNDS = 0.999, 3  # quantile of chi^2 above which a sample is an outlier; maximum number of iterations
MIN_IMPROVEMENT = 1.3  # factor by which an alternative solution must reduce the noise


@dataclass(frozen=True, eq=False)
class NonlinearSolution(Generic[Value]):
    """Fitted value with its uncertainty, which is computed on first access."""

    value: Value
    basis: np.ndarray  # (d, r) determined directions, rows.J @ basis orthonormal
    estimated: frozenset[str]  # classes with estimated noise
    robust: bool  # whether outliers were detected
    classes: tuple[str, ...]
    sigma: np.ndarray  # standard deviation of each class, corrected for degrees of freedom
    outliers: np.ndarray  # (N,) mask of excluded samples
    squares: np.ndarray  # (N,) whitened squared residual of every sample
    rows: Whitened
    null: np.ndarray  # (d, m) orthonormal undetermined directions, in units of the scale
    cost: float
    freedom: int  # degrees of freedom of all residuals
    history: tuple[float, ...]  # cost before each step

    def __post_init__(self) -> None:
        make_read_only(self, "sigma", "outliers", "squares", "null")

    @cached_property
    def _uncertainty(self) -> tuple[np.ndarray, np.ndarray | None, ResidualCheck]:
        return covariance_of(self.rows, self.basis, self.rows.J @ self.basis, self.estimated, self.robust)

    @property
    def cov(self) -> np.ndarray:
        """Covariance (d, d) of the error, expressed as a step from the value, including the residual correlation if
        `check` detects it."""
        return self._uncertainty[0]

    @property
    def formal_cov(self) -> np.ndarray | None:
        """Covariance that ignores the residual correlation; None if identical to the reported covariance."""
        return self._uncertainty[1]

    @property
    def check(self) -> ResidualCheck:
        return self._uncertainty[2]


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
    problem : residuals with Jacobian, and retraction. The noise of measurements without a covariance is estimated.
    start : initial value.
    robust : detect outliers among the samples; `outliers` marks them.
    schedule : values of c of the graduated loss, in standard deviations, for given noise.
    near : True if the start already fits the good samples. The loss is then narrow from the beginning, so outliers
        cannot bias the estimate.
    majority : with `robust` and unknown noise, also search near the solution for a fit to the majority of the samples.
        Needed if a third of the samples share the same error, which biases the estimate and inflates the noise scale.

    Raises
    ------
    NotConverged : the descent did not converge.
    NotExcited : after excluding outliers, there are fewer residuals than unknowns.

    References
    ----------
    Geman and McClure (1987); Yang, Antonante, Tzoumas and Carlone (2020), Graduated non-convexity.
    """
    problem = replace(problem, evaluate=_cached(problem.evaluate))
    now = problem.evaluate(start)
    count = 1 + max(int(one.sample.max(initial=-1)) for one in now if not one.prior)
    sigma = _first_noise(now, problem.residue)
    weight = np.ones(count)
    if robust:
        steps = UNKNOWN_NOISE if sigma else schedule
        start, sigma, weight = _graduate(problem, start, sigma, weight, steps[-NARROW:] if near else steps)
    ends = [_fit_and_flag(problem, start, sigma, weight, robust)]
    if robust and sigma and majority:
        found, sigma, _ = ends[0]
        rows = _rows(problem, found.value, sigma)
        start = problem.retract(found.value, majority_step(rows.J, rows.r, rows.sample, rows.label, count))
        sigma = _median_noise(_rows(problem, start, sigma), sigma, problem.residue)
        ends.append(_fit_and_flag(problem, start, sigma, _fits(problem, start, sigma, count), robust))
    sizes = [sum(np.log(size) for size in end[1].values()) for end in ends]
    found, sigma, weight = ends[-1 if sizes[-1] < sizes[0] - np.log(MIN_IMPROVEMENT) else 0]
    return _solution(problem, found, sigma, weight, robust)


def _fit_and_flag(
    problem: NonlinearProblem[Value], start: Value, sigma: dict[str, float], weight: np.ndarray, robust: bool
) -> tuple[Descent[Value], dict[str, float], np.ndarray]:
    """Alternate between fitting and flagging outliers; return the descent, the noise and the weights (N,)."""
    found, sigma = _with_noise(problem, start, sigma, weight)
    for _ in range(FLAG_ROUNDS if robust else 0):
        fresh = _fits(problem, found.value, sigma, len(weight))
        if np.array_equal(fresh, weight):
            break
        weight = fresh
        found, sigma = _with_noise(problem, found.value, sigma, weight)
    return found, sigma, weight


def _cached(evaluate: Callable[[Value], Sequence[Measurement]]) -> Callable[[Value], Sequence[Measurement]]:
    """Return `evaluate` with a cache of the last value."""
    last: list[tuple[Value, Sequence[Measurement]]] = []

    def cached(value: Value) -> Sequence[Measurement]:
        if not last or last[0][0] is not value:
            last[:] = [(value, evaluate(value))]
        return last[0][1]

    return cached


def _first_noise(now: Sequence[Measurement], residue: float) -> dict[str, float]:
    """Return the root mean square of each class with unknown noise."""
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
    """Narrow the loss step by step; return the value, the noise, and the inlier mask (N,), 0 or 1."""
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
    """Return the robust standard deviation of each class from the median norm of its residuals."""
    found = {}
    for name in sigma:
        mine = rows.label == rows.names.index(name)
        numbers = np.bincount(rows.sample[mine])
        length = np.sqrt(np.bincount(rows.sample[mine], rows.raw[mine] ** 2))[numbers > 0]
        typical = median_norm(int(np.median(numbers[numbers > 0])))
        found[name] = max(float(np.median(length)) / typical, residue)
    return found


def _fits(problem: NonlinearProblem[Value], value: Value, sigma: dict[str, float], count: int) -> np.ndarray:
    """Return 1 for samples (N,) with a squared residual below the 99.9 % quantile, and 0 for the other samples."""
    from scipy.special import chdtri

    rows = _rows(problem, value, sigma)
    return (rows.squares(count) <= chdtri(np.maximum(rows.numbers(count), 1), 1.0 - FLAGGED)).astype(float)


def _with_noise(
    problem: NonlinearProblem[Value], value: Value, sigma: dict[str, float], weight: np.ndarray
) -> tuple[Descent[Value], dict[str, float]]:
    """Alternate between fitting the value and estimating the noise of the classes.

    If one class could be fitted exactly, its noise estimate would vanish, so the classes keep their initial noise
    ratio.
    """
    found = descend(problem, value, sigma, weight)
    mixed, pooled, first = _is_mixed(found), False, sigma
    for _ in range((MIXED_ROUNDS if mixed else NOISE_ROUNDS) if sigma else 0):
        before = sigma
        if not mixed and not pooled and _without_freedom(found, sigma):
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


def _without_freedom(found: Descent[Any], sigma: dict[str, float]) -> bool:
    """Return whether one of several classes with unknown noise has less than one degree of freedom left."""
    if len(sigma) < 2:
        return False
    return bool(found.freedom[1:][[name in sigma for name in found.rows.names]].min() < 1.0)


def _class_sigma(found: Descent[Any]) -> np.ndarray:
    """Return the standard deviation (classes,) of the residuals in SI units, corrected for degrees of freedom."""
    left = np.maximum(found.freedom, np.finfo(float).eps)
    return np.sqrt(np.bincount(found.rows.label + 1, found.rows.raw**2, len(left)) / left)[1:]


def _is_mixed(found: Descent[Any]) -> bool:
    return any(one.added is not None for one in found.rows.measurements)


def _mixed_sigma(found: Descent[Any], sigma: dict[str, float]) -> np.ndarray:
    """Return the updated standard deviations (classes,) if a part S_i - diag(sigma^2) of the noise is known.

    ``sigma_c^2 <- sigma_c^2 sum (S^-1 r)^2 / sum (diag(S^-1) - |S^-1 J basis|^2)``, summed over the rows of class c.
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
            f"Expected at least {rank + bool(sigma)} residuals to fit the {problem.what}, got {len(rows.r)} "
            f"({int(np.sum(weight == 0))} samples excluded). Measure more samples.",
            ["everything"],
            [f"{len(rows.r)} residuals"],
        )
    by_rounds = _is_mixed(found) or _without_freedom(found, sigma)
    return NonlinearSolution(
        value=found.value, basis=found.basis, estimated=frozenset(sigma), robust=robust, classes=rows.names,
        sigma=np.array([sigma.get(n, np.nan) for n in rows.names]) if by_rounds else _class_sigma(found),
        outliers=weight == 0,
        squares=(rows if np.all(weight == 1.0) else _rows(problem, found.value, sigma)).squares(len(weight)), rows=rows,
        null=found.null, cost=found.history[-1], freedom=freedom, history=found.history,
    )  # fmt: skip


def covariance_of(
    rows: Whitened, basis: np.ndarray, U: np.ndarray, estimated: frozenset[str], robust: bool
) -> tuple[np.ndarray, np.ndarray | None, ResidualCheck]:
    """Return the covariance, the covariance for white residuals (if different), and the residual check.

    `basis` is (d, r) with orthonormal U = J basis; `estimated` lists the classes with estimated noise.
    """
    sizes = np.bincount(rows.label + 1, rows.raw**2) / np.maximum(np.bincount(rows.label + 1), 1)
    r = np.where(sizes[rows.label + 1] > ROUNDED**2, rows.r, 0.0)
    series = Series(r, U, rows.label, rows.channel, rows.sample, rows.names)
    check = check_residuals(series, robust, given=not estimated)
    count, held = len(series.classes), np.einsum("ij,ij->i", U, U)
    d = np.bincount(series.label + 1, held, count + 1)[1:]
    nu = np.bincount(series.label + 1, minlength=count + 1)[1:] - d
    known = np.array([name not in estimated for name in series.classes])
    if np.count_nonzero(~known) > 1 and nu[~known].min() < 1.0:  # these classes share one unknown factor
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
