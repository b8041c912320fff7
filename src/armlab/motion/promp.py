"""Probabilistic movement primitives: a distribution over motions from several demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import generator, make_read_only, members, number, numbers, positive
from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation import Excitation, Fit
from armlab.estimation.linear_problem import check_excitation
from armlab.motion.arguments import clock, kernel_count
from armlab.motion.primitive.demonstrations import Demo, read_demos
from armlab.motion.primitive.equation import normalised
from armlab.motion.storage import Saved, freeze_arrays

UNLIKELY = 1e-6  # relative distance above which a point is outside the distribution

SAME = 1e-10  # fraction of the largest eigenvalue: directions with less variance count as fixed
FLOOR = 1e-6  # fraction of the mean variance added to every direction, because some directions may have no variation

FEWEST = 2  # minimum number of demonstrations
WIDTH = 0.8  # standard deviation of the kernels divided by their spacing
MAX_CONDITION = 1e6


@dataclass(frozen=True, eq=False, repr=False)
class ProMP(Saved, kind="promp"):
    """Distribution over motions of n coordinates: ``y(t) = psi(t / duration) w``, ``w ~ N(mean, cov)``.

    psi are normalised Gaussian kernels. Measurements have additional white noise.

    Attributes
    ----------
    mean : (n_basis, n) mean weights.
    cov : (n_basis n, n_basis n) weight covariance, coordinate by coordinate.
    centres, widths : (n_basis,) kernel centres and widths in time divided by duration.
    duration : mean duration of the demonstrations [s].
    noise : (n,) standard deviation of the measurement noise in the demonstrations.

    Raises
    ------
    ShapeError : fields with inconsistent shapes, non-finite values, or an invalid covariance.

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
        freeze_arrays(self, "mean", "cov", "centres", "widths", "noise")
        if self.mean.ndim != 2 or not self.mean.size:
            raise ShapeError(f"Expected mean weights of shape (n_basis, n), got {self.mean.shape}.")
        m, n = self.mean.shape
        for name, shape in {"cov": (m * n, m * n), "centres": (m,), "widths": (m,), "noise": (n,)}.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(f"Expected {name} of shape {shape}, got {getattr(self, name).shape}.")
        if np.any(self.widths <= 0.0) or np.any(self.noise < 0.0):
            raise ShapeError(
                f"Expected widths > 0 and noise >= 0, got {self.widths.min():g} and {self.noise.min():g}. Fit again."
            )
        if np.abs(self.cov - self.cov.T).max() > 1e-9 * (1e-300 + np.abs(self.cov).max()):
            raise ShapeError("Expected a symmetric cov, got an asymmetric matrix. Fit again.")
        object.__setattr__(self, "duration", positive(self.duration, "duration [s]"))

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.mean.shape[1]

    def kernels(self, t: ArrayLike, duration: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return kernels and their derivatives (..., n_basis) at times (...).

        Parameters
        ----------
        t : times since the start [s].
        duration : duration of the motion [s]; default: from the demonstrations.
        """
        T = self.duration if duration is None else positive(duration, "duration [s]")
        u = numbers(t, "t", ShapeError)[..., None] / T
        psi, rate = normalised(u, self.centres, self.widths)
        return psi, rate / T

    def _times(self, t: ArrayLike, duration: float | None = None) -> np.ndarray:
        """Return the given times (N,), or equally spaced times from 0 to the end of the motion."""
        times = clock(t, self.duration if duration is None else positive(duration, "duration [s]"))
        if times.ndim != 1 or not times.size or not np.isfinite(times).all():
            raise ShapeError(f"Expected finite times (N,), got shape {times.shape}. Pass times, or one step [s].")
        return times

    def marginal(self, t: ArrayLike, *, duration: float | None = None) -> TrajectoryDistribution:
        """Return the mean and covariance of position and velocity at each time: ``Psi mean``, ``Psi cov Psi^T``.

        Parameters
        ----------
        t : (N,) times since the start [s], or a time step [s] for equally spaced times up to the end.
        duration : duration of the motion [s].

        Raises
        ------
        ShapeError : invalid times or duration.
        """
        times = self._times(t, duration)
        psi, rate = self.kernels(times, duration)
        spread, speed = np.split(_spread(np.concatenate([psi, rate]), self.cov), 2)
        return TrajectoryDistribution(times, psi @ self.mean, rate @ self.mean, spread, speed)

    def sample(
        self, t: ArrayLike, seed: int | np.random.Generator, count: int, *, duration: float | None = None
    ) -> np.ndarray:
        """Draw motions (count, N, n) from the distribution.

        Parameters
        ----------
        t, duration : as in `marginal`.
        seed : integer or Generator.
        count : number of motions.

        Raises
        ------
        ShapeError : invalid times or seed.
        ConfigError : count is not a positive integer.
        """
        if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
            raise ConfigError(f"Expected a positive integer count of motions, got {count!r}.")
        values, vectors = np.linalg.eigh(self.cov)
        draws = generator(seed).standard_normal((int(count), len(values)))
        w = self.mean.T.ravel() + (draws * np.sqrt(values.clip(min=0.0))) @ vectors.T
        psi, _ = self.kernels(self._times(t, duration), duration)
        return np.einsum("ta,kia->kti", psi, w.reshape(int(count), self.n, -1))

    def _inside(self, t: float, duration: float | None) -> float:
        time, end = number(t, "t [s]"), self.duration if duration is None else positive(duration, "duration [s]")
        if not 0.0 <= time <= end * (1 + 1e-9):
            raise ShapeError(f"Expected a time from 0 to {end:g} s (the duration), got {time:g} s. Correct the time.")
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
        """Return the distribution conditioned on a position or velocity at a time.

        ``K = cov H^T (H cov H^T + R)^-1``, ``mean + K (z - H mean)``, ``cov - K H cov``. Without a point
        covariance, all motions pass exactly through the point, provided that the demonstrations vary there.

        Parameters
        ----------
        t : time since the start, at most the duration [s].
        y, yd : (k,) position and velocity of the coordinates.
        cov, velocity_cov : (k, k) covariances of the point, or one variance for all coordinates.
        coordinates : indices of the k coordinates; default: all n.
        duration : duration of the motion [s].

        Raises
        ------
        ShapeError : neither position nor velocity, shapes that do not match, a point outside the distribution.
        """
        index = np.arange(self.n) if coordinates is None else _coordinates(coordinates, self.n)
        psi, rate = self.kernels(self._inside(t, duration), duration)
        rows, z, spreads = [], [], []
        for row, value, spread, what in ((psi, y, cov, "y"), (rate, yd, velocity_cov, "yd")):
            if value is None:
                continue
            point = np.atleast_1d(numbers(value, what, ShapeError))
            if point.shape != index.shape or not np.isfinite(point).all():
                raise ShapeError(f"Expected finite {what} of shape ({len(index)},), got {point.tolist()}.")
            rows.append(row)
            z.append(point)
            spreads.append(_covariance(spread, len(index)))
        if not rows:
            raise ShapeError(
                "Expected a position or a velocity to condition on, got neither y nor yd. Pass at least one of them."
            )
        k, R = len(index), np.zeros((len(rows), len(index), len(rows), len(index)))
        for i, spread in enumerate(spreads):
            R[i, :, i] = spread
        return self._conditioned(np.stack(rows), index, np.concatenate(z), R.reshape(len(rows) * k, -1))

    def _conditioned(self, rows: np.ndarray, index: np.ndarray, z: np.ndarray, R: np.ndarray) -> ProMP:
        H = np.concatenate([np.kron(np.eye(self.n)[index], row) for row in rows])
        w, H_cov = self.mean.T.ravel(), H @ self.cov
        off, S = z - H @ w, H_cov @ H.T + R
        values, vectors = np.linalg.eigh(S)
        free = values > SAME * max(float(values[-1]), 1e-300)
        along = vectors.T @ off
        if np.any(np.abs(along[~free]) > UNLIKELY * (1.0 + np.abs(z).max())):
            raise ShapeError(
                "Expected a point within the distribution, got a point offset in a direction in which the "
                "demonstrations do not vary. Pass a covariance of the point, or use more demonstrations."
            )
        gain = H_cov.T @ ((vectors[:, free] / values[free]) @ vectors[:, free].T)
        cov = self.cov - gain @ H_cov - (H_cov.T - gain @ S) @ gain.T  # Joseph form, expanded
        mean = (w + gain @ off).reshape(self.n, -1).T
        return ProMP(mean, 0.5 * (cov + cov.T), self.centres, self.widths, self.duration, self.noise)


def _spread(rows: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return ``sum_ab rows_ta cov_iajb rows_tb`` (N, n, n) for rows (N, m) and cov (n m, n m)."""
    m = rows.shape[1]
    n = len(cov) // m
    pairs = (rows[:, :, None] * rows[:, None, :]).reshape(-1, m * m)
    blocks = cov.reshape(n, m, n, m).transpose(1, 3, 0, 2).reshape(m * m, n * n)
    return (pairs @ blocks).reshape(-1, n, n)


def _coordinates(value: Sequence[int], n: int) -> np.ndarray:
    index = numbers(value, "coordinates", ShapeError)
    if index.ndim != 1 or len({*index.tolist()} & {*range(n)}) != len(index):
        raise ShapeError(f"Expected distinct coordinates from 0 to {n - 1}, got {index.tolist()}.")
    return index.astype(int)


def _covariance(value: ArrayLike, k: int) -> np.ndarray:
    given = numbers(value, "cov", ShapeError)
    if given.shape not in ((), (k, k)) or not np.isfinite(given).all():
        raise ShapeError(f"Expected a covariance as a number or of shape ({k}, {k}), got shape {given.shape}.")
    matrix = np.eye(k) * given if given.ndim == 0 else given
    if np.abs(matrix - matrix.T).max() > 0 or np.linalg.eigvalsh(matrix)[0] < 0.0:
        raise ShapeError(
            "Expected a symmetric, positive semidefinite covariance, got a matrix without these properties. Correct it."
        )
    return matrix


@dataclass(frozen=True, eq=False, repr=False)
class TrajectoryDistribution(Shown):
    """Mean trajectory with its covariance at N times.

    Attributes
    ----------
    t : (N,) times [s].
    y, yd : (N, n) mean position and velocity.
    cov : (N, n, n) position covariance across demonstrations.
    velocity_cov : (N, n, n) velocity covariance.
    """

    t: np.ndarray
    y: np.ndarray
    yd: np.ndarray
    cov: np.ndarray
    velocity_cov: np.ndarray

    def __post_init__(self) -> None:
        make_read_only(self, "t", "y", "yd", "cov", "velocity_cov")

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of the position (N, n)."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2).clip(min=0.0))


def blend(
    primitives: Sequence[ProMP], activation: ArrayLike, t: ArrayLike, *, duration: float | None = None
) -> TrajectoryDistribution:
    """Blend primitives by the normalised product of their distributions, each raised to the power of its activation.

    Time-varying activations blend one motion into the next; constant activations combine all motions.

    ``cov = (sum a_k cov_k^-1)^-1``, ``y = cov sum a_k cov_k^-1 y_k``, for position and velocity jointly.

    Parameters
    ----------
    primitives : K primitives with n coordinates each.
    activation : (N, K) or (K,), non-negative, not all zero at any time.
    t, duration : as in `ProMP.marginal`.

    Raises
    ------
    ShapeError : different numbers of coordinates or activations, negative activations, or all zero at some time.
    """
    for one in members(primitives, "primitives"):
        if not hasattr(one, "marginal"):
            raise ShapeError(f"Expected ProMP primitives, got {type(one).__name__}. Use motion.fit_promp.")
    if len({p.n for p in primitives}) != 1:
        counts = sorted({p.n for p in primitives})
        raise ShapeError(
            f"Expected primitives with equal numbers of coordinates, got {counts}. Fit them to the same arm."
        )
    first = primitives[0]
    times, n = first._times(t, duration), first.n
    given = numbers(activation, "activation", ShapeError)
    if given.shape not in ((len(primitives),), (len(times), len(primitives))):
        raise ShapeError(
            f"Expected activation of shape ({len(times)}, {len(primitives)}) or ({len(primitives)},), got "
            f"{given.shape}."
        )
    a = np.broadcast_to(given, (len(times), len(primitives)))
    if not (np.isfinite(a).all() and a.min() >= 0.0 and (a.sum(axis=1) > 0.0).all()):
        raise ShapeError(
            "Expected finite activations >= 0 that are not all zero at "
            f"any time, got a minimum of {a.min():g} and a smallest sum of "
            f"{a.sum(axis=1).min():g}. Correct them."
        )
    information, vector = np.zeros((len(times), 2 * n, 2 * n)), np.zeros((len(times), 2 * n))
    for k, primitive in enumerate(primitives):
        mean, spread = _joint(primitive, times, duration)
        inverse = np.linalg.pinv(spread, rcond=SAME, hermitian=True) * a[:, k, None, None]
        information += inverse
        vector += np.einsum("tij,tj->ti", inverse, mean)
    cov = np.linalg.pinv(information, rcond=SAME, hermitian=True)
    mean = np.einsum("tij,tj->ti", cov, vector)
    return TrajectoryDistribution(times, mean[:, :n], mean[:, n:], cov[:, :n, :n], cov[:, n:, n:])


def _joint(primitive: ProMP, t: np.ndarray, duration: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (N, 2n) and covariance (N, 2n, 2n) of position and velocity, with a small variance added."""
    rows = np.stack(primitive.kernels(t, duration), axis=1)  # (N, 2, m)
    n, m = primitive.n, len(primitive.centres)
    blocks = primitive.cov.reshape(n, m, n, m)
    spread = np.einsum("tpa,iajb,tqb->tpiqj", rows, blocks, rows, optimize=True).reshape(len(t), 2 * n, 2 * n)
    floor = FLOOR * np.trace(spread, axis1=1, axis2=2)[:, None, None] / (2 * n)
    return (rows @ primitive.mean).reshape(len(t), 2 * n), spread + floor * np.eye(2 * n)


def fit_promp(
    t: ArrayLike | Sequence[ArrayLike], y: ArrayLike | Sequence[ArrayLike], *, n_basis: int = 15
) -> Fit[ProMP]:
    """Fit the mean and covariance of the weights to M demonstrations, separated from measurement noise.

    The covariance is the variation of the weights between demonstrations beyond that due to measurement noise. In the
    mean, each demonstration is weighted by the inverse of the sum of both covariances (docs/theory/promp.md).

    Parameters
    ----------
    t : (N,) increasing times [s] shared by M demonstrations, or a list of M such arrays.
    y : (M, N, n) positions, or a list of M arrays (N_i, n).
    n_basis : number of kernels, equally spaced in time.

    Returns
    -------
    Fit of a `ProMP`. The parameters are the mean weights. The covariance of the weights has at most rank M - 1 and
    determines barely more than M / 4 weights. `residuals` has shape (all samples, n).

    Raises
    ------
    ShapeError : fewer than two demonstrations, wrong shapes, NaN (with the demonstration number).
    NotExcited : samples that do not determine the weights.
    ConfigError : n_basis is not an integer.
    """
    kernel_count(n_basis, 15)
    demos = _read(t, y)
    centres = np.linspace(0.0, 1.0, n_basis)
    widths = np.full(n_basis, WIDTH / (n_basis - 1))
    names, n, of = [f"weight {j}" for j in range(n_basis)], demos[0].y.shape[1], {}
    clocks = [demo.t.tobytes() for demo in demos]
    for clock_, demo in dict(zip(clocks, demos)).items():  # demonstrations often share a clock
        psi, _ = normalised((demo.t / demo.duration)[:, None], centres, widths)
        of[clock_] = (_check_samples(psi, names), psi, np.linalg.pinv(psi))
    excitations, designs, inverses = zip(*(of[one] for one in clocks))
    w = np.array([(inverse @ demo.y).T.ravel() for inverse, demo in zip(inverses, demos)])
    residuals = [demo.y - A @ own.reshape(n, -1).T for A, demo, own in zip(designs, demos, w)]
    dof = sum(len(demo.t) - n_basis for demo in demos)
    noise = np.sqrt(sum((r**2).sum(axis=0) for r in residuals) / max(dof, 1))
    spread = {one: np.kron(np.diag(noise**2), inverse @ inverse.T) for one, (_, _, inverse) in of.items()}
    own = [spread[one] for one in clocks]
    S = np.cov(w.T).reshape(w.shape[1], w.shape[1])
    cov = _positive(S - np.mean(own, axis=0))
    mean, mean_cov = _mean(w, cov, own, S)
    duration = float(np.mean([demo.duration for demo in demos]))
    value = ProMP(mean.reshape(n, -1).T, cov, centres, widths, duration, noise)
    return Fit(
        value=value,
        names=tuple(f"{name} of coordinate {i}" for i in range(n) for name in names),
        units=("unit of y",) * len(mean),
        parameters=mean,
        cov=mean_cov,
        sigma=noise,
        residuals=np.concatenate(residuals),
        n=len(demos),
        excitation=min(excitations, key=lambda one: one.singular_values[-1] / one.singular_values[0]),
        classes=tuple(f"position of coordinate {i} [unit of y]" for i in range(n)),
    )


def _read(t: Any, y: Any) -> list[Demo]:
    if not isinstance(t, Sequence) or not len(t) or np.ndim(t[0]) == 0:
        rows = np.asarray(y, dtype=object) if isinstance(y, Sequence) else y
        if np.ndim(rows) < 1 or len(y) < FEWEST:
            raise ShapeError(
                f"Expected y of shape (M, N, n) with at least {FEWEST} demonstrations, got shape {np.shape(rows)}. "
                "Pass a list if the lengths differ."
            )
        t = [np.asarray(t)] * len(y)
    demos = read_demos(list(t), list(y), None)
    if len(demos) < FEWEST:
        raise ShapeError(
            f"Expected at least {FEWEST} demonstrations, got {len(demos)}. The fit needs the differences between "
            "demonstrations."
        )
    return demos


def _check_samples(design: np.ndarray, names: list[str]) -> Excitation:
    if len(design) < design.shape[1]:
        raise NotExcited(
            f"Expected at least {design.shape[1]} samples per demonstration, got {len(design)}. Use fewer kernels.",
            names[len(design) :],
            ["no sample"] * (design.shape[1] - len(design)),
        )
    return check_excitation(design, names, "distribution over motions", max_condition=MAX_CONDITION)


def _positive(cov: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (cov + cov.T))
    found = (vectors * values.clip(min=0.0)) @ vectors.T
    return 0.5 * (found + found.T)


def _mean(w: np.ndarray, cov: np.ndarray, own: list[np.ndarray], S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean and its covariance; for equal noise, the plain mean and S / M."""
    if all(part is own[0] for part in own):
        return w.mean(axis=0), S / len(w)
    weights = [np.linalg.pinv(cov + part, hermitian=True) for part in own]
    total = np.linalg.pinv(np.sum(weights, axis=0), hermitian=True)
    return total @ sum(W @ one for W, one in zip(weights, w)), 0.5 * (total + total.T)
