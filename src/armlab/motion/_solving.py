"""The adaptive reference solution of a movement primitive."""

from __future__ import annotations

import numpy as np

from armlab._numbers import number
from armlab.errors import ConfigError, NotConverged, ShapeError
from armlab.motion._setting import Setting
from armlab.motion.rollout import Rollout

__all__ = ["progress", "solved"]


LONGEST = 1e4  # time constants: each takes the solver a step or two


def solved(run: Setting, t: np.ndarray, rtol: float, atol: float) -> Rollout:
    """Solve a run by the method of Dormand and Prince of order 8.

    Parameters
    ----------
    run : what runs. t : (N,) increasing times [s]. rtol, atol : tolerances.

    Raises
    ------
    ConfigError : tolerances that are not positive. ShapeError : times that do not increase.
    NotConverged : the solver gave up.
    """
    from scipy.integrate import solve_ivp

    if not (0 < number(rtol, "rtol", ConfigError) < 1 and 0 < number(atol, "atol", ConfigError) < np.inf):
        raise ConfigError(f"Expected tolerances above zero, got rtol {rtol:g} and atol {atol:g}. 1e-10 is fine.")
    if t.ndim != 1 or not len(t) or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise ShapeError(f"Expected increasing times (N,), got shape {t.shape}. Drop repeated samples.")
    dmp = run.dmp
    if not t[-1] - t[0] <= LONGEST * run.tau:
        raise ShapeError(f"Expected times within {LONGEST:g} time constants, got more. Ask for a shorter motion.")
    n, s = dmp.n, (t - t[0]) / run.tau
    alpha, stiffness, pace = dmp.alpha_z, dmp.alpha_z * dmp.beta_z, dmp.tau_d / dmp.duration

    def phase(s: np.ndarray, y: np.ndarray) -> np.ndarray:
        return progress(y, run.y0, run.g) if dmp.schedule == "position" else dmp.phase(s * dmp.tau_d)

    def slope(s: np.ndarray, state: np.ndarray) -> np.ndarray:
        y, z = state[:n], state[n:]
        f = run.scale * run.primitive.forcing(phase(s, y))
        return np.concatenate([z, stiffness * (run.g - y) - alpha * z + f])

    # The forcing is not smooth where the gate of time begins and ends.
    breaks = [b / pace for b in (1.0, 1.1) if dmp.schedule == "time" and b / pace < s[-1]]
    state, rows = np.concatenate([run.y0, run.tau * run.v0]), []
    for begin, end in zip([0.0, *breaks], [*breaks, s[-1]]):
        last = end == s[-1]
        inside = s[(s >= begin) & ((s < end) | last)]
        if begin == end:  # a single time
            rows.append(state[None])
            continue
        at = inside if last else np.append(inside, end)
        found = solve_ivp(slope, (begin, end), state, "DOP853", at, rtol=rtol, atol=atol, max_step=(end - begin) / 20)
        if not found.success:
            raise NotConverged(f"Expected a solution, got none: {found.message} Loosen the tolerances.")
        rows.append(found.y.T[: len(inside)])
        state = found.y[:, -1]
    y, z = np.split(np.concatenate(rows), 2, axis=1)
    x = phase(s, y)
    f = run.scale * run.primitive.forcing(x)
    return Rollout(t, y, z / run.tau, (stiffness * (run.g - y) - alpha * z + f) / run.tau**2, x, f)


def progress(y: np.ndarray, y0: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the phase of schedule "position": ``(g - y) / (g - y0)``, clipped to [0, 1]; 0 without displacement.

    Parameters
    ----------
    y, y0, g : (..., n).
    """
    way = g - y0
    return np.where(way == 0, 0.0, np.clip((g - y) / np.where(way == 0, 1.0, way), 0.0, 1.0))
