"""Linear least squares from triangular factors, with class weights, bounds, priors and covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armlab._display import Shown
from armlab._numbers import make_read_only, numbers, still
from armlab.errors import NotExcited, ShapeError
from armlab.estimation.tsqr import Factors, triangle

MAX_CONDITION = 1e4  # condition number above which a direction counts as not excited
WARN_CONDITION = 300.0
NULL = 1e-9  # relative singular value below which a direction is unobservable rather than weak
NAMED = 0.3  # fraction of the largest component above which a component is named

UNOBSERVABLE = 1e-3  # effect of one prior SD on the rows, in noise SDs, below which the data carry no information

Describe = Callable[[np.ndarray], str]


@dataclass(frozen=True, eq=False, repr=False)
class Prior(Shown):
    """Independent priors on the parameters.

    Attributes
    ----------
    values : array, shape (p,), units of the parameters
        Prior values.
    sd : array, shape (p,), units of the parameters
        Standard deviations of the prior values.
    """

    values: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Excitation(Shown):
    """Excitation of the parameters by the data.

    Attributes
    ----------
    rank, expected : numerical rank and number of parameters.
    singular_values : singular values of the column-scaled, whitened design matrix, in descending order.
    weakest : description of the least excited direction.
    scale : (p,) norms of the columns; 1 for zero columns.
    vectors : (p, p) right singular vectors of the scaled matrix as columns, strongest first.
    held : descriptions of the directions determined only by the prior.
    null_space : (p, m) orthonormal unobservable directions, in units of the limits.
    null_names : descriptions of the unobservable directions; "gauge: " marks directions that no data can determine.
    spread : (p,) standard deviations along the directions `vectors`, in units of the limits; empty without limits.
    """

    rank: int
    expected: int
    singular_values: np.ndarray
    weakest: str
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    vectors: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    held: tuple[str, ...] = ()
    null_space: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    null_names: tuple[str, ...] = ()
    spread: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)

    def __post_init__(self) -> None:
        for name in ("singular_values", "scale", "vectors", "null_space", "spread"):
            values = still(getattr(self, name), f"{name} of an excitation")
            object.__setattr__(self, name, values)

    @classmethod
    def of(cls, A: np.ndarray, names: Sequence[str], max_condition: float = MAX_CONDITION) -> Excitation:
        """Return the excitation of a design matrix; weak directions do not raise an error.

        Parameters
        ----------
        A : (m, p) whitened design matrix, or its triangular factor R (p, p).
        names : names of the p parameters.
        max_condition : maximum ratio of the largest singular value to a singular value that counts towards the rank.
        """
        A = numbers(A, "a design matrix", ShapeError)
        if A.ndim != 2 or A.shape[1] != len(names) or not np.isfinite(A).all():
            raise ShapeError(
                f"Expected a finite design matrix with {len(names)} columns, got shape {A.shape}. Pass one name per "
                "column."
            )
        norms = np.linalg.norm(A, axis=0)
        scale = np.where(norms > 0, norms, 1.0)
        scaled = A / scale
        if len(A) > A.shape[1]:
            scaled = np.linalg.qr(scaled, mode="r")
        _, found, rows = np.linalg.svd(scaled, full_matrices=True)
        singular = np.zeros(len(names))
        singular[: len(found)] = found
        rank = int(np.count_nonzero((singular >= singular[0] / max_condition) & (singular > 0)))
        return cls(rank, len(names), singular, _describe(rows[-1], names), scale, rows.T)

    @classmethod
    def of_covariance(cls, cov: np.ndarray, names: Sequence[str]) -> Excitation:
        """Return the excitation of an estimate that has a covariance but no design matrix.

        Parameters
        ----------
        cov : (p, p) covariance of full rank.
        names : names of the p parameters; p may be 0.
        """
        cov = numbers(cov, "a covariance", ShapeError)
        if cov.shape != (len(names), len(names)):
            raise ShapeError(f"Expected a covariance of {len(names)} parameters, got shape {cov.shape}.")
        if not len(names):
            return cls(0, 0, np.zeros(0), "no fitted parameters")
        sd = np.sqrt(np.diag(cov))
        return cls.of(np.linalg.inv(np.linalg.cholesky(cov / np.outer(sd, sd))) / sd, names)

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest singular value; 1 without parameters."""
        if not self.singular_values.size:
            return 1.0
        smallest = self.singular_values[-1]
        return float(self.singular_values[0] / smallest) if smallest > 0 else float("inf")

    def text(self) -> str:
        """Return one report line, and one line for each unobservable direction and each direction held by a prior."""
        good = self.spread.max() < 1.0 if self.spread.size else self.condition < WARN_CONDITION
        verdict = "good" if good else "weak: record a longer or richer motion"
        found = f"rank {self.rank} of {self.expected}, condition {self.condition:.0f}"
        lines = [f"excitation {verdict}: {found}; weakest: {self.weakest}"]
        lines += [f"not observable: {direction}" for direction in self.null_names]
        return "\n".join([*lines, *(f"held by the prior: {direction}" for direction in self.held)])


