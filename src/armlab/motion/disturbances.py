"""Disturbances of an arm (`Hold`, `Push`, `Displace`) and simulation of two-degree-of-freedom control."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only, number, numbers
from armlab.errors import ShapeError
from armlab.motion.primitive.run import Rollout

Dofs = Sequence[int] | None

Plant = Callable[[float, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Plant of an arm with imperfect tracking: ``(t, ya, ya', ya_ref'') -> ya''``."""
FULL_SPEED = np.array([1.0, 1.0, 0.0])
"""Nominal clock speed of a control law: values at the beginning and the end of a step, and rate of change."""
_SLACK = 1e-9  # tolerance for rounding of times, as a fraction of a step


@dataclass(frozen=True, repr=False)
class Push(Shown):
    """External force that moves coordinates at a constant velocity: ``ya' = velocity``.

    Attributes
    ----------
    t0, t1 : start and end [s].
    velocity : one number for all pushed coordinates, or one per coordinate, in the unit of y per second.
    dofs : indices of the coordinates, from 0; default: all.

    Raises
    ------
    ShapeError : non-finite or non-increasing times, or non-finite velocities.
    """

    t0: float
    t1: float
    velocity: float | Sequence[float] | np.ndarray
    dofs: Dofs = None

    def __post_init__(self) -> None:
        start, end = number(self.t0, "t0 [s]"), number(self.t1, "t1 [s]")
        if not -np.inf < start < end < np.inf:
            raise ShapeError(f"Expected an event with finite t0 < t1, got {start:g} to {end:g} s.")
        if not np.isfinite(numbers(self.velocity, "velocity", ShapeError)).all():
            raise ShapeError(f"Expected a finite velocity, got {self.velocity}.")

    def _drive(self, n: int) -> np.ndarray:
        """Return the imposed velocity (n,); NaN for free coordinates."""
        which = np.arange(n) if self.dofs is None else np.asarray(self.dofs)
        whole = which.ndim == 1 and which.dtype.kind in "iu" and bool(((which >= 0) & (which < n)).all())
        if not whole or not which.size or len(set(which.tolist())) < len(which):
            raise ShapeError(f"Expected dofs to be distinct indices from 0 to {n - 1}, got {self.dofs}.")
        velocity = numbers(self.velocity, "velocity", ShapeError)
        if velocity.shape not in ((), which.shape):
            raise ShapeError(
                f"Expected one velocity, or {which.size} velocities for {which.size} dofs, got shape {velocity.shape}."
            )
        driven = np.full(n, np.nan)
        driven[which] = velocity
        return driven


class Hold(Push):
    """Constraint that holds coordinates in place: ``ya' = 0``.

    Parameters
    ----------
    t0, t1 : start and end [s].
    dofs : indices of the coordinates, from 0; default: all.

    Raises
    ------
    ShapeError : non-finite or non-increasing times.
    """

    def __init__(self, t0: float, t1: float, dofs: Dofs = None) -> None:
        super().__init__(t0, t1, 0.0, dofs)


@dataclass(frozen=True, eq=False, repr=False)
class Displace(Shown):
    """Impact that displaces the arm instantaneously: ``ya`` jumps by dy at time t.

    Attributes
    ----------
    t : time of the impact [s].
    dy : displacement (n,), or one number for all coordinates, in the unit of y.

    Raises
    ------
    ShapeError : a non-finite time or displacement.
    """

    t: float
    dy: ArrayLike

    def __post_init__(self) -> None:
        if not np.isfinite(number(self.t, "t [s]")) or not np.isfinite(numbers(self.dy, "dy", ShapeError)).all():
            raise ShapeError(f"Expected a finite time and displacement, got {self.t} and {self.dy}.")


@dataclass(frozen=True, eq=False, repr=False)
class TwoDofRun(Shown):
    """Simulated or recorded run at N times; values at the time of an event are those just before the event.

    Attributes
    ----------
    t : (N,) times [s].
    yc, ycd, ycdd : (N, n) coupled path with velocity and acceleration.
    ya, yad : (N, n) actual position and velocity.
    ydd_ref : (N, n) reference acceleration.
    e : (N, n) filtered error.
    x : (N,) phase; (N, n) with schedule "position".
    tau_a : (N,) time constant [s].
    frozen : (N,) whether the path was paused.
    free : run of the undisturbed primitive.
    disturbed : interval (t0, t1) of each disturbance [s], in order; t0 = t1 for an impact.
    """

    t: np.ndarray
    yc: np.ndarray
    ycd: np.ndarray
    ycdd: np.ndarray
    ya: np.ndarray
    yad: np.ndarray
    ydd_ref: np.ndarray
    e: np.ndarray
    x: np.ndarray
    tau_a: np.ndarray
    frozen: np.ndarray
    free: Rollout
    disturbed: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        make_read_only(self, *(one.name for one in fields(self)[:-2]))


