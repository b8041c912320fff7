"""Total least squares: errors in both the regressor and the measurements.

    (A - E_A) x = y - e_y, where the rows of [E_A e_y] are independent with covariance C_i

With rows z = [a y], w = [x; -1] and ``s_i = w^T C_i w``, the maximum-likelihood x minimises
``sum_i (z_i . w)^2 / s_i``. Row i is corrected by ``C_i w (z_i . w) / s_i``, and the corrected rows give the covariance
of x, ``(sum_i a_i a_i^T / s_i)^-1``. With a common covariance ``sigma^2 I``, the problem is solved by singular value
decomposition after eliminating the exact columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import make_read_only, numbers
from armlab.errors import NotExcited, ShapeError
from armlab.estimation.linear_problem import Excitation, check_excitation
from armlab.estimation.nonlinear import Measurement, NonlinearProblem, nonlinear_least_squares

WHAT = "total least squares"


@dataclass(frozen=True, eq=False)
class TotalSolution:
    """Parameters of a linear problem with an uncertain regressor."""

    x: np.ndarray  # (p,) parameters
    cov: np.ndarray  # (p, p) covariance of the parameters, to first order in the errors
    sigma: float  # estimated standard deviation of the errors; about 1 if the given covariance is correct
    corrections: np.ndarray  # (N, p + 1) estimated errors of [A y]; rows minus these errors are consistent with x
    outliers: np.ndarray  # (N,) mask of excluded rows
    excitation: Excitation

    def __post_init__(self) -> None:
        make_read_only(self, "x", "cov", "corrections", "outliers")


def total_least_squares(
    A: ArrayLike,
    y: ArrayLike,
    *,
    cov: ArrayLike | None = None,
    exact: Sequence[int] = (),
    robust: bool = False,
    names: Sequence[str] | None = None,
) -> TotalSolution:
    """Solve ``A x = y`` with errors on both sides.

    Parameters
    ----------
    A : (N, p) regressor, N > p.
    y : (N,) measurements.
    cov : (p + 1, p + 1) covariance of the errors of a row [a y], or (N, p + 1, p + 1), one per row (weighted total
        least squares). Zero rows and columns mark exact columns of A; y must have errors. Default: all errors have the
        same standard deviation, which is estimated.
    exact : error-free columns of A, for example an offset column; with `cov`, use zeros instead.
    robust : detect outliers and mark them in `outliers`; requires `cov`.
    names : names of the p parameters, for messages.

    Raises
    ------
    ShapeError : wrong shapes, non-finite values (the message lists the rows), or an invalid covariance.
    NotExcited : too few rows, or indistinguishable columns.
    NotConverged : the weighted iteration did not converge.

    References
    ----------
    Golub and Van Loan (1980); Golub, Hoffman and Stewart (1987) (exact columns); Van Huffel and Vandewalle (1991), The
    total least squares problem.
    """
    A, y = _checked(A, y)
    p = A.shape[1]
    labels = tuple(names) if names is not None else tuple(f"x{k}" for k in range(p))
    if any(k not in range(p) for k in exact):
        raise ShapeError(f"Expected exact columns from 0 to {p - 1}, got {list(exact)}. Number the columns from 0.")
    free = np.setdiff1d(np.arange(p), list(exact))
    if len(labels) != p:
        raise ShapeError(f"Expected {p} names for {p} columns, got {len(labels)}. Name every column exactly once.")
    if len(A) <= p:
        raise NotExcited(
            f"Expected more than {p} rows for {p} parameters, got {len(A)}. Measure more rows.",
            labels,
            [f"{len(A)} rows"],
        )
    if cov is not None:
        if len(free) < p:
            raise ShapeError("Expected exact= or cov=, got both. Use zeros in cov for exact columns.")
        return _weighted(A, y, _covariance(cov, len(A), p + 1), robust, labels)
    if robust:
        raise ShapeError("Expected cov= with robust=True, got no cov. Pass the covariance of the inlier rows.")
    return _plain(A, y, free, labels)


def _plain(A: np.ndarray, y: np.ndarray, free: np.ndarray, names: tuple[str, ...]) -> TotalSolution:
    """Return the solution for errors with equal standard deviations, by singular value decomposition."""
    N, p = A.shape
    exact = np.setdiff1d(np.arange(p), free)
    Z = np.column_stack([A[:, free], y])
    Q = np.linalg.qr(A[:, exact])[0]
    rest = Z - Q @ (Q.T @ Z)
    check_excitation(A, names, WHAT)
    _, singular, rows = np.linalg.svd(rest, full_matrices=False)
    last = rows[-1]
    if not abs(last[-1]) > 1e-9:
        raise NotExcited(
            f"Expected columns that explain y, got a combination of {', '.join(names[k] for k in free)} that is zero "
            "within its errors. Measure with more variation.",
            [names[k] for k in free],
            ["no solution"],
        )
    w = last / -last[-1]
    x = np.zeros(p)
    x[free] = w[:-1]
    gap = rest @ w
    corrections = np.zeros((N, p + 1))
    corrections[:, [*free, p]] = np.outer(gap, w) / (w @ w)
    if len(exact):
        x[exact] = np.linalg.lstsq(A[:, exact], y - A[:, free] @ x[free], rcond=None)[0]
    sigma = float(singular[-1] / np.sqrt(N - p))
    clean = A - corrections[:, :p]
    excitation = check_excitation(clean, names, WHAT)
    R = np.linalg.qr(clean, mode="r")
    root = np.linalg.inv(R) * (sigma * float(np.linalg.norm(w)))
    return TotalSolution(x, root @ root.T, sigma, corrections, np.zeros(N, dtype=bool), excitation)


def _weighted(A: np.ndarray, y: np.ndarray, cov: np.ndarray, robust: bool, names: tuple[str, ...]) -> TotalSolution:
    """Return the solution for rows with covariances (N, p + 1, p + 1), by Gauss-Newton."""
    Z, p = np.column_stack([A, y]), A.shape[1]
    check_excitation(A, names, WHAT)

    def parts(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w = np.append(x, -1.0)
        spread = cov @ w
        return Z @ w, spread, spread @ w

    def evaluate(x: np.ndarray) -> list[Measurement]:
        gap, spread, s = parts(x)
        clean = A - (gap / s)[:, None] * spread[:, :p]
        root = np.sqrt(s)
        return [Measurement((gap / root)[:, None], (clean / root[:, None])[:, None], np.eye(1), ("row",))]

    scale = 1.0 / np.sqrt(parts(np.zeros(p))[2])  # rows weighted by the noise of y alone
    start = np.linalg.lstsq(A * scale[:, None], y * scale, rcond=None)[0]
    found = nonlinear_least_squares(NonlinearProblem(evaluate, np.add, what=WHAT), start, robust=robust)
    gap, spread, s = parts(found.value)
    excitation = check_excitation(found.rows.J, names, WHAT)
    corrections = (gap / s)[:, None] * spread
    return TotalSolution(found.value, found.cov, float(found.sigma[0]), corrections, found.outliers, excitation)


def _checked(A: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    A, y = numbers(A, "A", ShapeError), numbers(y, "y", ShapeError)
    if A.ndim != 2 or not A.shape[1] or y.shape != A.shape[:1]:
        raise ShapeError(f"Expected A (N, p) and y (N,), got {A.shape} and {y.shape}. Pass one row per measurement.")
    bad = np.flatnonzero(~(np.isfinite(A).all(axis=1) & np.isfinite(y)))
    if len(bad):
        shown = ", ".join(str(i) for i in bad[:10]) + (" and more" if len(bad) > 10 else "")
        raise ShapeError(f"Expected finite rows, got NaN or Inf in rows {shown}. Drop these rows.")
    return A, y


def _covariance(cov: ArrayLike, N: int, k: int) -> np.ndarray:
    C = numbers(cov, "cov", ShapeError)
    if C.shape not in ((k, k), (N, k, k)) or not np.isfinite(C).all():
        raise ShapeError(f"Expected a finite cov ({k}, {k}) or ({N}, {k}, {k}) of the rows [a y], got {C.shape}.")
    each = np.broadcast_to(C, (N, k, k))
    low = np.linalg.eigvalsh(C)[..., 0]
    tolerance = -1e-9 * np.trace(C, axis1=-2, axis2=-1)
    skew = np.abs(C - np.swapaxes(C, -1, -2)).max(axis=(-1, -2)) > 1e-9 * np.abs(C).max(axis=(-1, -2))
    if np.any(low < tolerance) or np.any(skew) or np.any(each[:, -1, -1] <= 0):
        raise ShapeError(
            "Expected symmetric, positive semidefinite covariances with a positive variance of y, got an invalid "
            "covariance. The diagonal must contain squared standard deviations."
        )
    return each