def check_excitation(
    A: np.ndarray, names: Sequence[str], what: str, prior: Prior | None = None, max_condition: float = MAX_CONDITION
) -> Excitation:
    """Return the excitation of a whitened design matrix (m, p); weak directions raise an error without a prior."""
    A = numbers(A, "a design matrix", ShapeError)
    if prior is not None:
        values, sd, p = np.asarray(prior.values), np.asarray(prior.sd), len(names)
        if values.shape != (p,) or sd.shape != (p,) or not np.isfinite(values).all() or not np.all(sd > 0):
            raise ShapeError(
                f"Expected a prior of {p} finite values with positive standard deviations, got shapes {values.shape} "
                f"and {sd.shape}. Pass one value and one standard deviation per parameter."
            )
        A = A * (np.linalg.norm(A, axis=0) * prior.sd > UNOBSERVABLE)
    found = Excitation.of(A, names, max_condition)
    weak = range(found.expected - 1, found.rank - 1, -1)  # weakest direction first
    directions = tuple(_describe(found.vectors[:, i], names) for i in weak)
    if prior is not None:
        return replace(found, held=directions)
    if not np.isfinite(max_condition):
        return found
    dead = [name for name, column in zip(names, A.T) if not column.any()]
    if dead:
        raise NotExcited(
            f"Expected motion that excites every parameter of the {what}, but the data do not excite: "
            f"{', '.join(dead)}. Record a log in which these joints move.",
            dead,
            ["no signal"] * len(dead),
        )
    if directions:
        strongest = found.singular_values[0]
        raise NotExcited(
            f"Expected motion that excites every direction of the {what} (condition below {max_condition:.0e}), but "
            f"the motion does not determine: {'; '.join(directions)}. Record a log that moves these joints together "
            "and separately, at several speeds and poses.",
            directions,
            [f"{found.singular_values[i] / strongest:.1e} of the strongest direction" for i in weak],
        )
    return found


def check_spread(
    J: np.ndarray,
    names: Sequence[str],
    units: Sequence[str],
    limits: np.ndarray,
    what: str,
    describe: Describe | None = None,
) -> Excitation:
    """Return the excitation, or raise an error if the standard deviation along a direction exceeds its limit.

    In units of the limits (p,), the standard deviation along v is ``1 / |J diag(limits) v|``, where J (m, p) is the
    whitened Jacobian of the data or its triangular factor. `describe` returns the name of a direction (p,), which is
    scaled to one standard deviation, or to the limits if it is unobservable.
    """
    p, J, limits = len(names), numbers(J, "a Jacobian", ShapeError), numbers(limits, "limits", ShapeError)
    if J.ndim != 2 or J.shape[1] != p or limits.shape != (p,) or not np.all(limits > 0) or not np.isfinite(J).all():
        raise ShapeError(
            f"Expected a finite Jacobian (m, {p}) and {p} limits above zero, got shapes {J.shape} and {limits.shape}."
            " Pass one name, unit and limit per parameter."
        )
    scaled = (triangle(J) if len(J) > p else J) * limits
    _, found, rows = np.linalg.svd(scaled, full_matrices=True)
    singular, vectors = np.zeros(p), rows.T
    singular[: len(found)] = found
    unseen = singular <= NULL * np.abs(vectors.T) @ np.linalg.norm(scaled, axis=0)  # NULL of the combined norms
    spread = np.divide(1.0, singular, out=np.full_like(singular, np.inf), where=~unseen)

    def words(i: int) -> str:
        reach = limits * vectors[:, i] * (1.0 if unseen[i] else spread[i])
        if describe is not None:
            return describe(reach)
        k = int(np.argmax(np.abs(vectors[:, i])))
        return _describe(vectors[:, i], names) + ("" if unseen[i] else f" ({abs(reach[k]):.2g} {units[k]})")

    weak = np.flatnonzero(spread > 1.0)[::-1]
    if len(weak):
        directions = [words(int(i)) for i in weak]
        raise NotExcited(
            f"Expected data that determine every direction of the {what}, but standard deviations exceed their "
            f"limits along: {'; '.join(directions)}. Measure at poses that differ more along these directions.",
            directions,
            ["unobservable" if not np.isfinite(s) else f"{s:.2g} times the limit" for s in spread[weak]],
        )
    empty = np.zeros((p, 0))
    return Excitation(p, p, singular, words(p - 1), 1.0 / limits, vectors, null_space=empty, spread=spread)


