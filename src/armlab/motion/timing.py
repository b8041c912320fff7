"""Movement primitives within velocity and acceleration limits, by uniform or local slow-down."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only, positive
from armlab.errors import ConfigError, ShapeError
from armlab.estimation.fit import Fit, value_of
from armlab.motion import arguments
from armlab.motion.arguments import clock
from armlab.motion.control import Arms, JointLimits
from armlab.motion.dmp import Dmp, DmpController
from armlab.motion.primitive.run import Rollout, RunOptions

PEAK_STEPS = 4000  # samples over a duration in the search for peaks
FINER = 20  # subdivisions of a step near the peak acceleration; with many kernels, the peak is too sharp for a parabola
AFTER = 0.5  # settling time, as a fraction of the duration

KNOTS = 2000  # knots of the clock rate over a duration
MARGIN = 1e-6  # margin for the errors of parabolic interpolation between samples
PARTS = 4  # points per interval between knots at which limits are checked

BISECTIONS = 45  # iterations that determine the largest squared rate at a knot to a relative error of 3e-14


def shortest_duration(
    dmp: Dmp | Fit[Dmp],
    v_max: ArrayLike = np.inf,
    a_max: ArrayLike = np.inf,
    *,
    y0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    g: ArrayLike | None = None,
    amplitude: ArrayLike | None = None,
) -> float:
    """Return the shortest duration within the limits [s], but at least the duration of the demonstration.

    The path stays the same; its duration is scaled by ``k = max(1, max |yd| / v_max, sqrt(max |ydd| / a_max))``.

    Parameters
    ----------
    dmp : the primitive to run with the returned duration.
    v_max, a_max : a number or (n,), in the unit of y per s and s^2.
    y0, v0, g, amplitude : as in `Dmp.rollout`, with v0 on the time scale of the demonstration. A controller starts at
        rest: v0 = 0.

    Raises
    ------
    ShapeError : limits of the wrong shape, or non-positive limits; otherwise as in `Dmp.rollout`.
    """
    dmp = value_of(dmp)
    limits = [arguments.joint_limit(limit, what, dmp.n) for limit, what in ((v_max, "v_max"), (a_max, "a_max"))]
    coarse = FINER * np.arange(round((1.0 + AFTER) * PEAK_STEPS) + 1)
    step = dmp.duration / (PEAK_STEPS * FINER)
    given: RunOptions = {"y0": y0, "v0": v0, "g": g, "amplitude": amplitude}
    size = np.abs(dmp.rollout(step * coarse, **given).ydd)
    near = coarse[size.argmax(axis=0).clip(1, len(coarse) - 2)] + np.arange(-FINER, FINER + 1)[:, None]
    speed, acceleration = peaks(dmp.rollout(step * np.union1d(coarse, near), **given))
    k = max(1.0, float(np.max(speed / limits[0])), float(np.sqrt(np.max(acceleration / limits[1]))))
    return k * dmp.duration


def peaks(run: Rollout) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest ``|yd|`` and ``|ydd|`` (n,) of a motion, including between its samples.

    Between samples, the velocity is interpolated by a cubic that matches the sampled accelerations. The peak
    acceleration comes from the parabola through the largest sample and its neighbours.
    """
    h, v, a = np.diff(run.t)[:, None], run.yd, run.ydd
    turns = a[:-1] * a[1:] < 0.0
    s = np.where(turns, a[:-1] / np.where(turns, a[:-1] - a[1:], 1.0), 0.0)
    left, right = (1 + 2 * s) * (1 - s) ** 2, s * s * (3 - 2 * s)
    between = left * v[:-1] + right * v[1:] + h * (s * (1 - s) ** 2 * a[:-1] - s * s * (1 - s) * a[1:])
    speed = np.maximum(np.abs(v).max(axis=0), np.abs(np.where(turns, between, 0.0)).max(axis=0))
    size = np.abs(a)
    k = size.argmax(axis=0).clip(1, len(a) - 2)
    j = np.arange(a.shape[1])
    before, at, after = size[k - 1, j], size[k, j], size[k + 1, j]
    bend = before - 2 * at + after
    top = at - np.where(bend < 0.0, (after - before) ** 2 / (8 * np.where(bend < 0.0, bend, 1.0)), 0.0)
    inside = (at >= before) & (at >= after)
    return speed, np.where(inside, np.maximum(top, at), size.max(axis=0))


