"""Descent on a manifold: Gauss-Newton that damps itself when the cost does not fall.

Minimise ``1/2 sum_i r_i^T S_i^-1 r_i`` over a value that lives anywhere: a pose, a set of planes, link frames. The
caller gives residuals with their Jacobian and a retraction, ``value [+] x``; nothing else is asked of the value. Steps
come from the triangle R of the whitened Jacobian and its singular values, never from the normal matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from armlab.errors import NotConverged
from armlab.estimation.factors import triangle
from armlab.estimation.measurements import Measurement, Whitened, cost, whiten

__all__ = ["Descent", "Problem", "descend"]

Value = TypeVar("Value")

ITERATIONS = 100
STEP = 1e-9  # in deviations of the estimate
ROUNDING = 1e-13  # relative change of the cost that is rounding
IDLE, PATIENCE = 1e-3, 5  # steps so short that get no shorter, or lower nothing, are rounding too: exact data
EXACT = 1e-3  # and all steps are where residuals are a share so small of their deviation
MAX_DAMPING = 1e15
WELL = 1e7  # condition of a triangle below which its inverse serves
NULL = 1e-9  # relative singular value of the scaled Jacobian below which data see nothing
DAMPING = 1e-3  # first damping, relative to the largest singular value squared


@dataclass(frozen=True, eq=False)
class Problem(Generic[Value]):
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

    Attributes
    ----------
    value : the minimum. rows : whitened residuals and Jacobian there, weights of samples included.
    basis : (d, r) directions that the rows tell, ``J @ basis`` orthonormal; ``basis @ basis.T`` is the covariance.
    null : (d, d - r) orthonormal directions, in units of the scale, that they do not.
    step : length of the last step in deviations of the estimate.
    history : cost after each iteration.
    """

    value: Value
    rows: Whitened
    basis: np.ndarray
    null: np.ndarray
    step: float
    history: tuple[float, ...]


def descend(
    problem: Problem[Value],
    start: Value,
    sigma: dict[str, float],
    weight: np.ndarray,
    iterations: int = ITERATIONS,
    strict: bool = True,
) -> Descent[Value]:
    """Minimise the whitened cost from a start.

    The covariance of the residuals is that at the start of each step: a step is judged by the cost it promised to
    lower. Converged when the step is below 1e-9 deviations of the estimate, or the cost at its rounding floor.

    Parameters
    ----------
    problem : residuals and retraction.
    start : first value.
    sigma : deviation of each noise class that is estimated.
    weight : (N,) weight of each sample, 0 to leave it out.
    iterations : the most that are taken.
    strict : raise when that many did not converge; otherwise rows and basis are those before the last step.

    Raises
    ------
    NotConverged : after that many iterations, with the best value and the cost after each.

    References
    ----------
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


def _stuck(problem: Problem[Any], value: Any, history: list[float]) -> NotConverged:
    return NotConverged(
        f"Expected the fit of the {problem.what} to converge, got a cost of {history[-1]:.6g} after {len(history)} "
        "iterations. Give a better start, or look for wrong samples with robust=True.",
        best=value,
        history=history,
    )


@dataclass(frozen=True, eq=False)
class _Slope:
    """The linear problem at one value: what its rows tell, and the way down.

    The inverse of the triangle spans what the rows tell, at a third of the cost of singular values; these are for
    triangles that are nearly singular, and for damping.
    """

    R: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, problem: Problem[Any], rows: Whitened) -> _Slope:
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
        """Return the step (d,), and by how much it should lower the cost.

        Parameters
        ----------
        damping : relative to the largest singular value squared.
        """
        if damping == 0.0:
            return -self.basis @ self.along, 0.5 * float(self.along @ self.along)
        basis, singular, _, slope = self._singular
        shrink = singular**2 / (singular**2 + damping * singular[0] ** 2)
        return -basis @ (shrink * slope), float(slope @ (shrink * (1.0 - 0.5 * shrink) * slope))