def _describe(vector: np.ndarray, names: Sequence[str]) -> str:
    """Name the parameters with the largest components of a direction."""
    order = np.argsort(-np.abs(vector))[:3]
    kept = [i for i in order if abs(vector[i]) > NAMED * abs(vector[order[0]])]
    return " and ".join(str(names[int(i)]) for i in kept)


BLOCK_ROUNDS = 10  # rounds without progress before single-constraint pivoting
ROUNDING = 1e-12  # added to the diagonal of the correlation matrix


def within_bounds(x: np.ndarray, cov: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the point of the box nearest to x (p,), ``min (z - x)^T cov^-1 (z - x)`` over ``lower <= z <= upper``.

    With the active bounds A, ``z = x + cov[:, A] m`` and ``m = cov[A, A]^-1 (bound - x)[A]``. A is optimal if every
    free z is inside and every multiplier m points inwards. Block principal pivoting exchanges all violating variables
    at once. After ten rounds without progress, the algorithm exchanges only one variable at a time, which guarantees
    termination (Portugal, Judice and Vicente 1994).
    """
    if np.all((x >= lower) & (x <= upper)):
        return x
    sd = np.sqrt(np.diag(cov))
    sd = np.where(sd > 0, sd, 1.0)
    correlation = cov / np.outer(sd, sd) + ROUNDING * np.eye(len(x))  # positive definite, as pivoting requires
    low, high, free = lower / sd, upper / sd, x / sd
    side = np.zeros(len(x), dtype=int)  # -1 at the lower bound, +1 at the upper
    fewest, patience = len(x) + 1, BLOCK_ROUNDS
    while True:
        held = np.flatnonzero(side)
        bound = np.where(side[held] < 0, low[held], high[held])
        push = np.linalg.solve(correlation[np.ix_(held, held)], bound - free[held])
        z = free + correlation[:, held] @ push
        z[held] = bound
        faults = np.where(z < low, -1, np.where(z > high, 1, 0))
        outward = held[push * side[held] > 0]
        wrong = np.union1d(np.flatnonzero(faults), outward)
        if not len(wrong):
            return np.where(side < 0, lower, np.where(side > 0, upper, z * sd))
        if len(wrong) < fewest:
            fewest, patience = len(wrong), BLOCK_ROUNDS
        else:
            patience -= 1
        mended = wrong if patience > 0 else wrong[-1:]
        side[mended] = np.where(side[mended] != 0, 0, faults[mended])


ROUNDS = 20  # maximum number of iterations of the class weights
TOLERANCE = 1e-4  # relative change of the class standard deviations at convergence; they are known to 1 % at best
EXACT = 1e-12  # residuals below this fraction of the measurements are rounding errors


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """Linear problem; bounds (p,) are infinite where unconstrained."""

    names: tuple[str, ...]
    what: str
    lower: np.ndarray
    upper: np.ndarray
    prior: Prior | None = None
    max_condition: float = MAX_CONDITION

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        what: str,
        lower: np.ndarray | None = None,
        upper: np.ndarray | None = None,
        prior: Prior | None = None,
        max_condition: float = MAX_CONDITION,
    ) -> LinearProblem:
        """Validate the bounds (p,); omitted bounds are infinite."""
        p = len(names)
        low = np.full(p, -np.inf) if lower is None else numbers(lower, "lower bounds", ShapeError)
        high = np.full(p, np.inf) if upper is None else numbers(upper, "upper bounds", ShapeError)
        if low.shape != (p,) or high.shape != (p,) or not np.all(low < high):
            raise ShapeError(
                f"Expected {p} lower bounds below the {p} corresponding upper bounds, got shapes {low.shape} and "
                f"{high.shape}. Use -inf and inf where there is no bound."
            )
        return cls(tuple(names), what, low, high, prior, max_condition)


@dataclass(frozen=True)
class ActiveBound:
    """Active bound of a parameter, with the unconstrained estimate `free` and its standard deviation."""

    name: str
    bound: float
    free: float
    free_sd: float

    def text(self) -> str:
        return f"{self.name} held at its bound {self.bound:g}; without the bound {self.free:.4g} +- {self.free_sd:.2g}"


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Parameters of a linear problem with the quantities needed for validation and resampling."""

    problem: LinearProblem
    x: np.ndarray  # (p,) parameters
    cov: np.ndarray  # (p, p) formal covariance, valid for white residuals; bounds do not narrow it
    weights: np.ndarray  # (G,) weights of the classes, 1 / sd
    sigma: np.ndarray  # (G,) standard deviation of the class residuals, corrected for degrees of freedom
    scale: float  # standard deviation of the weighted residuals; 1 for correct weights
    R: np.ndarray  # (p, p) triangular factor of the weighted regressor
    basis: np.ndarray  # (p, r) determined directions, R @ basis orthonormal
    excitation: Excitation
    active: tuple[ActiveBound, ...]
    growth: float  # relative increase of the residual due to the active bounds
    factors: Factors  # with the row weights of a robust solution
    measured: Factors  # without row weights
    kept: np.ndarray  # (B,) mask of the time blocks used
    stretch: float = 1.0  # spread of a robust solution relative to the weighted solution
    row_weights: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)  # (M,) of a robust solution
    rounds: int = 1
    converged: bool = True

    def __post_init__(self) -> None:
        make_read_only(self, "x", "cov", "weights", "sigma", "R", "basis", "kept", "row_weights")

    @property
    def sd(self) -> np.ndarray:
        """Formal standard deviation of each parameter (p,)."""
        return np.sqrt(np.diag(self.cov))

    @property
    def held_cov(self) -> np.ndarray:
        """Prior covariance (p, p) along the directions held by the prior; zero without a prior."""
        return _held_covariance(self.excitation, self.problem.prior)