def retimed(
    dmp: Dmp | Fit[Dmp],
    v_max: ArrayLike = np.inf,
    a_max: ArrayLike = np.inf,
    *,
    y0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    g: ArrayLike | None = None,
    amplitude: ArrayLike | None = None,
) -> PacedDmp:
    """Return the motion on the same path, slowed down only where a limit requires it.

    The path has the time-optimal parameterisation with a clock rate of at most 1 (the rate of the demonstration). The
    motion never takes longer than with uniform slow-down to `shortest_duration`. The acceleration is discontinuous, so
    the jerk is unbounded.

    Parameters
    ----------
    dmp, v_max, a_max, y0, v0, g, amplitude : as in `shortest_duration`.

    Raises
    ------
    ShapeError : as in `shortest_duration`.
    """
    dmp = value_of(dmp)
    v, a = (arguments.joint_limit(limit, what, dmp.n) for limit, what in ((v_max, "v_max"), (a_max, "a_max")))
    given: RunOptions = {"y0": y0, "v0": v0, "g": g, "amplitude": amplitude}
    uniform = dmp.duration / shortest_duration(dmp, v, a, y0=y0, v0=v0, g=g, amplitude=amplitude)
    M = round((1.0 + AFTER) * KNOTS)
    s = np.linspace(0.0, (1.0 + AFTER) * dmp.duration, M * PARTS + 1)
    knots, h = s[::PARTS], s[PARTS]
    path = dmp.rollout(s, **given)
    z = fastest(h, path.yd[::PARTS], path.ydd[::PARTS], v, a)
    place = PARTS * np.arange(M)[:, None] + np.arange(PARTS + 1)
    share = np.arange(PARTS + 1)[:, None] / PARTS
    squares = z[:-1, None, None] * (1.0 - share) + z[1:, None, None] * share
    slope = path.yd[place]
    speed = largest_size(slope * np.sqrt(squares))
    acceleration = largest_size(path.ydd[place] * squares + slope * (np.diff(z) / (2 * h))[:, None, None])
    over = max(1.0, (1.0 + MARGIN) * float(np.max(np.maximum(speed / v, np.sqrt(acceleration / a)))))
    paced = PacedDmp(dmp, knots, np.sqrt(z) / over, given)
    if paced.duration > dmp.duration / uniform:
        return PacedDmp(dmp, knots, np.full(M + 1, uniform), given)
    return paced


