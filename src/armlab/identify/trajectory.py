"""Joint motion that can be sampled, joined, saved as a table and run on a robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlab._numbers import number
from armlab.errors import ShapeError
from armlab.log import Table
from armlab.state import Command, State

__all__ = ["Trajectory", "quintic_step", "sequence"]

LONGEST_STEP = 0.006  # s that a controller's clock moves at once: 1.5 periods, what the bridge lets a reference move
REST = 1e-3  # rad/s or m/s at an end of a saved motion


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A joint motion that can be sampled at any time.

    Attributes
    ----------
    seconds : length.
    sample : gives q, qd, qdd (..., n) at times (...,); constant outside [0, seconds].
    """

    seconds: float
    sample: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]

    @property
    def q_first(self) -> np.ndarray:
        """Position (n,) at the start."""
        return self.sample(np.array(0.0))[0]

    def table(self, rate: float = 250.0) -> Table:
        """Return the motion as a log with q, qd, qdd (N, n), for `log.write_csv`.

        Parameters
        ----------
        rate : samples per second [Hz].

        Raises
        ------
        ShapeError : for a rate that is not above 0.
        """
        if not 0 < rate < np.inf:
            raise ShapeError(f"Expected a rate above 0 Hz, got {rate:g} Hz. Give the rate of the controller.")
        t = np.append(np.arange(0.0, self.seconds - 0.5 / rate, 1.0 / rate), self.seconds)
        q, qd, qdd = self.sample(t)
        return Table(t, {"q": q, "qd": qd, "qdd": qdd}, source=("Trajectory.table",))

    @classmethod
    def from_table(cls, table: Table) -> Trajectory:
        """Return the motion that a table holds, to be run again: cubic between rows, with the slopes qd.

        Parameters
        ----------
        table : q and qd (N, n), at rest in the first and the last row.

        Raises
        ------
        ShapeError : fewer than two rows, missing values, or ends in motion.
        """
        from scipy.interpolate import CubicHermiteSpline

        t, q, qd = table.t, table["q"], table["qd"]
        if len(t) < 2 or q.shape != qd.shape or not (np.isfinite(q).all() and np.isfinite(qd).all()):
            raise ShapeError(
                f"Expected q and qd of one shape (N, n) without missing values, got {q.shape} and {qd.shape}. "
                "Save the motion again with Trajectory.table."
            )
        if np.abs(qd[[0, -1]]).max() > REST:
            raise ShapeError(
                f"Expected a motion at rest at both ends, got {np.abs(qd[[0, -1]]).max():.3g} rad/s. "
                "Blend it in and out; a robot cannot jump to a speed."
            )
        spline = CubicHermiteSpline(t, q, qd)
        first, second, begin, end = spline.derivative(), spline.derivative(2), t[0], t[-1]

        def sample(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            inside = np.clip(np.asarray(at, dtype=float) + begin, begin, end)
            return spline(inside), first(inside), second(inside)

        return cls(float(end - begin), sample)

    def controller(self, approach: float = 4.0) -> Callable[[State], Command]:
        """Return a controller that walks from where the arm stands to the start, then runs the motion.

        Its clock follows the robot's, but never by more than 6 ms at once: after lost packets the motion goes on
        where it was, without a jump. It starts again in each session.

        Parameters
        ----------
        approach : seconds of the walk (quintic, at rest at both ends).
        """
        clock, session = 0.0, 0

        def step(state: State) -> Command:
            nonlocal clock, session
            clock = clock + min(state.dt, LONGEST_STEP) if state.session == session else 0.0
            session = state.session
            if clock < approach:
                s, ds, _ = quintic_step(clock / approach)
                way = self.q_first - state.q_start
                return Command(q=state.q_start + s * way, qd=ds / approach * way)
            q, qd, _ = self.sample(np.array(clock - approach))
            return Command(q=q, qd=qd)

        return step


def quintic_step(x: float) -> tuple[float, float, float]:
    """Return the smooth step ``x^3 (10 - 15 x + 6 x^2)`` of x in [0, 1] and its two derivatives.

    Parameters
    ----------
    x : share of the step; below 0 it has not begun, above 1 it is over.
    """
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x), 30 * x * x * (1 - x) ** 2, 60 * x * (1 - x) * (1 - 2 * x)


def sequence(parts: Sequence[Trajectory], walk: float = 2.0) -> Trajectory:
    """Join motions that start and end at rest, with a quintic walk of `walk` seconds between them.

    Parameters
    ----------
    parts : at least one motion. walk : seconds of each walk, above 0.

    Raises
    ------
    ShapeError : for no parts, parts that are no motions, or no time to walk.
    """
    walk = number(walk, "the walk [s]")
    if not isinstance(parts, list | tuple) or not all(isinstance(part, Trajectory) for part in parts):
        raise ShapeError(f"Expected a list of motions, got {type(parts).__name__}. identify.excitation gives one.")
    if not parts or not 0 < walk < np.inf:
        raise ShapeError(f"Expected at least one motion and a walk above 0 s, got {len(parts)} and {walk:g} s.")
    starts = np.cumsum([0.0, *(part.seconds + walk for part in parts[:-1])])
    total = float(starts[-1] + parts[-1].seconds)

    def one(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        k = int(np.searchsorted(starts, t, side="right")) - 1
        local = t - starts[k]
        if local <= parts[k].seconds or k == len(parts) - 1:
            return parts[k].sample(np.array(local))
        here, there = parts[k].sample(np.array(parts[k].seconds))[0], parts[k + 1].q_first
        x = (local - parts[k].seconds) / walk
        s, ds, dds = quintic_step(x)
        return here + s * (there - here), ds / walk * (there - here), dds / walk**2 * (there - here)

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, total)
        if t.ndim == 0:
            return one(float(t))
        rows = [one(float(x)) for x in t.ravel()]
        q, qd, qdd = (np.array([row[k] for row in rows]).reshape(*t.shape, -1) for k in range(3))
        return q, qd, qdd

    return Trajectory(total, sample)
