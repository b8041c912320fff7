"""Obstacles on the way of a movement primitive: points, spheres and capsules that it goes around."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number, numbers
from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.motion._setting import Setting
from armlab.motion.dmp import Dmp
from armlab.motion.rollout import Rollout

__all__ = ["FORMS", "Obstacle", "avoid"]

FORMS = ("steering", "potential")
STEER, TURN = 12.0, 20.0 / np.pi  # 1/s per rad; 1/rad: the gains of Hoffmann et al.
PUSH, SHARP = 0.15, 2.0  # m^2/s; exponent: of a potential like that of Park et al.
RATE = 15.0  # 1/s: of the guard that keeps the clearance
SLIDE = 0.3  # of what the guard adds: along the surface, so that no motion ends behind an obstacle
STILL = 1e-9  # m/s: slower has no direction


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A capsule: all points within `radius` of the segment from a to b; a sphere where these are one, or a point.

    Attributes
    ----------
    a, b : (d,) ends, in the coordinates of the motion [m]. radius : [m].

    Raises
    ------
    ShapeError : ends of other shapes, not finite, a negative radius.
    """

    a: np.ndarray
    b: np.ndarray
    radius: float = 0.0

    def __post_init__(self) -> None:
        """Check and freeze."""
        for name in ("a", "b"):
            end = np.array(numbers(getattr(self, name), name, ShapeError))
            if end.ndim != 1 or len(end) not in (2, 3) or not np.isfinite(end).all():
                raise ShapeError(f"Expected {name} as a finite point (2,) or (3,), got shape {end.shape}.")
            end.flags.writeable = False
            object.__setattr__(self, name, end)
        radius = number(self.radius, "radius [m]")
        if self.a.shape != self.b.shape or not 0.0 <= radius < np.inf:
            raise ShapeError("Expected both ends in one space and a radius of 0 or more, got others. Correct it.")

    @classmethod
    def sphere(cls, centre: ArrayLike, radius: float = 0.0) -> Obstacle:
        """Return a sphere, or a point without a radius.

        Parameters
        ----------
        centre : (d,) [m]. radius : [m].
        """
        c = numbers(centre, "centre", ShapeError)
        return cls(c, c, radius)

    def nearest(self, y: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the distance from the surface [m], negative inside, and the direction away from it (d,).

        Parameters
        ----------
        y : (d,) [m].
        """
        along = self.b - self.a
        square = float(along @ along)
        share = min(max(float((y - self.a) @ along) / square, 0.0), 1.0) if square > 0.0 else 0.0
        away = y - (self.a + share * along)
        length = float(np.sqrt(away @ away))
        return length - self.radius, away / length if length > 0.0 else _across(along)


@dataclass(frozen=True)
class _How:
    clearance: float
    reach: float
    form: str


def avoid(
    dmp: Dmp,
    t: ArrayLike,
    obstacles: Sequence[Obstacle],
    *,
    clearance: float,
    reach: float,
    form: str = "steering",
    duration: float | None = None,
    y0: ArrayLike | None = None,
    g: ArrayLike | None = None,
) -> Rollout:
    """Run a primitive of a point in space around obstacles, with a clearance from all of them.

    ``ydd = ydd_dmp + sum w(d) C``, where C turns the velocity v away from an obstacle at angle theta, distance d,

    "steering": ``C = 12 theta exp(-20 theta / pi) R v`` with R the quarter turn away from it (Hoffmann et al. 2009);
    "potential": ``C = 0.15 |v| cos(theta) (2 sin(theta) R + cos(theta) n) / d^2`` where it goes there, with n away from
    it: the slope of a potential ``cos(theta)^2 |v| / d`` like that of Park et al. (2008).

    w falls from 1 at the clearance to 0 at `reach`, so what is further away does not act. Last a guard keeps
    ``h = d - clearance`` above zero: ``n . ydd >= -2 k hd - k^2 h``, and what it takes off pushes along the surface.

    Parameters
    ----------
    dmp : of two or three coordinates [m], with a phase of time. t, duration, y0, g : as of `Dmp.rollout`.
    obstacles : any number. clearance : least distance from their surfaces [m]. reach : distance at which they act [m].
    form : "steering" or "potential".

    Raises
    ------
    ShapeError : another space, start or goal within the clearance. UnknownName : another form.
    ConfigError : schedule "position", a reach that is not above the clearance.
    """
    if form not in FORMS:
        raise UnknownName.among("form of avoidance", form, FORMS)
    if dmp.schedule == "position" or dmp.n not in (2, 3):
        raise ConfigError("Expected a primitive of two or three coordinates with a phase of time, got another.")
    if not 0.0 <= clearance < reach < np.inf:
        raise ConfigError(f"Expected 0 <= clearance < reach, got {clearance} and {reach} m. Correct them.")
    run = Setting.of(dmp, duration, None, y0, None, g)
    for name, point in (("start", run.y0), ("goal", run.g)):
        for i, one in enumerate(obstacles):
            if one.a.shape != point.shape or one.nearest(point)[0] <= clearance:
                raise ShapeError(
                    f"Expected the {name} outside the clearance of every obstacle and in their space, got obstacle {i} "
                    "there. Move it, or ask for less."
                )
    plain = dmp.rollout(t, duration=duration, y0=y0, g=g)
    half = np.empty(2 * len(plain.t) - 1)
    half[::2], half[1::2] = plain.t, 0.5 * (plain.t[1:] + plain.t[:-1])
    f = run.scale * run.primitive.forcing(dmp.phase(half - half[0], run.tau))
    return _integrated(dmp, run, plain, f, obstacles, _How(clearance, reach, form))


def _integrated(
    dmp: Dmp, run: Setting, plain: Rollout, f: np.ndarray, obstacles: Sequence[Obstacle], how: _How
) -> Rollout:
    """Integrate by Runge and Kutta with the forcing at the start, the middle and the end of each step."""
    alpha, k, tau = dmp.alpha_z, dmp.alpha_z * dmp.beta_z, run.tau

    def law(y: np.ndarray, v: np.ndarray, force: np.ndarray) -> np.ndarray:
        a = (k * (run.g - y) - alpha * tau * v + force) / tau**2
        return _guarded(y, v, a + _coupling(y, v, obstacles, how), run.g, obstacles, how.clearance)

    y, v = run.y0.copy(), run.v0.copy()
    rows = [(y, v, law(y, v, f[0]))]
    for i, h in enumerate(np.diff(plain.t)):
        middle = f[2 * i + 1]
        a1 = rows[-1][2]
        y2, v2 = y + h / 2 * v, v + h / 2 * a1
        a2 = law(y2, v2, middle)
        y3, v3 = y + h / 2 * v2, v + h / 2 * a2
        a3 = law(y3, v3, middle)
        y4, v4 = y + h * v3, v + h * a3
        a4 = law(y4, v4, f[2 * i + 2])
        y, v = y + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        rows.append((y, v, law(y, v, f[2 * i + 2])))
    y_all, v_all, a_all = (np.array(part) for part in zip(*rows))
    return Rollout(np.array(plain.t), y_all, v_all, a_all, np.array(plain.x), f[::2])


def _coupling(y: np.ndarray, v: np.ndarray, obstacles: Sequence[Obstacle], how: _How) -> np.ndarray:
    total, speed = np.zeros_like(y), float(np.sqrt(v @ v))
    if speed < STILL:
        return total
    for one in obstacles:
        d, n = one.nearest(y)
        if d >= how.reach:
            continue
        u = min(max((how.reach - d) / (how.reach - how.clearance), 0.0), 1.0)
        weight = u**3 * (10 - 15 * u + 6 * u * u)
        cosine = min(max(float(-n @ v) / speed, -1.0), 1.0)
        side = n + cosine * v / speed  # away, across the velocity
        length = float(np.sqrt(side @ side))
        side = side / length if length > 1e-9 else _across(v)
        theta = float(np.arccos(cosine))
        if how.form == "steering":
            total += weight * STEER * theta * np.exp(-TURN * theta) * speed * side
        elif cosine > 0.0:
            near = max(d, 0.1 * how.clearance, 1e-6)
            force = SHARP * np.sqrt(1 - cosine**2) * side + cosine * n
            total += weight * PUSH * cosine ** (SHARP - 1) * speed / near**2 * force
    return total


def _guarded(
    y: np.ndarray, v: np.ndarray, a: np.ndarray, g: np.ndarray, obstacles: Sequence[Obstacle], clearance: float
) -> np.ndarray:
    """Return the acceleration that keeps the clearance; what is taken off pushes along the surface, to the goal."""
    for one in obstacles:
        d, n = one.nearest(y)
        missing = -2 * RATE * float(n @ v) - RATE**2 * (d - clearance) - float(n @ a)
        if missing > 0.0:
            along = _along(n, y - 0.5 * (one.a + one.b), g - y)
            a = a + missing * n + SLIDE * missing * along
    return a


def _along(n: np.ndarray, *ways: np.ndarray) -> np.ndarray:
    """Return a unit vector along a surface: of the first of the ways that has a part in it."""
    for way in ways:
        part = way - float(way @ n) * n
        length = float(np.sqrt(part @ part))
        if length > 1e-3:
            return part / length
    return _across(n)


def _across(v: np.ndarray) -> np.ndarray:
    """Return a unit vector across another, the same for the same."""
    i = int(np.argmin(np.abs(v)))
    e = np.eye(len(v))[i]
    square = float(v @ v)
    side = e - (e @ v) / square * v if square > 0.0 else e
    return side / np.sqrt(side @ side)