@dataclass(frozen=True, eq=False, repr=False)
class PacedDmp(Shown):
    """Primitive with a variable clock rate; created by `retimed`.

    Attributes
    ----------
    dmp : the primitive.
    s : (M + 1,) times on the primitive's clock [s].
    rate : (M + 1,) clock rate s' at these times; constant after the last time.
    run : start, start velocity, goal and amplitude.
    t : (M + 1,) run times at which the clock reaches s [s].
    change : (M + 1,) derivative of the rate after each of these times [1/s].
    """

    dmp: Dmp
    s: np.ndarray
    rate: np.ndarray
    run: RunOptions
    t: np.ndarray = field(init=False)
    change: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Freeze the fields and compute the knot times."""
        steps = 2 * np.diff(self.s) / (self.rate[1:] + self.rate[:-1])
        object.__setattr__(self, "t", np.append(0.0, np.cumsum(steps)))
        object.__setattr__(self, "change", np.append(np.diff(self.rate) / steps, 0.0))
        make_read_only(self, "s", "rate", "t", "change")

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.dmp.n

    @property
    def duration(self) -> float:
        """Time at which the primitive's clock reaches its duration [s]."""
        return float(np.interp(self.dmp.duration, self.s, self.t))

    def _clock(self, t: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the time on the primitive's clock, the clock rate and the derivative of the rate, each (...)."""
        times = np.asarray(t, dtype=float)
        i = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, None)
        since, change = times - self.t[i], self.change[i]
        return self.s[i] + since * (self.rate[i] + 0.5 * since * change), self.rate[i] + since * change, change

    def rollout(self, t: ArrayLike) -> Rollout:
        """Return the motion at times t, with the phase and forcing of the corresponding path points.

        Parameters
        ----------
        t : (N,) increasing times [s], relative to the first; or a time step [s] for a run to the end of the motion.

        Raises
        ------
        ShapeError : non-increasing or non-finite times, or a non-positive step.
        """
        times = clock(t, self.duration)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or not (np.diff(times) > 0.0).all():
            raise ShapeError(f"Expected finite, increasing times (N,), got shape {times.shape}. Drop repeated samples.")
        s, rate, change = self._clock(times - times[0])
        path = self.dmp.rollout(np.union1d(s, self.s[self.s < s[-1]]), **self.run)
        at = np.searchsorted(path.t, s)
        r, u = rate[:, None], change[:, None]
        y, yd, ydd = path.y[at], path.yd[at] * r, path.ydd[at] * r**2 + path.yd[at] * u
        return Rollout(times, y, yd, ydd, path.x[at], path.forcing[at])

    def stepper(self, **run: Unpack[RunOptions]) -> PacedStepper:
        """Return a stepper that runs the motion sample by sample.

        Parameters
        ----------
        **run : `RunOptions` that override the plan, except the duration; the planned clock rate is kept.

        Raises
        ------
        ShapeError, ConfigError : as in `Dmp.stepper`.
        """
        if run.keys() & {"duration", "tau_d"}:
            raise ConfigError(
                "Expected no duration for a retimed motion, got a duration. Pass a slower motion to `retimed`."
            )
        return PacedStepper(self, {**self.run, **run})

    def controller(self, robot: Arms, *, limits: JointLimits | Sequence[JointLimits] | None = None) -> DmpController:
        """Return a controller ``State -> Command`` that runs at this clock rate, from rest at the measured position.

        The motion stays within the limits if the arm begins at the planned start. With a different start or goal, the
        path differs, but the clock rate stays the same. The references are clipped to the limits of the controller
        (`Controller.clamped`).

        Parameters
        ----------
        robot, limits : as in `Dmp.controller`.

        Raises
        ------
        ShapeError : as in `Dmp.controller`.
        """
        return DmpController(robot, self, {}, limits)


class PacedStepper:
    """Sample-by-sample run of a `PacedDmp`; created by `PacedDmp.stepper`."""

    def __init__(self, paced: PacedDmp, run: RunOptions) -> None:
        self._paced, self._inner = paced, paced.dmp.stepper(**run)
        self.reset()

    def reset(self) -> None:
        """Return to the start."""
        self._knots = self._paced.t.tolist()
        self._inner.reset()
        self._t = self._s = 0.0
        self._rate, self._change = float(self._paced.rate[0]), float(self._paced.change[0])

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one sample and return y, yd, ydd, each (n,)."""
        self._t += positive(dt, "dt [s]", "At 250 Hz, dt is 0.004 s.")
        paced, i, before = self._paced, bisect_right(self._knots, self._t) - 1, self._s
        since, start = self._t - self._knots[i], float(paced.rate[i])
        self._change = float(paced.change[i])
        self._rate = start + since * self._change
        self._s = float(paced.s[i]) + 0.5 * since * (start + self._rate)
        self._inner.step(self._s - before)
        return self.state

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Current position, velocity and acceleration, each (n,)."""
        y, slope, bend = self._inner.state
        return y, self._rate * slope, self._rate**2 * bend + self._change * slope

    @property
    def t(self) -> float:
        """Time since the start [s]."""
        return self._t

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return self._paced.duration

    @property
    def goal(self) -> np.ndarray:
        """Current goal (n,)."""
        return self._inner.goal

    def change_goal(self, g: ArrayLike) -> None:
        """Change the goal without changing the clock rate; compliance with the planned limits is no longer
        guaranteed."""
        self._inner.change_goal(g)


