"""Obstacles that a motion goes around.

Coordinates are a point in the plane or in space, or the joints of an arm that carries capsules. Of each pair of a body
and an obstacle: p the point of the body that is nearest, d the distance of the surfaces, m the direction away, v the
velocity relative to the obstacle, theta the angle from v to the obstacle, R v / |v| the direction across v, away.

steering: ``C = w(d) 12 theta exp(-20 theta / pi) |v| R``; potential: ``C = w(d) 0.15 |v| cos(theta)
(2 sin(theta) R + cos(theta) m) / d^2`` while it comes nearer. w rises from 0 at `reach` to 1 at `clearance`.

What acts at p along e acts on the coordinates as ``j^T / (j j^T + 0.02^2)`` with ``j = e^T J_p``, the least motion that
does it (in space ``e`` itself). Last a guard keeps ``h = d - clearance`` above zero: with ``k = max(15, -h'/h)``,
``m . p'' >= -2 k h' - k^2 h``; what lacks is added along m, and 0.3 of it along the surface.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from .chain import Chain

STEERING, TURN = 12.0, 20.0 / np.pi
PUSHING = 0.15
SLOWEST, FASTEST = 15.0, 200.0
SLIDE = 0.3
STILL, STRAIGHT, APART = 1e-9, 1e-9, 1e-3
PARALLEL = 1e-24
DAMPING = 0.02
SWEEPS = 8


@dataclass
class _Contact:
    link: int
    obstacle: np.ndarray
    distance: float
    p: np.ndarray
    away: np.ndarray
    velocity: np.ndarray
    drift: np.ndarray


class Obstacles:
    """Obstacles and the rule by which they are avoided."""

    def __init__(
        self, arm: Any, links: Any, bodies: Any, clearance: float, reach: float, by_potential: bool = False
    ) -> None:
        self._rule, self._by_potential = (float(clearance), float(reach)), by_potential
        self._capsules = np.zeros((0, 10))
        self._arm = arm if isinstance(arm, Chain) else None
        if not isinstance(arm, Chain):
            self._axes = self.n = int(arm)
            return
        self._axes, self.n = 3, arm.n
        shapes = np.asarray(bodies, dtype=float)
        numbers = np.asarray(np.asarray(links, dtype=float), dtype=float)
        self._bodies = [(int(link), shape) for link, shape in zip(numbers, shapes)]
        self._slides = arm.prismatic

    def place(self, capsules: Any) -> None:
        """Put obstacles from now on."""
        self._capsules = np.array(capsules, dtype=float)

    def advance(self, dt: float) -> None:
        """Let the obstacles go on."""
        self._capsules[:, :3] += dt * self._capsules[:, 7:]
        self._capsules[:, 3:6] += dt * self._capsules[:, 7:]

    def distance(self, y: Any) -> np.ndarray:
        """Return the least distance (...) of any surface [m]; infinite without obstacles."""
        y = np.asarray(y, dtype=float)
        still = np.zeros(self.n)
        found = [np.min([c.distance for c in self._contacts(q, still)], initial=np.inf) for q in y.reshape(-1, self.n)]
        return np.array(found).reshape(y.shape[:-1])

    def acts(self, y: Any) -> bool:
        """Return whether anything is within reach."""
        y = np.asarray(np.asarray(y, dtype=float), dtype=float)
        return bool(self.distance(y) < self._rule[1])

    def add(self, y: Any, yd: Any, g: Any, ydd: Any) -> np.ndarray:
        """Return the acceleration (n,) with what obstacles add."""
        y, yd, g, a = (np.asarray(a, dtype=float) for a in (y, yd, g, ydd))
        near = [c for c in self._contacts(y, yd) if c.distance < self._rule[1]]
        a, rows = a.copy(), self._rows(y)
        for c in near:
            wanted = self._steer(c)
            size = np.sqrt(wanted @ wanted)
            if size > 0.0:
                a += size * _least(*rows(c, wanted / size))
        for sweep in range(SWEEPS):
            kept = True
            for c in near:
                lacks = self._missing(c, a, rows)
                if lacks > 0.0:
                    kept = False
                    a += lacks * _least(*rows(c, c.away))
                    a += SLIDE * lacks * _least(*rows(c, self._along(c, y, g))) if sweep == 0 else 0.0
            if kept:
                break
        return a

    def _contacts(self, y: np.ndarray, yd: np.ndarray) -> list[_Contact]:
        found = []
        for link, body, (origin, v, w, a, turn) in self._placed(y, yd):
            for obstacle in self._capsules:
                s, t = _shares(body, obstacle)
                p = body[:3] + s * (body[3:6] - body[:3])
                way = p - (obstacle[:3] + t * (obstacle[3:6] - obstacle[:3]))
                gap = np.sqrt(way @ way)
                away = way / gap if gap > 0.0 else _across(obstacle[3:6] - obstacle[:3], self._axes)
                r = p - origin
                velocity = v + np.cross(w, r) - obstacle[7:]
                drift = a + np.cross(turn, r) + np.cross(w, np.cross(w, r))
                d = float(gap - obstacle[6] - body[6])
                found.append(_Contact(link, obstacle, d, p, away, velocity, drift))
        return found

    def _placed(self, y: np.ndarray, yd: np.ndarray) -> Iterator[tuple[int, np.ndarray, tuple[np.ndarray, ...]]]:
        """Yield link, capsule and motion of every body: a point of the link, and v, w, a and the change of w there."""
        if self._arm is None:
            p, v = (np.append(x, np.zeros(3 - self._axes)) for x in (y, yd))
            zero = np.zeros(3)
            yield 0, np.concatenate([p, p, [0.0]]), (p, v, zero, zero, zero)
            return
        T = self._arm.link_transforms(y)
        moves = _moves(T, self._slides, yd)
        for link, shape in self._bodies:
            R, o = T[link - 1, :3, :3], T[link - 1, :3, 3]
            yield link, np.concatenate([o + R @ shape[:3], o + R @ shape[3:6], shape[6:]]), (o, *moves[link - 1])

    def _rows(self, y: np.ndarray) -> Any:
        """Return what gives ``j = e^T J_p`` of a contact, and its damped square."""
        if self._arm is None:
            return lambda c, e: (e[: self._axes], 1.0)
        T = self._arm.link_transforms(y)
        z, o = T[:, :3, 2], T[:, :3, 3]

        def row(c: _Contact, e: np.ndarray) -> tuple[np.ndarray, float]:
            columns = np.where(self._slides[:, None], z, np.cross(z, c.p - o))
            j = np.where(np.arange(self.n) < c.link, columns @ e, 0.0)
            return j, float(j @ j) + DAMPING**2

        return row

    def _steer(self, c: _Contact) -> np.ndarray:
        clearance, reach = self._rule
        speed = float(np.sqrt(c.velocity @ c.velocity))
        if speed < STILL:
            return np.zeros(3)
        u = min(max((reach - c.distance) / (reach - clearance), 0.0), 1.0)
        weight = u**3 * (10 - 15 * u + 6 * u * u)
        cosine = min(max(float(-c.away @ c.velocity) / speed, -1.0), 1.0)
        side = c.away + cosine / speed * c.velocity
        sine = np.sqrt(side @ side)
        side = side / sine if sine > STRAIGHT else _across(c.velocity, self._axes)
        if not self._by_potential:
            theta = np.arctan2(sine, cosine)  # the cosine has no digits of a small angle
            return weight * STEERING * theta * np.exp(-TURN * theta) * speed * side
        if cosine <= 0.0:
            return np.zeros(3)
        near = max(c.distance, 0.1 * reach)
        force = 2.0 * sine * side + cosine * c.away
        return weight * PUSHING * cosine * speed / near**2 * force

    def _missing(self, c: _Contact, a: np.ndarray, rows: Any) -> float:
        h, rate = c.distance - self._rule[0], float(c.away @ c.velocity)
        k = min(-rate / h, FASTEST) if h > 0.0 and -rate > SLOWEST * h else SLOWEST
        j, _ = rows(c, c.away)
        return -2 * k * rate - k * k * h - float(c.away @ c.drift) - float(j @ a)

    def _along(self, c: _Contact, y: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return a unit vector along the surface: to the nearer end of the obstacle, or to the goal."""
        if self._arm is None:
            goal = np.append(g, np.zeros(3 - self._axes))
        else:
            now, then = (self._arm.link_transforms(x)[c.link - 1] for x in (y, g))
            goal = then[:3, 3] + then[:3, :3] @ (now[:3, :3].T @ (c.p - now[:3, 3]))
        for way in (c.p - 0.5 * (c.obstacle[:3] + c.obstacle[3:6]), goal - c.p):
            part = way - float(way @ c.away) * c.away
            size = np.sqrt(part @ part)
            if size > APART:
                return part / size
        return _across(c.away, self._axes)


