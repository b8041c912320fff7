"""Residuals of a nonlinear fit and their whitening: metres and radians are never mixed unweighted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

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
    cov : (k, k) or (m, k, k) covariance of r; None when the noise is to be estimated, a deviation per class.
    classes : name of the noise class of each of the k numbers, for example ("t", "t", "t", "R", "R", "R").
    sample : (m,) number of the sample (pose, scan, point) that each measurement belongs to; 0 to m - 1 when left out.
        Outliers are found by samples.
    prior : True for what was known before: it is no sample, cannot be an outlier and tells nothing of the noise.
    """

    r: np.ndarray
    J: np.ndarray
    cov: np.ndarray | None
    classes: tuple[str, ...]
    sample: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    prior: bool = False

    def __post_init__(self) -> None:
        """Check the shapes."""
        m, k = self.r.shape if self.r.ndim == 2 else (0, 0)
        given = None if self.cov is None else self.cov.shape
        if not self.sample.size:
            object.__setattr__(self, "sample", np.arange(m))
        fits = self.r.ndim == 2 and self.J.shape[:2] == (m, k) and self.J.ndim == 3 and len(self.classes) == k
        if not fits or given not in (None, (k, k), (m, k, k)) or self.sample.shape != (m,):
            raise ShapeError(
                "Expected r (m, k), J (m, k, d), cov (k, k) or (m, k, k), k classes and sample (m,), got "
                f"{self.r.shape}, {self.J.shape}, {given}, {len(self.classes)} and {self.sample.shape}. "
                "This is a fault of the residual."
            )
        if self.prior and self.cov is None:
            raise ShapeError("Expected the covariance of a prior, got None. Say how surely it is known.")

    def roots(self, sigma: dict[str, float]) -> np.ndarray:
        """Return the whitening factor (k, k) or (m, k, k): the inverse of the Cholesky factor of the covariance.

        Parameters
        ----------
        sigma : deviation of each class whose noise is estimated.
        """
        if self.cov is None:
            return np.diag([1.0 / sigma[name] for name in self.classes])
        try:
            return np.linalg.inv(np.linalg.cholesky(self.cov))
        except np.linalg.LinAlgError:
            raise ShapeError(
                "Expected noise with a positive definite covariance, got one that is not. Give standard deviations "
                "above zero."
            ) from None


@dataclass(frozen=True, eq=False)
class Whitened:
    """All rows of all measurements, whitened.

    Attributes
    ----------
    r : (M,) residuals. J : (M, d) derivatives.
    sample : (M,) sample of each row, -1 for priors. label : (M,) number of its noise class, -1 for priors.
    raw : (M,) residuals in SI. factor : (M,) 1 / sd of each row.
    names : of the noise classes. estimated : those without given noise.
    """

    r: np.ndarray
    J: np.ndarray
    sample: np.ndarray
    label: np.ndarray
    raw: np.ndarray
    factor: np.ndarray
    names: tuple[str, ...]
    estimated: frozenset[str]

    @property
    def data(self) -> np.ndarray:
        """Mask (M,) of the rows that are no prior."""
        return self.sample >= 0

    def squares(self, count: int) -> np.ndarray:
        """Return the squared whitened residual (count,) of each sample."""
        rows = self.data
        return np.bincount(self.sample[rows], self.r[rows] ** 2, minlength=count)

    def numbers(self, count: int) -> np.ndarray:
        """Return how many numbers (count,) each sample has."""
        return np.bincount(self.sample[self.data], minlength=count)

    def times(self, weight: np.ndarray) -> Whitened:
        """Return it with a weight per sample (N,): rows times its root, rows of weight 0 left out; priors as they are.

        Parameters
        ----------
        weight : (N,) from 0 to 1.
        """
        if np.all(weight == 1.0):
            return self
        root = np.where(self.data, np.sqrt(weight[self.sample]), 1.0)
        kept = root > 0
        root = root[kept]
        return Whitened(
            self.r[kept] * root,
            self.J[kept] * root[:, None],
            self.sample[kept],
            self.label[kept],
            self.raw[kept],
            self.factor[kept],
            self.names,
            self.estimated,
        )


def whiten(measurements: Sequence[Measurement], roots: Sequence[np.ndarray]) -> Whitened:
    """Put all measurements below each other, whitened.

    Parameters
    ----------
    measurements : at one value. roots : their whitening factors, from `Measurement.roots`.
    """
    names = tuple(dict.fromkeys(name for one in measurements if not one.prior for name in one.classes))
    r, J, sample, label, raw, factor = [], [], [], [], [], []
    for one, root in zip(measurements, roots):
        m, k = one.r.shape
        r.append((root @ one.r[:, :, None]).ravel())
        J.append((root @ one.J).reshape(m * k, -1))
        sample.append(np.repeat(np.full(m, -1) if one.prior else one.sample, k))
        label.append(np.tile([-1 if one.prior else names.index(name) for name in one.classes], m))
        raw.append(one.r.ravel())
        factor.append(np.broadcast_to(np.diagonal(root, axis1=-2, axis2=-1), (m, k)).ravel())
    free = frozenset(name for one in measurements if one.cov is None for name in one.classes)
    first, second = (np.concatenate(r), np.concatenate(J)), (np.concatenate(sample), np.concatenate(label))
    return Whitened(*first, *second, np.concatenate(raw), np.concatenate(factor), names, free)


def cost(measurements: Sequence[Measurement], roots: Sequence[np.ndarray], weight: np.ndarray) -> float:
    """Return ``1/2 sum_i w_i r_i^T S_i^-1 r_i``.

    Parameters
    ----------
    measurements : at one value. roots : their whitening factors, from `Measurement.roots`.
    weight : (N,) of the samples; priors have weight 1.
    """
    total = 0.0
    for one, root in zip(measurements, roots):
        squares = np.sum((root @ one.r[:, :, None]) ** 2, axis=(1, 2))
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
