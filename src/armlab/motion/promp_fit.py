"""From several demonstrations to a distribution over motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation import Excitation, Fit, check_excitation
from armlab.motion._basis import normalised
from armlab.motion._demos import Demo, read_demos
from armlab.motion.promp import ProMP

__all__ = ["fit_promp"]

FEWEST = 2  # demonstrations
WIDTH = 0.8  # standard deviation of kernels over their distance
MAX_CONDITION = 1e6


def fit_promp(
    t: ArrayLike | Sequence[ArrayLike], y: ArrayLike | Sequence[ArrayLike], *, n_basis: int = 15
) -> Fit[ProMP]:
    """Fit mean and covariance of the weights of M demonstrations, apart from the noise of the samples.

    Each demonstration is fitted by least squares, ``w_i`` with covariance ``sigma^2 G_i``; sigma comes from all of
    their residuals. The covariance over demonstrations is what they differ by beyond that,
    ``cov = S - mean sigma^2 G_i`` with the sample covariance S, without its negative part. The mean weighs each by
    ``(cov + sigma^2 G_i)^-1``.

    Parameters
    ----------
    t : (N,) increasing times [s] that M demonstrations share, or a list of M of them.
    y : (M, N, n) positions, or a list of M arrays (N_i, n).
    n_basis : kernels, equally spaced in time.

    Returns
    -------
    Fit of a `ProMP`. The parameters are the mean weights; their covariance has at most the rank M - 1, and says little
    of more than M / 4 weights. `residuals` (all samples, n).

    Raises
    ------
    ShapeError : fewer than two demonstrations, shapes, NaN with the number of the demonstration.
    NotExcited : samples that do not tell the weights. ConfigError : no whole number of kernels.
    """
    if not isinstance(n_basis, int | np.integer) or isinstance(n_basis, bool) or not 3 <= n_basis <= 1000:
        raise ConfigError(f"Expected a whole number of kernels from 3 to 1000, got {n_basis!r}. 15 is usual.")
    demos = _read(t, y)
    centres = np.linspace(0.0, 1.0, n_basis)
    widths = np.full(n_basis, WIDTH / (n_basis - 1))
    names, n, of = [f"weight {j}" for j in range(n_basis)], demos[0].y.shape[1], {}
    for demo in demos:
        if demo.t.tobytes() not in of:  # most share their times
            psi, _ = normalised((demo.t / demo.duration)[:, None], centres, widths)
            of[demo.t.tobytes()] = (_told(psi, names), psi, np.linalg.pinv(psi))
    excitations, designs, inverses = zip(*(of[demo.t.tobytes()] for demo in demos))
    products = {id(inverse): inverse @ inverse.T for inverse in inverses}
    G = [products[id(inverse)] for inverse in inverses]
    w = np.array([(inverse @ demo.y).T.ravel() for inverse, demo in zip(inverses, demos)])
    residuals = [demo.y - A @ own.reshape(n, -1).T for A, demo, own in zip(designs, demos, w)]
    dof = sum(len(demo.t) - n_basis for demo in demos)
    noise = np.sqrt(sum((r**2).sum(axis=0) for r in residuals) / max(dof, 1))
    spread = {id(g): np.kron(np.diag(noise**2), g) for g in G}
    own = [spread[id(g)] for g in G]
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
            raise ShapeError(f"Expected y of shape (M, N, n) of {FEWEST} demonstrations or more, got others.")
        t = [np.asarray(t)] * len(y)
    demos = read_demos(list(t), list(y), None)
    if len(demos) < FEWEST:
        raise ShapeError(
            f"Expected {FEWEST} demonstrations or more, got {len(demos)}. Their differences are what is fitted."
        )
    return demos


def _told(design: np.ndarray, names: list[str]) -> Excitation:
    if len(design) < design.shape[1]:
        raise NotExcited(
            f"Expected at least {design.shape[1]} samples per demonstration, got {len(design)}. Take fewer kernels.",
            names[len(design) :],
            ["no sample"] * (design.shape[1] - len(design)),
        )
    return check_excitation(design, names, "distribution over motions", max_condition=MAX_CONDITION)


def _positive(cov: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (cov + cov.T))
    found = (vectors * values.clip(min=0.0)) @ vectors.T
    return 0.5 * (found + found.T)


def _mean(w: np.ndarray, cov: np.ndarray, own: list[np.ndarray], S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean and its covariance; where the demonstrations are alike, the plain one and S / M."""
    if all(part is own[0] for part in own):
        return w.mean(axis=0), S / len(w)
    weights = [np.linalg.pinv(cov + part, hermitian=True) for part in own]
    total = np.linalg.pinv(np.sum(weights, axis=0), hermitian=True)
    return total @ sum(W @ one for W, one in zip(weights, w)), 0.5 * (total + total.T)