def fastest(h: float, slope: np.ndarray, bend: np.ndarray, v_max: np.ndarray, a_max: np.ndarray) -> np.ndarray:
    """Return the squared clock rate ``z = s'^2 <= 1`` (M + 1,) of the fastest motion along y(s) at knots of spacing h.

    The velocity is ``y_s sqrt(z)`` and the acceleration ``y_ss z + y_s z_s / 2``, with first and second derivatives y_s
    and y_ss (M + 1, n). With z linear between knots, both limits are linear inequalities in neighbouring values. A
    backward pass finds the largest z from which the end can be reached, and a forward pass finds the largest reachable
    z. Pham and Pham, A new approach to time-optimal path parameterization based on reachability analysis, IEEE
    Transactions on Robotics 34(3), 2018.
    """
    with np.errstate(divide="ignore"):
        cap = np.minimum(1.0, np.min((v_max / np.abs(slope)) ** 2, axis=1))
    # a z + b z_next <= 1 at both ends of every interval, in both directions: (M, 4 n)
    turn, bent = slope / (2 * h * a_max), bend / a_max
    before = np.concatenate([bent[:-1] - turn[:-1], -turn[1:]], axis=1)
    after = np.concatenate([turn[:-1], bent[1:] + turn[1:]], axis=1)
    a, b = np.concatenate([before, -before], axis=1), np.concatenate([after, -after], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        rises, falls = b > 0.0, (b < 0.0) & (a > 0.0)
        over_b, over_a = np.where(b != 0.0, 1.0 / b, 0.0), np.where(falls, 1.0 / a, np.inf)
        up, up_slope = np.where(rises, over_b, np.inf), np.where(rises, -a * over_b, 0.0)
        down, down_slope = over_a, np.where(falls, -b / a, 0.0)
    most = np.minimum(cap[:-1], _alone(a, b, cap))
    reachable = cap.copy()
    for i in range(len(most) - 1, -1, -1):
        reachable[i] = min(most[i], (down[i] + down_slope[i] * reachable[i + 1]).min())
    z = reachable
    for i in range(len(most)):
        z[i + 1] = min(z[i + 1], (up[i] + up_slope[i] * z[i]).min())
    return z


def _alone(a: np.ndarray, b: np.ndarray, cap: np.ndarray) -> np.ndarray:
    """Return the largest z (M,) for which a feasible next z exists, given only the inequalities of that interval."""
    with np.errstate(divide="ignore", invalid="ignore"):
        over = np.where(b != 0.0, 1.0 / b, 0.0)
    flat, rises, falls = b == 0.0, b > 0.0, b < 0.0
    low, high = np.zeros(len(a)), cap[:-1].copy()
    for _ in range(BISECTIONS):
        z = 0.5 * (low + high)
        left = 1.0 - a * z[:, None]
        bound = left * over
        least = np.max(np.where(falls, bound, 0.0), axis=1)
        largest = np.minimum(cap[1:], np.min(np.where(rises, bound, np.inf), axis=1))
        fits = (least <= largest) & (np.where(flat, left, 0.0).min(axis=1) >= 0.0)
        low, high = np.where(fits, z, low), np.where(fits, high, z)
    return np.where(high == cap[:-1], high, low)


def largest_size(values: np.ndarray) -> np.ndarray:
    """Return the largest magnitude (n,) of smooth segments (M, P, n), P >= 3, by parabolic interpolation of samples."""
    size = np.abs(values)
    before, at, after = size[:, :-2], size[:, 1:-1], size[:, 2:]
    bend = before - 2 * at + after
    inside = (at >= before) & (at >= after) & (bend < 0.0)
    rise = np.where(inside, -((after - before) ** 2) / (8 * np.where(inside, bend, 1.0)), 0.0)
    return np.maximum(size.max(axis=(0, 1)), (at + rise).max(axis=(0, 1)))
