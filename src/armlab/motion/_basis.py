"""Where the kernels of a movement primitive are, and how wide."""

from __future__ import annotations

import numpy as np

from armlab._numbers import check_name
from armlab.errors import ConfigError

__all__ = ["normalised", "CONVENTIONS", "SCHEDULES", "SPACINGS", "placed", "time_constants"]

CONVENTIONS = ("lund", "ijspeert")
SCHEDULES = ("canonical", "time", "position")
SPACINGS = ("time", "phase")
FEWEST, MOST = 3, 1000


def time_constants(convention: str, duration: float, alpha_z: float) -> tuple[float, float]:
    """Return alpha_x and tau_d [s] of a convention for a motion of `duration` [s].

    Raises
    ------
    UnknownName : another convention.
    """
    check_name(convention, "convention", CONVENTIONS)
    return (1.0, duration / 3.0) if convention == "lund" else (alpha_z / 3.0, duration)


def placed(schedule: str, spacing: str, n_basis: int, decay: float, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return centres and widths (n_basis,) of kernels in the phase.

    Parameters
    ----------
    schedule : of the phase. spacing : "time": equally spaced in time; "phase": in the phase, as in
        DynamicMovementPrimitives.jl. decay : ``alpha_x duration / tau_d``, so that x ends at exp(-decay).
    factor : standard deviations over distances, of spacing "time".

    Raises
    ------
    UnknownName : another schedule or spacing. ConfigError : a number of kernels outside 3 to 1000.
    """
    check_name(schedule, "schedule", SCHEDULES)
    check_name(spacing, "spacing", SPACINGS)
    whole = isinstance(n_basis, int | np.integer) and not isinstance(n_basis, bool)
    if not whole or not FEWEST <= n_basis <= MOST:
        raise ConfigError(f"Expected a whole number of kernels from {FEWEST} to {MOST}, got {n_basis!r}. 50 is usual.")
    u = np.linspace(0.0, 1.0, n_basis)
    if schedule != "canonical":
        return u, np.full(n_basis, factor / (n_basis - 1))
    last = np.exp(-decay)
    if spacing == "phase":
        return np.linspace(last, 1.0, n_basis), np.full(n_basis, np.sqrt(1.0 - last) * 0.5 / n_basis)
    centres = np.exp(-decay * u)
    gaps = np.abs(np.diff(centres))
    return centres, factor * np.append(gaps, gaps[-1])


def normalised(u: np.ndarray, centres: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Gaussian kernels over their sum, as a soft-max, and their derivatives with u; u (..., 1)."""
    exponents = -0.5 * ((u - centres) / widths) ** 2
    psi = np.exp(exponents - exponents.max(axis=-1, keepdims=True))
    psi /= psi.sum(axis=-1, keepdims=True)
    slope = -(u - centres) / widths**2
    return psi, psi * (slope - (psi * slope).sum(axis=-1, keepdims=True))
