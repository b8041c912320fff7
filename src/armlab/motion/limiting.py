"""A movement primitive within limits of velocity and acceleration."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab.motion import _arguments
from armlab.motion.dmp import Dmp
from armlab.motion.rollout import Rollout, RunOptions

__all__ = ["duration_within", "peaks"]

STEPS = 4000  # over a duration, in which peaks are looked for
FINER = 20  # parts of a step around the largest acceleration: that of many kernels is no parabola there
AFTER = 0.5  # of the duration, in which the motion settles


def duration_within(
    dmp: Dmp,
    v_max: ArrayLike = np.inf,
    a_max: ArrayLike = np.inf,
    *,
    y0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    g: ArrayLike | None = None,
    amplitude: ArrayLike | None = None,
) -> float:
    """Return the shortest duration, not below that of the demonstration, for which a motion keeps to limits [s].

    ``k = max(1, max |yd| / v_max, sqrt(max |ydd| / a_max))`` times the duration: the same path, k times as slow.

    Parameters
    ----------
    dmp : that will run with this `duration`. v_max, a_max : a number or (n,), in the unit of y per s and s^2.
    y0, v0, g, amplitude : of the run, as of `Dmp.rollout`; v0 in the duration of the demonstration. A controller begins
        at rest: v0 = 0.

    Raises
    ------
    ShapeError : limits of another shape or not above zero, and as of `Dmp.rollout`.
    """
    limits = [_arguments.joint_limit(limit, what, dmp.n) for limit, what in ((v_max, "v_max"), (a_max, "a_max"))]
    coarse = FINER * np.arange(round((1.0 + AFTER) * STEPS) + 1)
    step = dmp.duration / (STEPS * FINER)
    given: RunOptions = {"y0": y0, "v0": v0, "g": g, "amplitude": amplitude}
    size = np.abs(dmp.rollout(step * coarse, **given).ydd)
    near = coarse[size.argmax(axis=0).clip(1, len(coarse) - 2)] + np.arange(-FINER, FINER + 1)[:, None]
    speed, acceleration = peaks(dmp.rollout(step * np.union1d(coarse, near), **given))
    k = max(1.0, float(np.max(speed / limits[0])), float(np.sqrt(np.max(acceleration / limits[1]))))
    return k * dmp.duration


def peaks(run: Rollout) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest ``|yd|`` and ``|ydd|`` (n,) of a motion, between its samples too.

    Velocity is the cubic between samples with the accelerations as slopes; the peak of the acceleration is that of the
    parabola through the largest sample and its neighbours.

    Parameters
    ----------
    run : with small even steps.
    """
    h, v, a = np.diff(run.t)[:, None], run.yd, run.ydd
    turns = a[:-1] * a[1:] < 0.0
    s = np.where(turns, a[:-1] / np.where(turns, a[:-1] - a[1:], 1.0), 0.0)
    left, right = (1 + 2 * s) * (1 - s) ** 2, s * s * (3 - 2 * s)
    between = left * v[:-1] + right * v[1:] + h * (s * (1 - s) ** 2 * a[:-1] - s * s * (1 - s) * a[1:])
    speed = np.maximum(np.abs(v).max(axis=0), np.abs(np.where(turns, between, 0.0)).max(axis=0))
    size = np.abs(a)
    k = size.argmax(axis=0).clip(1, max(len(a) - 2, 1))
    j = np.arange(a.shape[1])
    if len(a) < 3:
        return speed, size.max(axis=0)
    before, at, after = size[k - 1, j], size[k, j], size[k + 1, j]
    bend = before - 2 * at + after
    top = at - np.where(bend < 0.0, (after - before) ** 2 / (8 * np.where(bend < 0.0, bend, 1.0)), 0.0)
    inside = (at >= before) & (at >= after)
    return speed, np.where(inside, np.maximum(top, at), size.max(axis=0))
