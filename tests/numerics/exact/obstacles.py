"""Tables of the motion around obstacles: capsules in the plane, in space and on arms, of which one slides.

Distances are the least over all pairs of ends and feet, velocities and accelerations of a point on a link come from
the derivatives of its frame.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from chains import Motion, arm
from mpmath import mp
from rigid import array, chosen, each, exact, filled

Table = dict[str, Any]
Vector = Any
CLEARANCE, REACH = 0.05, 0.4
STEERING, PUSHING, SLOWEST, FASTEST, SLIDE, DAMPING, SWEEPS, STILL = (
    12, mp.mpf(0.15), 15, 200, mp.mpf(0.3), mp.mpf(0.02), 8, mp.mpf(1e-9),
)  # fmt: skip


def dot(a: Vector, b: Vector) -> Any:
    return (a.T * b)[0]


def nearest_points(a: Vector, b: Vector, c: Vector, d: Vector) -> tuple[Vector, Vector]:
    """Return the nearest points of two segments: of all candidates those that are nearest."""
    u, v, w = b - a, d - c, a - c

    def foot(p: Vector, start: Vector, way: Vector) -> Any:
        return min(max(dot(p - start, way) / dot(way, way), mp.zero), mp.one) if dot(way, way) else mp.zero

    pairs = [(mp.mpf(s), foot(a + s * u, c, v)) for s in (0, 1)] + [(foot(c + t * v, a, u), mp.mpf(t)) for t in (0, 1)]
    grid = mp.matrix([[dot(u, u), -dot(u, v)], [-dot(u, v), dot(v, v)]])
    if mp.det(grid) > mp.mpf(10) ** -60 * dot(u, u) * dot(v, v):
        s, t = mp.inverse(grid) * mp.matrix([-dot(u, w), dot(v, w)])
        pairs += [(s, t)] if 0 <= s <= 1 and 0 <= t <= 1 else []
    points = [(a + s * u, c + t * v) for s, t in pairs]
    return min(points, key=lambda two: mp.norm(two[0] - two[1]))


def across(v: Vector, axes: int) -> Vector:
    """Return a unit vector across another: of the axis that is the least in it."""
    e = mp.eye(3)[:, min(range(axes), key=lambda i: abs(v[i]))]
    part = e - dot(e, v) / dot(v, v) * v
    return part / mp.norm(part)


class Contact:
    """A body and an obstacle: nearest points, direction away, velocity, and Jacobian and its drift at the body."""

    def __init__(self, ends: list[Vector], radius: Any, obstacle: Vector, axes: int = 3) -> None:
        self.axes = axes
        self.middle = (obstacle[:3] + obstacle[3:6]) / 2
        self.p, other = nearest_points(*ends, obstacle[:3], obstacle[3:6])
        gap = mp.norm(self.p - other)
        self.away, self.distance = (self.p - other) / gap, gap - radius - obstacle[6]

    def move(self, J: mp.matrix, qd: Vector, drift: Vector, obstacle: Vector, goal: Vector) -> Contact:
        self.J, self.velocity, self.drift, self.goal = J, J * qd - obstacle[7:], drift, goal
        return self

    def acts(self, e: Vector, damped: bool) -> Vector:
        """Return the least motion that moves the point along e."""
        j = self.J.T * e
        return j / (dot(j, j) + DAMPING**2) if damped else j

    def steer(self, by_potential: bool) -> Vector:
        """Return the acceleration of the rule, at the point."""
        u = min(max((REACH_ - self.distance) / (REACH_ - CLEARANCE_), mp.zero), mp.one)
        weight, speed = u**3 * (10 - 15 * u + 6 * u**2), mp.norm(self.velocity)
        if speed < STILL:
            return mp.zeros(3, 1)
        side = self.away - dot(self.away, self.velocity) / speed**2 * self.velocity
        cosine, sine = -dot(self.away, self.velocity) / speed, mp.norm(side)
        side, theta = side / sine if sine > STILL else across(self.velocity, self.axes), mp.atan2(sine, cosine)
        if not by_potential:
            return weight * STEERING * theta * mp.exp(-20 * theta / mp.pi) * speed * side
        if cosine <= 0:
            return 0 * side
        near = max(self.distance, REACH_ / 10)
        return weight * PUSHING * cosine * speed / near**2 * (2 * sine * side + cosine * self.away)

    def lacks(self, a: Vector) -> Any:
        """Return by how much the guard misses the acceleration of the point."""
        h, rate = self.distance - CLEARANCE_, dot(self.away, self.velocity)
        k = min(max(-rate / h, SLOWEST), FASTEST) if h > 0 else mp.mpf(SLOWEST)
        return -2 * k * rate - k**2 * h - dot(self.away, self.J * a + self.drift)

    def along(self) -> Vector:
        """Return the way along the surface: to the nearer end of the obstacle, or to the goal where there is none."""
        for way in (self.p - self.middle, self.goal - self.p):
            part = way - dot(way, self.away) * self.away
            if mp.norm(part) > mp.mpf(1e-3):
                return part / mp.norm(part)
        return across(self.away, self.axes)


CLEARANCE_, REACH_ = mp.mpf(CLEARANCE), mp.mpf(REACH)


def added(contacts: list[Contact], a: Vector, damped: bool, by_potential: bool) -> Vector:
    near = [c for c in contacts if c.distance < REACH_]
    for c in near:
        wanted = c.steer(by_potential)
        size = mp.norm(wanted)
        a = a + size * c.acts(wanted / size, damped) if size else a
    for sweep in range(SWEEPS):
        kept = True
        for c in near:
            lacks = c.lacks(a)
            if lacks > 0:
                kept = False
                a = a + lacks * c.acts(c.away, damped)
                a = a + SLIDE * lacks * c.acts(c.along(), damped) if sweep == 0 else a
        if kept:
            break
    return a


def in_space(y: Vector, yd: Vector, g: Vector, capsules: np.ndarray) -> list[Contact]:
    axes = len(y)
    J = mp.eye(3)[:, :axes]
    rows = [exact(row) for row in capsules]
    return [Contact([J * y] * 2, mp.zero, row, axes).move(J, yd, mp.zeros(3, 1), row, J * g) for row in rows]


def on_arm(robot: Any, q: Vector, qd: Vector, g: Vector, capsules: np.ndarray) -> list[Contact]:
    frames, prismatic, links, bodies = robot
    motion, found, n = Motion(frames, prismatic, q, qd), [], len(prismatic)
    then = Motion(frames, prismatic, g)
    for (link, body), row in product(zip(links, bodies), capsules):
        T, shape, k, obstacle = motion.transform(int(link)), exact(body), int(link) - 1, exact(row)
        ends = [(T * mp.matrix([*shape[i : i + 3], 1]))[:3] for i in (0, 3)]
        contact = Contact(ends, shape[6], obstacle)
        x = mp.inverse(T) * mp.matrix([*contact.p, 1])
        J = mp.matrix([list((D * x)[:3]) for D in motion.first[k]]).T
        drift = sum(
            ((motion.second[k][i][j] * x)[:3] * (qd[i] * qd[j]) for i in range(n) for j in range(n)), mp.zeros(3, 1)
        )
        found.append(contact.move(J, qd, drift, obstacle, (then.transform(int(link)) * x)[:3]))
    return found


def table(
    call: Callable[..., list[Contact]],
    given: dict[str, np.ndarray],
    fixed: dict[str, np.ndarray],
    damped: bool,
    name: str,
) -> dict[str, Table]:
    count = len(given["y"])
    rows = {k: call(*(exact(given[key][k]) for key in ("y", "yd", "g")), fixed["capsules"]) for k in chosen(count)}
    least = filled({k: array([min(c.distance for c in row)]) for k, row in rows.items()}, count)
    found = {f"Obstacles {name} distance": {"fixed": fixed, "given": given, "wanted": least}}
    for rule in ("steering", "potential"):
        made = {k: array(added(row, exact(given["ydd"][k]), damped, rule == "potential")) for k, row in rows.items()}
        found[f"Obstacles {name} {rule}"] = {"fixed": fixed, "given": given, "wanted": filled(made, count)}
    return found


def drawn(rng: np.random.Generator, shape: tuple[int, int], **sizes: float) -> dict[str, np.ndarray]:
    return {name: rng.normal(size=shape) * size for name, size in sizes.items()}


def points(rng: np.random.Generator, fixed: dict[str, np.ndarray]) -> dict[str, Table]:
    """Return the tables of a point in space, and in the plane."""
    capsules, sizes = fixed["capsules"], {"y": 0.3, "yd": 0.5, "g": 0.5, "ydd": 2.0}
    given = drawn(rng, (8, 3), **sizes)
    given["y"][0] = capsules[1, :3] + [0.1, 1e-9, 0.0]
    given["y"][1], given["y"][2] = capsules[0, :3] + [0.02, 0.03, 0.0], [5.0, -4.0, 3.0]
    found = table(in_space, given, fixed, False, "space")
    flat = capsules * np.array([1, 1, 0, 1, 1, 0, 1, 1, 1, 0])
    given = drawn(rng, (6, 2), **sizes)
    given["y"][0], given["y"][1] = flat[1, :2] + [0.1, 0.01], flat[0, :2] + [0.02, 0.06]
    return found | table(in_space, given, fixed | {"capsules": flat}, False, "plane")


def straight(rng: np.random.Generator, fixed: dict[str, np.ndarray]) -> dict[str, Table]:
    """Return the tables of ways that lead to the middle of a ball, all but some angle, or end where they are."""
    angles = np.array([0.0, 1e-300, 1e-12, 1e-8, 1e-6, 1e-4, 0.01, 0.0, 0.0])
    given = drawn(rng, (len(angles), 3), y=0.3, yd=0.0, g=0.5, ydd=2.0)
    given["y"][:], given["yd"][:, 0], given["yd"][:, 1] = [0.25, 0.0, 0.0], -0.5, 0.5 * angles
    given["y"][6] = [0.2, -0.1, 0.15]
    given["yd"][6] = -given["y"][6] * (1.0 + 1e-7 * np.arange(3))
    given["y"][7], given["yd"][7], given["yd"][8] = [0.12, 0.0, 0.0], 0.0, 1e-10
    given["g"][7] = given["y"][7]
    ball = np.array([[0.0] * 6 + [0.1, 0.0, 0.0, 0.0]])
    return table(in_space, given, fixed | {"capsules": ball}, False, "straight")


def arms(rng: np.random.Generator, fixed: dict[str, np.ndarray], n: int, name: str, ball: bool) -> dict[str, Table]:
    """Return the tables of an arm with two bodies and obstacles near them, balls or none."""
    frames, prismatic, _ = arm(n, n)
    links, bodies, capsules = np.array([n - 1.0, n]), rng.uniform(-0.3, 0.3, (2, 7)), fixed["capsules"].copy()
    bodies[:, 6], bodies[1, 3:6] = [0.04, 0.0], bodies[1, :3]
    robot = {"frames": frames, "prismatic": prismatic.astype(float), "links": links, "bodies": bodies}
    sizes = {"y": 0.3, "yd": 1.0, "g": 3.0, "ydd": 2.0}
    given = {key: rng.uniform(-1, 1, (6 if n == 3 else 4, n)) * size for key, size in sizes.items()}
    for row, body, link in zip(capsules, bodies, links):  # near the bodies where they are at zero
        T = array(Motion(frames, prismatic, mp.zeros(n, 1)).transform(int(link)))
        row[:3] = np.sum(T[:3, :3] * body[:3], axis=1) + T[:3, 3] + [0.15, -0.1, 0.05]
        row[3:6] = row[:3] + (0.0 if ball else np.array([0.05, 0.1, -0.1]))

    def call(q: Vector, qd: Vector, g: Vector, capsules: np.ndarray) -> list[Contact]:
        return on_arm((frames, prismatic, links, bodies), q, qd, g, capsules)

    return table(call, given, fixed | robot | {"capsules": capsules}, True, name)


def parallel(fixed: dict[str, np.ndarray]) -> dict[str, Table]:
    """Return the table of a bar that turns about its middle, beside one that it is parallel to but for an angle."""
    angles = np.array([0.0, 1e-300, 2e-12, 1e-9, 1e-8, 1e-7, 9e-7, 1.1e-6, 1e-4, 0.01])
    y = np.concatenate([angles, -angles[2:]])[:, None]
    robot = {"frames": np.tile(np.eye(4), (2, 1, 1)), "prismatic": np.zeros(1), "links": np.ones(1)}
    bar = np.array([-0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.01])
    capsules = np.array([[-0.5, 0.06, 0.08, 0.5, 0.06, 0.08, 0.02, 0.0, 0.0, 0.0]])

    def made(q: np.ndarray) -> np.ndarray:
        T, obstacle = Motion(robot["frames"], robot["prismatic"], exact(q)).transform(1), exact(capsules[0])
        ends = [(T * mp.matrix([*exact(bar)[i : i + 3], 1]))[:3] for i in (0, 3)]
        return array([Contact(ends, exact(bar)[6], obstacle).distance])

    fixed = fixed | robot | {"capsules": capsules, "bodies": bar[None]}
    return {"Obstacles parallel distance": {"fixed": fixed, "given": {"y": y}, "wanted": each(made, y)}}


def tables() -> dict[str, Table]:
    """Return all of them."""
    rng = np.random.default_rng(59)
    capsules = rng.uniform(-0.6, 0.6, (3, 10)) * np.array([1] * 6 + [0.1] * 4)
    capsules[:, 6], capsules[1, 3:6] = [0.05, 0.1, 0.0], capsules[1, :3]
    fixed = {"capsules": capsules, "rule": np.array([CLEARANCE, REACH])}
    found = points(rng, fixed) | arms(rng, fixed, 3, "arm", False)
    return found | straight(rng, fixed) | arms(rng, fixed, 5, "rail", True) | parallel(fixed)
