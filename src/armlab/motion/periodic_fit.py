"""From a demonstration of rhythmic motion to a movement primitive."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number
from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation import Excitation, Fit
from armlab.motion._demos import read_demos
from armlab.motion._harmonics import GRID, transfer
from armlab.motion._least_squares import block_covariance, solve
from armlab.motion._setting import vector
from armlab.motion.periodic_dmp import PeriodicDmp

__all__ = ["fit_periodic_dmp"]

MAX_CONDITION = 1e11
SEEN = 1e4  # condition beyond which the motion where there are no samples is a guess
NEXT = 2.0  # distances of kernels between samples that tell every kernel
QUIET = 1e-18  # of the largest: harmonics that are left out


def fit_periodic_dmp(
    t: ArrayLike,
    y: ArrayLike,
    *,
    period: float,
    n_basis: int = 25,
    h: float | None = None,
    g: ArrayLike | None = None,
    alpha_z: float = 25.0,
    ridge: float = 0.0,
) -> Fit[PeriodicDmp]:
    """Fit a rhythmic movement primitive: the weights whose own steady motion is nearest to the demonstration.

    The steady motion is linear in the weights: kernel j alone makes ``sum_k F_jk exp(i k phi) / (alpha_z beta_z - k^2 +
    i alpha_z k)``, with F_jk the Fourier coefficients of the kernel. Nothing that was measured is differentiated.

    Parameters
    ----------
    t : (N,) increasing times [s], of a period or of any number of them; the phase is 0 at the first.
    y : (N, n) positions [rad or m].
    period : [s]; a hundredth off it spoils ten periods, so try others and take the one with the least `sigma`.
    n_basis : kernels, 3 to 1000. h : their concentration; ``(n_basis / (2 pi))^2`` when left out.
    g : (n,) baseline; the mean of the samples when left out: the kernels can make any other.
    alpha_z : constant of the spring, critically damped. ridge : penalty of the squared weights.

    Returns
    -------
    Fit of a `PeriodicDmp`. `residuals` (N, n).

    Raises
    ------
    ShapeError : shapes, NaN and times that do not increase, with their rows; no positive period; several
        demonstrations. ConfigError : options out of range.
    NotExcited : samples that leave part of the period out, and no ridge; with that part.
    """
    if not isinstance(n_basis, int | np.integer) or isinstance(n_basis, bool) or not 3 <= n_basis <= 1000:
        raise ConfigError(f"Expected a whole number of kernels from 3 to 1000, got {n_basis!r}. 25 is usual.")
    demos = read_demos(t, y, None)
    if len(demos) > 1:
        raise ShapeError(
            f"Expected one demonstration, got {len(demos)}: their phases would begin apart. Fit one, with many periods."
        )
    demo = demos[0]
    seconds, penalty = number(period, "period [s]"), number(ridge, "ridge", ConfigError)
    if not 0.0 < seconds < np.inf:
        raise ShapeError(f"Expected a period above zero, got {seconds:g} s. Measure it from peak to peak.")
    if not 0.0 <= penalty < np.inf:
        raise ConfigError(f"Expected a finite ridge of at least zero, got {penalty:g}.")
    n = demo.y.shape[1]
    blank = PeriodicDmp(
        weights=np.zeros((n_basis, n)),
        centres=2 * np.pi / n_basis * np.arange(n_basis),
        h=(n_basis / (2 * np.pi)) ** 2 if h is None else h,
        period=seconds,
        g=demo.y.mean(axis=0) if g is None else vector(g, "g", n),
        alpha_z=alpha_z,
        beta_z=number(alpha_z, "alpha_z") / 4.0,
    )
    A = _responses(blank, 2 * np.pi / seconds * demo.t)
    off = demo.y - blank.g
    found = solve(A, off, np.full(n_basis, penalty) if penalty else None)
    if not penalty:
        _check_seen(2 * np.pi / seconds * demo.t, found.triangle)
    return _fit(blank, A, off, found, penalty)


def _check_seen(phi: np.ndarray, triangle: np.ndarray) -> None:
    """Refuse samples that leave out a part of the period in which the weights are not told."""
    m = len(triangle)
    turns = np.sort(phi / (2 * np.pi) % 1.0)
    ends = np.append(turns[1:], turns[0] + 1.0)
    i = int(np.argmax(ends - turns))
    if ends[i] - turns[i] <= NEXT / m:
        return
    excitation = Excitation.of(triangle, [f"weight {j}" for j in range(m)], SEEN)
    if excitation.rank < m:
        missing = f"from {turns[i]:.2g} to {ends[i] % 1.0 or 1.0:.2g} of it"
        raise NotExcited(
            f"Expected samples from the whole period, got none {missing}, which leaves {m - excitation.rank} of {m} "
            "weights untold. Record a whole period, take fewer kernels, or give a ridge.",
            [excitation.weakest],
            [f"no sample {missing}"],
        )


def _responses(blank: PeriodicDmp, phi: np.ndarray) -> np.ndarray:
    """Return the steady motion (N, n_basis) that each kernel alone makes."""
    grid = 2 * np.pi / GRID * np.arange(GRID)
    spectrum = np.fft.rfft(blank.primitive_from().basis(grid), axis=0) / GRID
    spectrum *= transfer(blank.alpha_z, blank.alpha_z * blank.beta_z)[:, None]
    size = np.abs(spectrum).max(axis=1)
    last = int(np.flatnonzero(size > QUIET * size.max())[-1])
    spectrum[1 : GRID // 2] *= 2.0
    turns = np.ones((last + 1, len(phi)), dtype=complex)
    turns[1:] = np.exp(1j * phi)
    np.cumprod(turns, axis=0, out=turns)  # a tenth of the time of as many sines
    return (turns.T @ spectrum[: last + 1]).real


def _fit(blank: PeriodicDmp, A: np.ndarray, off: np.ndarray, found: Any, ridge: float) -> Fit[PeriodicDmp]:
    m, n = blank.weights.shape
    residuals = off - A @ found.x
    sigma = np.sqrt((residuals**2).sum(axis=0) / max(len(off) - m, 1))
    unit = np.broadcast_to(found.G - ridge * found.G @ found.G, (n, m, m))
    names = [f"weight {j}" for j in range(m)]
    return Fit(
        value=replace(blank, weights=found.x),
        names=tuple(name if n == 1 else f"{name} of coordinate {i}" for i in range(n) for name in names),
        units=("unit of y",) * (m * n),
        parameters=found.x.T.ravel(),
        cov=lambda: block_covariance(unit, sigma),
        sigma=sigma,
        residuals=residuals,
        n=len(off),
        excitation=lambda: Excitation.of(found.triangle, names, MAX_CONDITION),
        classes=tuple(f"position of coordinate {i} [unit of y]" for i in range(n)),
    )
