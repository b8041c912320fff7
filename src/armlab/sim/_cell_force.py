"""Experiments of force sensors and accelerometers of known truth, drawn in the order in which they are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab.sim._cell_hand_eye import rotations, tilted

GRAVITY = np.array([0.0, 0.0, -9.82])
STANDARD = np.array([0.0, 0.0, -9.80665])
CONTACT = 20.0  # N


@dataclass(frozen=True, eq=False)
class Weighed:
    """Orientations of a tool and readings of what hangs on it, and the truth behind them.

    `bias` is -R^T o of the specification, then that of the torque; `weight` the true one in base axes; `exact` the
    readings without noise and contact; `touched` the samples with contact.
    """

    RA: np.ndarray
    y: np.ndarray
    R: np.ndarray
    bias: np.ndarray
    centre: np.ndarray
    weight: np.ndarray
    exact: np.ndarray
    touched: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments of `calibrate.fit_force_sensor`."""
        return {"T_base_tool": self.RA, "wrench": self.y, "gravity": GRAVITY}


def weighed(
    seed: Any,
    N: int = 100,
    sigma: float = 0.1,
    tilt: float | None = None,
    torque: float | None = None,
    unknown: bool = False,
    bias: bool = True,
    contacts: int = 0,
) -> Weighed:
    """Return experiment F1; F2 with tilt [rad]; F3 with contacts in the first samples; F4 with torques; F5 unknown.

    Parameters
    ----------
    seed : of the generator. N : samples. sigma : noise of forces [N]. tilt : largest angle from one orientation [rad].
    torque : noise of torques [N m]. unknown : the weight points anywhere. bias : readings without weight are not zero.
    contacts : how many of the first samples have contact.
    """
    rng = np.random.default_rng(seed)
    R = rotations(rng, 1)[0]
    weight = GRAVITY
    if unknown:
        weight = rng.standard_normal(3)
        weight = 9.82 * weight / np.linalg.norm(weight)
    o = rng.standard_normal(3) if bias else np.zeros(3)
    RA = rotations(rng, N)
    if tilt is not None:
        RA = tilted(rng, N, tilt)
    r, o_tau = 0.1 * rng.standard_normal((2, 3)) if torque is not None else (np.full(3, np.nan), np.zeros(0))
    u = weight @ RA @ R
    exact = u - o @ R
    y = exact + sigma * rng.standard_normal((N, 3))
    there = np.arange(N) < contacts
    if contacts:
        y = touched(rng, y, there)
    if torque is not None:
        exact = np.hstack([exact, np.cross(r, u) - o_tau])
        y = np.hstack([y, exact[:, 3:] + torque * rng.standard_normal((N, 3))])
    return Weighed(RA, y, R, np.concatenate([-o @ R, -o_tau]), r, weight, exact, there)


def touched(rng: np.random.Generator, y: np.ndarray, rows: Any) -> np.ndarray:
    """Return readings with contacts of 20 N in some rows (F3)."""
    y = y.copy()
    y[rows, :3] += CONTACT * rotations(rng, len(y))[rows, 0]
    return y


def accelerated(seed: Any, N: int = 50, sigma: float = 0.02) -> Weighed:
    """Return experiment F6: an accelerometer at rest."""
    rng = np.random.default_rng(seed)
    R = rotations(rng, 1)[0]
    bias = 0.2 * rng.standard_normal(3)
    RA = rotations(rng, N)
    exact = -STANDARD @ RA @ R + bias
    y = exact + sigma * rng.standard_normal((N, 3))
    return Weighed(RA, y, R, bias, np.full(3, np.nan), -STANDARD, exact, np.zeros(N, dtype=bool))
