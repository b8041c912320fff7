"""Residuals of a nonlinear fit and their whitening: metres and radians are never mixed unweighted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from armlab.errors import ShapeError

__all__ = ["Measurement", "Whitened", "cost", "median_norm", "whiten"]


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
    prior : True for what was known before: it is no sample, cannot be an outlier and tells nothing of the noise.
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
        """Check the shapes."""
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
    """All rows of all measurements, whitened.

    Attributes
    ----------
    r : (M,) residuals. J : (M, d) derivatives.
    measurements : that they come from, in this order.
    kept : (M of all measurements,) rows that were not left out; None where all are here.
    """

    r: np.ndarray
    J: np.ndarray
    measurements: tuple[Measurement, ...]
    kept: np.ndarray | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the noise classes."""
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
    def raw(self) -> np.ndarray:
        """Residuals (M,) in SI."""
        return self._rows(lambda one: one.r.ravel())

    def _rows(self, of: Callable[[Measurement], np.ndarray]) -> np.ndarray:
        found = [of(one) for one in self.measurements]
        whole = found[0] if len(found) == 1 else np.concatenate(found)
        return whole if self.kept is None else whole[self.kept]

    def squares(self, count: int) -> np.ndarray:
        """Return the squared whitened residual (count,) of each sample."""
        return np.bincount(self.sample + 1, self.r**2, minlength=count + 1)[1:]  # priors are sample -1

    def numbers(self, count: int) -> np.ndarray:
        """Return how many numbers (count,) each sample has."""
        return np.bincount(self.sample + 1, minlength=count + 1)[1:]

    def times(self, weight: np.ndarray) -> Whitened:
        """Return it with a weight per sample (N,): rows times its root, rows of weight 0 left out; priors as they are.

        Parameters
        ----------
        weight : (N,) from 0 to 1.
        """
        if np.all(weight == 1.0):
            return self
        root = np.sqrt(np.append(weight, 1.0))[self.sample]
        if np.all(weight > 0):
            return replace(self, r=self.r * root, J=self.J * root[:, None])
        kept = root > 0
        root = root[kept]
        return Whitened(self.r[kept] * root, self.J[kept] * root[:, None], self.measurements, kept)


def whiten(measurements: Sequence[Measurement], roots: Sequence[np.ndarray]) -> Whitened:
    """Put all measurements below each other, whitened.

    Parameters
    ----------
    measurements : at one value. roots : their whitening factors, from `Measurement.roots`.
    """
    r, J = [], []
    for one, root in zip(measurements, roots):
        r.append(one.whitened(root).ravel())
        J.append((one.J * root[:, None] if root.ndim == 1 else root @ one.J).reshape(r[-1].size, -1))
    if len(r) == 1:
        return Whitened(r[0], J[0], tuple(measurements))
    return Whitened(np.concatenate(r), np.concatenate(J), tuple(measurements))


def cost(measurements: Sequence[Measurement], roots: Sequence[np.ndarray], weight: np.ndarray) -> float:
    """Return ``1/2 sum_i w_i r_i^T S_i^-1 r_i``.

    Parameters
    ----------
    measurements : at one value. roots : their whitening factors, from `Measurement.roots`.
    weight : (N,) of the samples; priors have weight 1.
    """
    total = 0.0
    for one, root in zip(measurements, roots):
        r = one.whitened(root)
        squares = np.einsum("ij,ij->i", r, r)
        total += float(np.sum(squares) if one.prior else squares @ weight[one.sample])
    return 0.5 * total


def median_norm(dimension: int) -> float:
    """Return the median length of a standard normal vector; 1.5382 in three dimensions.

    Parameters
    ----------
    dimension : of the vector.
    """
    from scipy.special import gammaincinv

    return float(np.sqrt(2.0 * gammaincinv(0.5 * dimension, 0.5)))
