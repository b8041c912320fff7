"""A movement primitive on its own path, as fast as limits of velocity and acceleration allow at every place."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import positive
from armlab.errors import ConfigError, ShapeError
from armlab.motion import _arguments
from armlab.motion._parameterisation import fastest, top
from armlab.motion._setting import clock
from armlab.motion.dmp import Dmp
from armlab.motion.limiting import AFTER, duration_within
from armlab.motion.rollout import Rollout, RunOptions

if TYPE_CHECKING:
    from armlab.motion.control import Arms, Limits
    from armlab.motion.controllers import DmpController

__all__ = ["PacedDmp", "PacedStepper", "within"]

STEPS = 2000  # knots of the pace over a duration
MARGIN = 1e-6  # for what parabolas through samples do not see
PARTS = 4  # of an interval between them, at which limits are checked


def within(
    dmp: Dmp,
    v_max: ArrayLike = np.inf,
    a_max: ArrayLike = np.inf,
    *,
    y0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    g: ArrayLike | None = None,
    amplitude: ArrayLike | None = None,
) -> PacedDmp:
    """Return the motion on the same path that slows down only where a limit asks for it.

    It is as fast as limits allow, and nowhere faster than the demonstration: the time-optimal parameterisation of the
    path with a rate of at most 1. It never takes longer than the whole motion stretched, `duration_within`. Its
    acceleration jumps: jerk has no limit.

    Parameters
    ----------
    dmp, v_max, a_max, y0, v0, g, amplitude : as of `duration_within`.

    Raises
    ------
    ShapeError : as of `duration_within`.
    """
    v, a = (_arguments.joint_limit(limit, what, dmp.n) for limit, what in ((v_max, "v_max"), (a_max, "a_max")))
    given: RunOptions = {"y0": y0, "v0": v0, "g": g, "amplitude": amplitude}
    uniform = dmp.duration / duration_within(dmp, v, a, y0=y0, v0=v0, g=g, amplitude=amplitude)
    M = round((1.0 + AFTER) * STEPS)
    s = np.linspace(0.0, (1.0 + AFTER) * dmp.duration, M * PARTS + 1)
    knots, h = s[::PARTS], s[PARTS]
    path = dmp.rollout(s, **given)
    z = fastest(h, path.yd[::PARTS], path.ydd[::PARTS], v, a)
    place = PARTS * np.arange(M)[:, None] + np.arange(PARTS + 1)
    share = np.arange(PARTS + 1)[:, None] / PARTS
    squares = z[:-1, None, None] * (1.0 - share) + z[1:, None, None] * share
    slope = path.yd[place]
    speed = top(slope * np.sqrt(squares))
    acceleration = top(path.ydd[place] * squares + slope * (np.diff(z) / (2 * h))[:, None, None])
    over = max(1.0, (1.0 + MARGIN) * float(np.max(np.maximum(speed / v, np.sqrt(acceleration / a)))))
    paced = PacedDmp(dmp, knots, np.sqrt(z) / over, given)
    if paced.duration > dmp.duration / uniform:
        return PacedDmp(dmp, knots, np.full(M + 1, uniform), given)
    return paced


@dataclass(frozen=True, eq=False)
class PacedDmp:
    """A primitive whose clock runs at a pace of its own; made by `within`.

    Attributes
    ----------
    dmp : the primitive. s : (M + 1,) times on its own clock [s]. rate : (M + 1,) s' there; after the last it stays.
    run : start, velocity at it, goal and amplitude.
    t : (M + 1,) times at which the clock shows s [s]. change : (M + 1,) of the rate from then on [1/s].
    """

    dmp: Dmp
    s: np.ndarray
    rate: np.ndarray
    run: RunOptions
    t: np.ndarray = field(init=False)
    change: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Freeze, and find the times of the knots."""
        steps = 2 * np.diff(self.s) / (self.rate[1:] + self.rate[:-1])
        object.__setattr__(self, "t", np.append(0.0, np.cumsum(steps)))
        object.__setattr__(self, "change", np.append(np.diff(self.rate) / steps, 0.0))
        for name in ("s", "rate", "t", "change"):
            values = getattr(self, name).view()
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.dmp.n

    @property
    def duration(self) -> float:
        """Time at which the primitive's own clock shows its duration [s]."""
        return float(np.interp(self.dmp.duration, self.s, self.t))

    def clock(self, t: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the primitive's own time, its rate and the change of that, each (...), at times since the start.

        Parameters
        ----------
        t : (...) from 0 [s].
        """
        times = np.asarray(t, dtype=float)
        i = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, None)
        since, change = times - self.t[i], self.change[i]
        return self.s[i] + since * (self.rate[i] + 0.5 * since * change), self.rate[i] + since * change, change

    def rollout(self, t: ArrayLike) -> Rollout:
        """Return the motion at times t; x and the forcing are those of the place on the path.

        Parameters
        ----------
        t : times (N,), counted from the first, or a time step, with which it runs for its duration [s].

        Raises
        ------
        ShapeError : times that do not increase, not finite, no step above zero.
        """
        times = clock(t, self.duration)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or not (np.diff(times) > 0.0).all():
            raise ShapeError("Expected finite times (N,) that increase, got others. Drop repeated samples.")
        s, rate, change = self.clock(times - times[0])
        path = self.dmp.rollout(np.union1d(s, self.s[self.s < s[-1]]), **self.run)
        at = np.searchsorted(path.t, s)
        r, u = rate[:, None], change[:, None]
        y, yd, ydd = path.y[at], path.yd[at] * r, path.ydd[at] * r**2 + path.yd[at] * u
        return Rollout(times, y, yd, ydd, path.x[at], path.forcing[at])

    def stepper(self, **run: Unpack[RunOptions]) -> PacedStepper:
        """Return what runs it sample by sample.

        Parameters
        ----------
        **run : `RunOptions` where they differ from the plan, but no duration; the pace stays that of the plan.

        Raises
        ------
        ShapeError, ConfigError : as of `Dmp.stepper`.
        """
        if run.keys() & {"duration", "tau_d"}:
            raise ConfigError("Expected a run at the pace of the plan, got a duration. Give `within` a slower motion.")
        return PacedStepper(self, {**self.run, **run})

    def controller(self, robot: Arms, *, limits: Limits | Sequence[Limits] | None = None) -> DmpController:
        """Return a controller ``State -> Command`` at this pace, which starts where the arm is, at rest.

        Limits hold as planned where the arm is at the start of the plan; elsewhere, and after another goal, the path is
        another one at the same pace, and the limits of the controller act last (`Controller.clamped`).

        Parameters
        ----------
        robot, limits : as of `Dmp.controller`.

        Raises
        ------
        ShapeError : as of `Dmp.controller`.
        """
        from armlab.motion.controllers import DmpController

        return DmpController(robot, self, {}, limits)


class PacedStepper:
    """One run of a `PacedDmp`, sample by sample; made by `PacedDmp.stepper`.

    Parameters
    ----------
    paced : what runs. run : start, goal and amplitude.
    """

    def __init__(self, paced: PacedDmp, run: RunOptions) -> None:
        self._paced, self._inner = paced, paced.dmp.stepper(**run)
        self.reset()

    def reset(self) -> None:
        """Go back to the start."""
        self._knots = self._paced.t.tolist()
        self._inner.reset()
        self._t = self._s = 0.0
        self._rate, self._change = float(self._paced.rate[0]), float(self._paced.change[0])

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one sample and return y, yd, ydd, each (n,).

        Parameters
        ----------
        dt : time since the last sample [s], above zero.

        Raises
        ------
        ShapeError : no finite time above zero.
        """
        self._t += positive(dt, "dt [s]", "At 250 Hz it is 0.004.")
        paced, i, before = self._paced, bisect_right(self._knots, self._t) - 1, self._s
        since, start = self._t - self._knots[i], float(paced.rate[i])
        self._change = float(paced.change[i])
        self._rate = start + since * self._change
        self._s = float(paced.s[i]) + 0.5 * since * (start + self._rate)
        self._inner.step(self._s - before)
        return self.state

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and acceleration now, each (n,)."""
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
        """Goal now (n,)."""
        return self._inner.goal

    def change_goal(self, g: ArrayLike) -> None:
        """Go for another goal from now on, at the same pace: the limits of the plan are no longer sure.

        Parameters
        ----------
        g : (n,) goal.

        Raises
        ------
        ShapeError : as of `Stepper.change_goal`.
        """
        self._inner.change_goal(g)