MANY = 30.0  # degrees of freedom above which classes are pooled
POINTS, GOLDEN = 4096, 1.32471795724  # Roberts' quasi-random sequence
NEGLIGIBLE = 1e-6  # effective parameters below which a class is ignored


def student_factor(d: np.ndarray, nu: np.ndarray) -> float:
    """Return the covariance scale factor for which the 95 % chi-squared region has a coverage of 95 %.

    The squared error is distributed as ``sum_c d_c F(d_c, nu_c)`` if class c determines d_c of the parameters and its
    noise is estimated with nu_c degrees of freedom (infinite for given noise); `d` and `nu` are (C,).
    """
    from scipy.special import chdtri, fdtri

    total = float(d.sum())
    unsure = np.isfinite(nu) & (d > NEGLIGIBLE)
    if not unsure.any() or total < NEGLIGIBLE:
        return 1.0
    usual = float(chdtri(total, 0.05))
    d, nu = d[d > NEGLIGIBLE], np.maximum(nu[d > NEGLIGIBLE], 0.5)
    if len(d) == 1 or nu.min() > MANY:
        share = d / total  # interpolates between matching the mean and matching the variance
        one = 1.0 / np.sqrt(float(np.sum(share / nu)) * float(np.sum(share**2 / nu)))
        return total * float(fdtri(total, one, 0.95)) / usual
    u = np.outer(np.arange(1, POINTS + 1), 1.0 / GOLDEN ** np.arange(1, len(d) + 1)) % 1.0
    p = 1.0 / (1.0 + np.exp(-np.linspace(-12.0, 12.0, 97)))
    parts = (size * fdtri(size, free, p) if np.isfinite(free) else chdtri(size, 1.0 - p) for size, free in zip(d, nu))
    squares = sum(np.interp(one, p, part) for one, part in zip(u.T, parts))
    return max(float(np.quantile(squares, 0.95)) / usual, 1.0)


def solve(
    problem: LinearProblem, factors: Factors, weights: np.ndarray | None = None, kept: np.ndarray | None = None
) -> LinearSolution:
    """Solve with the factors of the `kept` blocks (B,); class weights (G,) are estimated iteratively if None."""
    kept = np.ones(len(factors.rows), dtype=bool) if kept is None else kept
    groups = factors.of_groups(kept)
    if weights is not None:
        return _solve_once(problem, factors, groups, kept, weights)
    rows, widths = factors.rows[kept].sum(axis=0), np.array([len(R) - 1 for R in groups])
    spread = np.array([np.linalg.norm(R[:, -1]) for R in groups]) / np.sqrt(np.maximum(rows, 1))
    alone = np.abs([R[-1, -1] for R in groups]) / np.sqrt(np.maximum(rows - widths, 1))  # residual of single-class fits
    weights = _inverse(np.where(rows > 2 * widths, alone, spread), spread)
    for _ in range(ROUNDS):
        solution = _solve_once(problem, factors, groups, kept, weights)
        before, weights = weights, _inverse(solution.sigma, spread)
        if np.allclose(weights, before, rtol=TOLERANCE, atol=0.0):
            return solution
    return _solve_once(problem, factors, groups, kept, weights)


