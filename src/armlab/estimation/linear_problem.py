"""The solution of a linear problem from its triangular factors: weights per class, bounds, priors, covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from armlab._numbers import make_read_only, numbers
from armlab.errors import NotExcited, ShapeError
from armlab.estimation.excitation import MAX_CONDITION, Excitation, Prior, check_excitation
from armlab.estimation.tsqr import Factors

# Bounds on the parameters of a least-squares problem that is already solved without them.


BLOCK_ROUNDS = 10  # rounds without fewer faults after which one fault at a time is mended


def within_bounds(x: np.ndarray, cov: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the nearest point to x in the box, ``min (z - x)^T cov^-1 (z - x)`` over ``lower <= z <= upper``.

    With A the bounds that hold, ``z = x + cov[:, A] m`` and ``m = cov[A, A]^-1 (bound - x)[A]``: the other parameters
    follow their correlations. A is right when every free z is inside and every m pushes inwards; block principal
    pivoting mends all faults at once, and after ten rounds without progress the first one only, which always ends.

    `x`: (p,) solution without bounds. `cov`: (p, p) its covariance, up to a factor. `lower`, `upper`: (p,) bounds,
    lower < upper. Returns: (p,) solution within the bounds; exactly at those that hold. After Portugal, Judice and
    Vicente (1994), A comparison of block pivoting and interior-point algorithms.
    """
    x, cov, lower, upper = (
        numbers(one, "solution, covariance and bounds", ShapeError) for one in (x, cov, lower, upper)
    )
    p = x.size
    if not x.shape == lower.shape == upper.shape == (p,) or cov.shape != (p, p):
        raise ShapeError(
            f"Expected x and its bounds (p,) and cov (p, p), got {x.shape}, {lower.shape}, {upper.shape}, {cov.shape}."
        )
    if np.all((x >= lower) & (x <= upper)):
        return x
    sd = np.sqrt(np.diag(cov))
    sd = np.where(sd > 0, sd, 1.0)
    correlation = cov / np.outer(sd, sd)
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


ROUNDS = 20
TOLERANCE = 1e-6  # relative change of the deviations of the classes
EXACT = 1e-12  # residuals below this share of the measurements are rounding


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """What is asked of the data; bounds (p,) are infinite where there is none."""

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
        """Check the bounds (p,) and fill in those that are left out."""
        p = len(names)
        low = np.full(p, -np.inf) if lower is None else numbers(lower, "lower bounds", ShapeError)
        high = np.full(p, np.inf) if upper is None else numbers(upper, "upper bounds", ShapeError)
        if low.shape != (p,) or high.shape != (p,) or not np.all(low < high):
            raise ShapeError(
                f"Expected {p} lower bounds below {p} upper bounds, got shapes {low.shape} and {high.shape}. "
                "Use -inf and inf where there is no bound."
            )
        return cls(tuple(names), what, low, high, prior, max_condition)


@dataclass(frozen=True)
class ActiveBound:
    """A bound that holds a parameter: its name, the bound, and where the data alone would put it, with deviation."""

    name: str
    bound: float
    free: float
    free_sd: float

    def text(self) -> str:
        return f"{self.name} held at its bound {self.bound:g}; without it {self.free:.4g} +- {self.free_sd:.2g}"


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Parameters of a linear problem with what is needed to judge and to resample them.

    `x`: (p,) parameters. `cov`: (p, p) formal covariance: right only for white residuals; bounds do not narrow it.
    `weights`: (G,) of the classes, 1 / sd. `sigma`: (G,) deviation of their residuals, degrees of freedom subtracted.
    `scale`: deviation of the weighted residuals; 1 when the weights are right. `R`: (p, p) triangle of the weighted
    regressor. `basis`: (p, r) directions that the data tell, ``R @ basis`` orthonormal. `kept`: (B,) blocks of time
    that count. `stretch`: how much further than the weighted solution a robust one moves, 1 without reweighting.
    `row_weights`: (M,) weights of the rows in the order they came in; empty without reweighting.
    """

    problem: LinearProblem
    x: np.ndarray
    cov: np.ndarray
    weights: np.ndarray
    sigma: np.ndarray
    scale: float
    R: np.ndarray
    basis: np.ndarray
    excitation: Excitation
    active: tuple[ActiveBound, ...]
    growth: float
    factors: Factors
    measured: Factors
    kept: np.ndarray
    stretch: float = 1.0
    row_weights: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
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
        """Covariance (p, p) of the prior along the directions that it holds; zero without a prior."""
        return _held_covariance(self.excitation, self.problem.prior)


def solve(
    problem: LinearProblem, factors: Factors, weights: np.ndarray | None = None, kept: np.ndarray | None = None
) -> LinearSolution:
    """Solve by factors, with weights (G,) of the classes, found in rounds when None, on the blocks `kept` (B,)."""
    kept = np.ones(len(factors.rows), dtype=bool) if kept is None else kept
    groups = factors.of_groups(kept)
    if weights is not None:
        return _solve_once(problem, factors, groups, kept, weights)
    spread = np.array([np.linalg.norm(R[:, -1]) for R in groups]) / np.sqrt(np.maximum(factors.rows[kept].sum(0), 1))
    weights = _inverse(spread, spread)
    for _ in range(ROUNDS):
        sigma = _solve_once(problem, factors, groups, kept, weights).sigma
        before, weights = weights, _inverse(sigma, spread)
        if np.allclose(weights, before, rtol=TOLERANCE, atol=0.0):
            break
    return _solve_once(problem, factors, groups, kept, weights)


def _inverse(sigma: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return 1 / sigma, bounded for classes without noise and 1 for those without measurements."""
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
    cov = least**2 / free * basis @ basis.T + _held_covariance(excitation, problem.prior)
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
    """Return the solution without bounds; the prior alone determines the held directions."""
    if prior is None or excitation.rank == excitation.expected:
        return np.linalg.lstsq(R / excitation.scale, y, rcond=None)[0] / excitation.scale
    held = excitation.vectors[:, excitation.rank :]
    known = held @ (held.T @ (excitation.scale * prior.values)) / excitation.scale
    return known + basis @ ((R @ basis).T @ y)


def _held_covariance(excitation: Excitation, prior: Prior | None) -> np.ndarray:
    """Return the covariance (p, p) of the prior along the directions that it holds."""
    held = excitation.vectors[:, excitation.rank :]
    if prior is None or not held.size:
        return np.zeros((excitation.expected,) * 2)
    across = held.T @ (held * ((excitation.scale * prior.sd) ** 2)[:, None])
    sides = held / excitation.scale[:, None]
    return sides @ across @ sides.T