def _least(j: np.ndarray, square: float) -> np.ndarray:
    return j / square


def _across(v: np.ndarray, axes: int) -> np.ndarray:
    """Return a unit vector across another, the same for the same."""
    e = np.eye(3)[int(np.argmin(np.abs(v[:axes])))]
    square = float(v @ v)
    side = e - (e @ v) / square * v if square > 0.0 else e
    return side / np.sqrt(side @ side)


def _shares(one: np.ndarray, two: np.ndarray) -> tuple[float, float]:
    """Return the shares of two segments at which they are nearest."""
    d1, d2, r = one[3:6] - one[:3], two[3:6] - two[:3], one[:3] - two[:3]
    a, e, b, c, f = (float(x @ y) for x, y in ((d1, d1), (d2, d2), (d1, d2), (d1, r), (d2, r)))
    if a == 0.0:
        return 0.0, 0.0 if e == 0.0 else min(max(f / e, 0.0), 1.0)
    if e == 0.0:
        return min(max(-c / a, 0.0), 1.0), 0.0
    normal = np.cross(d1, d2)  # of which a e - b^2 is the square, but without digits next to parallel
    square = float(normal @ normal)
    s = min(max(float(normal @ np.cross(d2, r)) / square, 0.0), 1.0) if square > PARALLEL * a * e else 0.0
    t = (b * s + f) / e
    if t < 0.0:
        return min(max(-c / a, 0.0), 1.0), 0.0
    if t > 1.0:
        return min(max((b - c) / a, 0.0), 1.0), 1.0
    return s, t


def _moves(T: np.ndarray, slides: np.ndarray, yd: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Return v, w, a and the change of w of each link frame, where no joint accelerates (Newton and Euler)."""
    v = w = a = turn = before = np.zeros(3)
    found = []
    for i, rate in enumerate(yd):
        origin = T[i, :3, 3]
        r, along = origin - before if i else np.zeros(3), rate * T[i, :3, 2]
        v, a = v + np.cross(w, r), a + np.cross(turn, r) + np.cross(w, np.cross(w, r))
        if slides[i]:
            v, a = v + along, a + 2.0 * np.cross(w, along)
        else:
            w, turn = w + along, turn + np.cross(w, along)
        found.append((v, w, a, turn))
        before = origin
    return found