def _inverse(sigma: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return 1 / sigma, bounded for noise-free classes and 1 for classes without measurements."""
    floor = np.maximum(sigma, EXACT * spread)
    return np.divide(1.0, floor, out=np.ones_like(floor), where=floor > 0)


def _solve_once(
    problem: LinearProblem, factors: Factors, groups: list[np.ndarray], kept: np.ndarray, weights: np.ndarray
) -> LinearSolution:
    p = factors.size
    whole = factors.merge(groups, weights)
    R, y = whole[:p, :p], whole[:p, p]
    excitation = check_excitation(R, problem.names, problem.what, problem.prior, problem.max_condition)
    basis = excitation.vectors[:, : excitation.rank] / excitation.singular_values[: excitation.rank]
    basis = basis / excitation.scale[:, None]
    rows = factors.rows[kept].sum(axis=0)
    free = int(rows.sum()) - excitation.rank
    if free < 1:
        raise NotExcited(
            f"Expected more than {excitation.rank} rows for the {problem.what}, got {rows.sum()}. Record more samples.",
            ["covariance"],
            [f"{rows.sum()} rows"],
        )
    loose = _free_solution(R, y, basis, excitation, problem.prior)
    least = np.linalg.norm(whole @ np.append(loose, -1.0))
    unsure = student_factor(np.array([float(excitation.rank)]), np.array([float(free)]))
    cov = unsure * least**2 / free * basis @ basis.T + _held_covariance(excitation, problem.prior)
    x = within_bounds(loose, cov, problem.lower, problem.upper)
    at, sd = np.flatnonzero((x <= problem.lower) | (x >= problem.upper)), np.sqrt(np.diag(cov))
    active = tuple(ActiveBound(problem.names[i], float(x[i]), float(loose[i]), float(sd[i])) for i in at)
    reached = np.linalg.norm(whole @ np.append(x, -1.0))
    own = [np.sum((w * g[:, :-1] @ basis[c]) ** 2) for g, c, w in zip(groups, factors.columns, weights)]
    power = np.array([np.sum((g @ np.append(x[c], -1.0)) ** 2) for g, c in zip(groups, factors.columns)])
    sigma, scale = np.sqrt(power / np.maximum(rows - np.array(own), 1.0)), float(reached / np.sqrt(free))
    growth = float(reached / least - 1.0) if active and least > 0 else 0.0
    return LinearSolution(
        problem, x, cov, weights, sigma, scale, R, basis, excitation, active, growth, factors, factors, kept
    )


def _free_solution(
    R: np.ndarray, y: np.ndarray, basis: np.ndarray, excitation: Excitation, prior: Prior | None
) -> np.ndarray:
    """Return the solution without bounds; the directions held by a prior are determined by the prior alone."""
    if prior is None or excitation.rank == excitation.expected:
        seen = excitation.singular_values > np.finfo(float).eps * len(R) * excitation.singular_values[0]
        basis = basis[:, seen[: basis.shape[1]]]
        orthonormal = R @ basis
        x = basis @ (orthonormal.T @ y)
        return x + basis @ (orthonormal.T @ (y - R @ x))  # corrects for R @ basis not being exactly orthonormal
    held = excitation.vectors[:, excitation.rank :]
    known = held @ (held.T @ (excitation.scale * prior.values)) / excitation.scale
    return known + basis @ ((R @ basis).T @ y)


def _held_covariance(excitation: Excitation, prior: Prior | None) -> np.ndarray:
    """Return the prior covariance (p, p) along the directions held by the prior."""
    held = excitation.vectors[:, excitation.rank :]
    if prior is None or not held.size:
        return np.zeros((excitation.expected,) * 2)
    across = held.T @ (held * ((excitation.scale * prior.sd) ** 2)[:, None])
    sides = held / excitation.scale[:, None]
    return sides @ across @ sides.T
