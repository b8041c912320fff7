"""Probabilistic movement primitives: a distribution over motions, from several demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import generator, number, numbers, positive
from armlab.errors import ConfigError, ShapeError
from armlab.motion._basis import normalised
from armlab.motion._saved import Saved, freeze_arrays
from armlab.motion._setting import clock
from armlab.motion.motion_band import SAME, MotionBand

__all__ = ["ProMP"]

UNLIKELY = 1e-6  # of a point: distance that no motion of the distribution goes


@dataclass(frozen=True, eq=False)
class ProMP(Saved, kind="promp"):
    """A distribution over motions of n coordinates: ``y(t) = psi(t / duration) w``, ``w ~ N(mean, cov)``.

    psi are Gaussian kernels over their sum. What is measured has white noise besides.

    Attributes
    ----------
    mean : (n_basis, n) mean weights. cov : (n_basis n, n_basis n) of the weights, coordinate by coordinate.
    centres, widths : (n_basis,) of the kernels in time over duration. duration : mean of the demonstrations [s].
    noise : (n,) standard deviation of the noise of the demonstrations.

    Raises
    ------
    ShapeError : fields that do not fit each other, are not finite, or no covariance.

    References
    ----------
    Paraschos, Daniel, Peters and Neumann, Using probabilistic movement primitives in robotics, Autonomous Robots 2018.
    """

    mean: np.ndarray
    cov: np.ndarray
    centres: np.ndarray
    widths: np.ndarray
    duration: float
    noise: np.ndarray

    UNITS: ClassVar[dict[str, str]] = {
        **dict.fromkeys(("mean", "noise"), "unit of y"),
        "cov": "unit of y, squared",
        "duration": "s",
        **dict.fromkeys(("centres", "widths"), "1"),
    }

    def __post_init__(self) -> None:
        """Check and freeze."""
        freeze_arrays(self, "mean", "cov", "centres", "widths", "noise")
        if self.mean.ndim != 2 or not self.mean.size:
            raise ShapeError(f"Expected mean weights of shape (n_basis, n), got {self.mean.shape}.")
        m, n = self.mean.shape
        for name, shape in {"cov": (m * n, m * n), "centres": (m,), "widths": (m,), "noise": (n,)}.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(f"Expected {name} of shape {shape}, got {getattr(self, name).shape}.")
        if np.any(self.widths <= 0.0) or np.any(self.noise < 0.0):
            raise ShapeError("Expected widths above zero and noise not below, got others. Fit it again.")
        if np.abs(self.cov - self.cov.T).max() > 1e-9 * (1e-300 + np.abs(self.cov).max()):
            raise ShapeError("Expected a symmetric cov, got another. Fit it again.")
        object.__setattr__(self, "duration", positive(self.duration, "duration [s]"))

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.mean.shape[1]

    def kernels(self, t: ArrayLike, duration: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return kernels and their rates (..., n_basis) at times (...).

        Parameters
        ----------
        t : since the start [s]. duration : of the motion [s]; that of the demonstrations when left out.
        """
        T = self.duration if duration is None else positive(duration, "duration [s]")
        u = numbers(t, "t", ShapeError)[..., None] / T
        psi, rate = normalised(u, self.centres, self.widths)
        return psi, rate / T

    def times(self, t: ArrayLike, duration: float | None = None) -> np.ndarray:
        """Return times (N,): those given, or from 0 in steps to the end of the motion.

        Parameters
        ----------
        t : (N,) since the start [s], or one step [s]. duration : of the motion [s].

        Raises
        ------
        ShapeError : times that are not finite, no step above zero.
        """
        times = clock(t, self.duration if duration is None else positive(duration, "duration [s]"))
        if times.ndim != 1 or not times.size or not np.isfinite(times).all():
            raise ShapeError(f"Expected finite times (N,), got shape {times.shape}. Or give one step [s].")
        return times

    def marginal(self, t: ArrayLike, *, duration: float | None = None) -> MotionBand:
        """Return mean and covariance of position and velocity at each time: ``Psi mean``, ``Psi cov Psi^T``.

        Parameters
        ----------
        t : (N,) times since the start [s], or one step [s] until the end. duration : of the motion [s].

        Raises
        ------
        ShapeError : no times, no positive duration.
        """
        times = self.times(t, duration)
        psi, rate = self.kernels(times, duration)
        blocks = self.cov.reshape(self.n, len(self.centres), self.n, len(self.centres))
        spread, speed = (_spread(rows, blocks) for rows in (psi, rate))
        return MotionBand(times, psi @ self.mean, rate @ self.mean, spread, speed)

    def sample(
        self, t: ArrayLike, seed: int | np.random.Generator, count: int, *, duration: float | None = None
    ) -> np.ndarray:
        """Draw motions (count, N, n) from the distribution.

        Parameters
        ----------
        t, duration : as of `marginal`. seed : whole number or Generator. count : of motions.

        Raises
        ------
        ShapeError : no times, no seed. ConfigError : no whole count above zero.
        """
        if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
            raise ConfigError(f"Expected a whole count of motions above zero, got {count!r}.")
        values, vectors = np.linalg.eigh(self.cov)
        draws = generator(seed).standard_normal((int(count), len(values)))
        w = self.mean.T.ravel() + (draws * np.sqrt(values.clip(min=0.0))) @ vectors.T
        psi, _ = self.kernels(self.times(t, duration), duration)
        return np.einsum("ta,kia->kti", psi, w.reshape(int(count), self.n, -1))

    def _inside(self, t: float, duration: float | None) -> float:
        time, end = number(t, "t [s]"), self.duration if duration is None else positive(duration, "duration [s]")
        if not 0.0 <= time <= end * (1 + 1e-9):
            raise ShapeError(f"Expected a time from 0 to {end:g} s, the duration, got {time:g} s. Give one inside.")
        return time

    def condition(
        self,
        t: float,
        y: ArrayLike | None = None,
        yd: ArrayLike | None = None,
        *,
        cov: ArrayLike = 0.0,
        velocity_cov: ArrayLike = 0.0,
        coordinates: Sequence[int] | None = None,
        duration: float | None = None,
    ) -> ProMP:
        """Return the distribution of the motions that pass a position or velocity at a time.

        ``K = cov H^T (H cov H^T + R)^-1``, ``mean + K (z - H mean)``, ``cov - K H cov``. Without a covariance of the
        point all motions pass it exactly, as far as the demonstrations differ there.

        Parameters
        ----------
        t : since the start, up to the duration [s]. y, yd : (k,) position and velocity of the coordinates.
        cov, velocity_cov : (k, k) of the point, or a variance for all.
        coordinates : numbers of the k coordinates; all n when left out. duration : of the motion [s].

        Raises
        ------
        ShapeError : neither position nor velocity, shapes that do not fit, a point that no motion of the distribution
            comes near to.
        """
        index = np.arange(self.n) if coordinates is None else _coordinates(coordinates, self.n)
        psi, rate = self.kernels(self._inside(t, duration), duration)
        rows, z, R = [], [], []
        for row, value, spread, what in ((psi, y, cov, "y"), (rate, yd, velocity_cov, "yd")):
            if value is None:
                continue
            point = np.atleast_1d(numbers(value, what, ShapeError))
            if point.shape != index.shape or not np.isfinite(point).all():
                raise ShapeError(f"Expected finite {what} of shape ({len(index)},), got {point.tolist()}.")
            rows.append(row)
            z.append(point)
            R.append(_covariance(spread, len(index)))
        if not rows:
            raise ShapeError("Expected a position or a velocity to pass, got neither. Give y or yd.")
        return self._conditioned(np.stack(rows), index, np.concatenate(z), _block_diagonal(R))

    def _conditioned(self, rows: np.ndarray, index: np.ndarray, z: np.ndarray, R: np.ndarray) -> ProMP:
        def at_point(w: np.ndarray) -> np.ndarray:
            """Return H w of weights (n_basis n, ...): H would be nothing but `rows` for each coordinate, and zeros."""
            of_each = w.reshape(self.n, len(self.centres), -1)[index]
            return np.concatenate([row @ of_each for row in rows]).reshape(len(z), *w.shape[1:])

        w, H_cov = self.mean.T.ravel(), at_point(self.cov)
        off, S = z - at_point(w), at_point(H_cov.T) + R
        values, vectors = np.linalg.eigh(S)
        free = values > SAME * max(float(values[-1]), 1e-300)
        along = vectors.T @ off
        if np.any(np.abs(along[~free]) > UNLIKELY * (1.0 + np.abs(z).max())):
            raise ShapeError(
                "Expected a point that motions of the distribution can pass, got one in a direction in which the "
                "demonstrations do not differ. Give a covariance of the point, or more demonstrations."
            )
        gain = H_cov.T @ ((vectors[:, free] / values[free]) @ vectors[:, free].T)
        cov = self.cov - gain @ H_cov - (H_cov.T - gain @ S) @ gain.T  # Joseph's form, multiplied out
        mean = (w + gain @ off).reshape(self.n, -1).T
        return ProMP(mean, 0.5 * (cov + cov.T), self.centres, self.widths, self.duration, self.noise)