def simulated(
    law: Any, start: np.ndarray, t: np.ndarray, events: Sequence[Push | Displace | Plant], longest: float
) -> tuple[np.ndarray, tuple[tuple[float, float], ...]]:
    """Return the states (N, 5 n + 2) of a control law at times t (N,) [s], and the disturbed intervals.

    Integration steps are at most `longest` [s] long and never span an event; at most one of the events may be a plant.
    """
    scene = _EventSequence(events, law.n)
    edges = [edge for edge in scene.edges if t[0] < edge < t[-1]]
    stops = np.unique(np.concatenate([t, edges]))
    rows, y, due = [start], start, 1
    for now, then in pairwise(stops):
        y = scene.apply_displacements(now, y)
        span = then - now
        y = scene.advance(law, now, y, span, max(1, ceil(span / longest - _SLACK)))
        if then == t[due]:
            rows.append(y)
            due += 1
    return np.array(rows), scene.disturbed


class _EventSequence:
    """Events of one run."""

    def __init__(self, events: Sequence[Push | Displace | Plant], n: int) -> None:
        self._pushes: list[tuple[float, float, np.ndarray]] = []
        self._blows: list[tuple[float, np.ndarray]] = []
        plants: list[Plant] = []
        if not isinstance(events, Sequence):
            raise ShapeError(f"Expected a list of events, got {events!r}. Write [{type(events).__name__}(...)].")
        for event in events:
            if isinstance(event, Push):
                self._pushes.append((event.t0, event.t1, event._drive(n)))
            elif isinstance(event, Displace):
                self._blows.append((event.t, _displacement(event, n)))
            elif callable(event):
                plants.append(event)
            else:
                raise ShapeError(f"Expected events as Hold, Push, Displace or a plant (a function), got {event!r}.")
        if len(plants) > 1:
            raise ShapeError(f"Expected at most one plant, got {len(plants)}. Combine them in one function.")
        self._plant = plants[0] if plants else None
        for i, (t0, t1, first) in enumerate(self._pushes):
            for s0, s1, second in self._pushes[:i]:
                if max(t0, s0) < min(t1, s1) and np.isfinite(first + second).any():
                    raise ShapeError(
                        f"Expected at most one event per coordinate at a time, got two events from {max(t0, s0):g} to "
                        f"{min(t1, s1):g} s. Separate them in time."
                    )
        times = [(t0, t1) for t0, t1, _ in self._pushes] + [(at, at) for at, _ in self._blows]
        self.disturbed = tuple(sorted(times))
        self.edges = sorted({edge for span in times for edge in span})

    def apply_displacements(self, now: float, y: np.ndarray) -> np.ndarray:
        """Return the state after the impacts at this time."""
        n = (len(y) - 2) // 5
        for at, dy in self._blows:
            if at == now:
                y = y.copy()
                y[3 * n : 4 * n] += dy
        return y

    def advance(self, law: Any, now: float, y: np.ndarray, span: float, steps: int) -> np.ndarray:
        """Return the state after an interval in which no event starts or ends."""
        driven = np.full(law.n, np.nan)
        for t0, t1, velocity in self._pushes:
            if t0 <= now < t1:
                driven = np.where(np.isfinite(velocity), velocity, driven)
        if self._plant is None:
            return law.advance(y, span, steps, driven, FULL_SPEED)
        h = span / steps
        for k in range(steps):
            y = self._step(law, now + k * h, law.advance(y, 0.0, 1, driven, FULL_SPEED), h, np.isfinite(driven))
        return y

    def _step(self, law: Any, t: float, y: np.ndarray, h: float, moved: np.ndarray) -> np.ndarray:
        """Return the state after one fourth-order step of the control law and the plant together."""
        k1 = self._slopes(law, t, y, moved)
        k2 = self._slopes(law, t + 0.5 * h, y + 0.5 * h * k1, moved)
        k3 = self._slopes(law, t + 0.5 * h, y + 0.5 * h * k2, moved)
        k4 = self._slopes(law, t + h, y + h * k3, moved)
        return y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)

    def _slopes(self, law: Any, t: float, y: np.ndarray, moved: np.ndarray) -> np.ndarray:
        n, plant = law.n, self._plant
        slopes = law.slopes(y, FULL_SPEED)
        if plant is not None:
            found = np.asarray(plant(t, y[3 * n : 4 * n], y[4 * n : 5 * n], slopes[4 * n : 5 * n]), dtype=float)
            if found.shape != (n,) or not np.isfinite(found).all():
                raise ShapeError(f"Expected a plant that returns ({n},) finite accelerations, got {found} at {t:g} s.")
            slopes[4 * n : 5 * n] = np.where(moved, 0.0, found)
        return slopes


def _displacement(event: Displace, n: int) -> np.ndarray:
    dy = np.asarray(event.dy, dtype=float)
    if dy.shape not in ((), (n,)):
        raise ShapeError(f"Expected a displacement of {n} coordinates, or one number for all, got shape {dy.shape}.")
    return np.broadcast_to(dy, (n,))