def _spread(rows: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Return ``sum_ab rows_ta blocks_iajb rows_tb`` (N, n, n)."""
    half = np.tensordot(rows, blocks, (1, 1))
    return (half.reshape(len(rows), -1, rows.shape[1]) @ rows[:, :, None]).reshape(half.shape[:3])


def _coordinates(value: Sequence[int], n: int) -> np.ndarray:
    index = numbers(value, "coordinates", ShapeError)
    if index.ndim != 1 or len({*index.tolist()} & {*range(n)}) != len(index):
        raise ShapeError(f"Expected different coordinates from 0 to {n - 1}, got {index.tolist()}.")
    return index.astype(int)


def _covariance(value: ArrayLike, k: int) -> np.ndarray:
    given = numbers(value, "cov", ShapeError)
    if given.shape not in ((), (k, k)) or not np.isfinite(given).all():
        raise ShapeError(f"Expected a covariance as a number or of shape ({k}, {k}), got shape {given.shape}.")
    matrix = np.eye(k) * given if given.ndim == 0 else given
    if np.abs(matrix - matrix.T).max() > 0 or np.linalg.eigvalsh(matrix)[0] < 0.0:
        raise ShapeError("Expected a symmetric covariance that is not negative, got another.")
    return matrix


def _block_diagonal(parts: list[np.ndarray]) -> np.ndarray:
    size = sum(len(part) for part in parts)
    whole, at = np.zeros((size, size)), 0
    for part in parts:
        whole[at : at + len(part), at : at + len(part)] = part
        at += len(part)
    return whole
