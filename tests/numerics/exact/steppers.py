"""Tables of movement primitives, sample by sample: goals that change, with a filter or at once, brakes and obstacles.

Exact springs are matrix exponentials; where a step is one of Runge and Kutta by definition, that is taken without
rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from filters import SPRINGS, forcing
from mpmath import mp
from obstacles import CLEARANCE, REACH, REACH_, Contact, added, in_space
from primitives import FILTER, RUN_TAU, SPRING, by_position, phase, runge, shape, spring_step, times
from rigid import array, chosen, exact, filled

Table = dict[str, Any]
Vector = Any
COUPLED_STEP, NEW_TAU = mp.mpf(0.35), 0.5
LIMITS = {"time": np.array([2700.0, 0.0]), "position": np.array([40.0, 60.0])}
RULE = np.array([CLEARANCE, REACH])


class Run:
    """One run of a primitive, from a start to a goal."""

    def __init__(self, kind: str, weights: Vector, lag: float, ends: list[Vector], capsules: np.ndarray | None) -> None:
        self.kind, self.weights, self.lag, self.tau = kind, weights, mp.mpf(lag), mp.mpf(RUN_TAU)
        self.alpha, self.stiffness = (mp.mpf(value) for value in SPRING[kind])
        self.y, v, self.target, self.scale = ends
        self.start, self.z, self.s, self.begin = self.y, self.tau * v, mp.zero, mp.zero
        self.ahead, self.rise = 0 * self.target, 0 * self.target
        self.side, self.limit, self.braking = ([mp.zero] * len(v) for _ in range(3))
        self.capsules = None if capsules is None else [exact(row) for row in capsules]

    def at(self, s: Any, y: Vector) -> tuple[Vector, Vector]:
        """Return the goal and the force there."""
        left = mp.exp(-self.lag * (s - self.begin))
        goal = self.target + self.ahead * left
        if self.kind == "position":
            f = by_position(y, self.start, goal, self.weights)
        else:
            f = forcing(self.kind, phase(self.kind, s), self.weights)
        return goal, times(self.scale + self.rise * left, f)

    def contacts(self, y: Vector, yd: Vector, goal: Vector) -> list[Contact]:
        return in_space(y, yd, goal, self.capsules)

    def bend(self, s: Any, y: Vector, z: Vector) -> Vector:
        """Return the acceleration, with what obstacles add."""
        goal, force = self.at(s, y)
        a = (self.stiffness * (goal - y) - self.alpha * z + force) / self.tau**2
        if self.capsules is None:
            return a
        return added(self.contacts(y, z / self.tau, goal), a, False, False)

    def wait(self, r: Any) -> None:
        for capsule in self.capsules or []:
            moved = r * self.tau * capsule[7:]
            capsule[:3], capsule[3:6] = capsule[:3] + moved, capsule[3:6] + moved

    def spring(self, r: Any) -> None:
        points = [self.at(self.s + r * half / 2, self.y) for half in (0, 1, 2)]
        pulls = [force + self.stiffness * (goal - self.target) for goal, force in points]
        self.y, self.z = spring_step(self.kind, self.y, self.z, self.target, pulls, r)
        self.s += r
        self.wait(r)

    def runge(self, r: Any) -> None:
        n, seen = len(self.y), [self.s]

        def slope(s: Any, state: Vector) -> Vector:  # obstacles are where they are at the time of the slope
            self.wait(s - seen[-1])
            seen.append(s)
            return mp.matrix([*state[n:, 0], *(self.bend(s, state[:n, 0], state[n:, 0]) * self.tau**2)])

        state = runge(slope, self.s, mp.matrix([*self.y, *self.z]), r)
        self.y, self.z, self.s = state[:n, 0], state[n:, 0], self.s + r

    def step(self, dt: Any) -> list[Any]:
        """Advance and return y, yd, ydd."""
        r = dt / self.tau
        stiff = max(self.alpha, mp.sqrt(self.stiffness)) * r
        parts = max(int(mp.ceil(stiff if self.capsules is None else stiff / COUPLED_STEP)), 1)
        if self.capsules is None and self.kind != "position":
            parts = 1
        for _ in range(parts):
            near = self.kind == "position" or (self.capsules is not None and self.acts())
            (self.runge if near else self.spring)(r / parts)
        self.brake()
        bend = self.bend(self.s, self.y, self.z)
        slowed = [
            (mp.zero if z == 0 else -side * limit) if brakes else a
            for z, side, limit, brakes, a in zip(self.z, self.side, self.limit, self.braking, bend)
        ]
        return [*self.y, *(self.z / self.tau), *slowed]

    def acts(self) -> bool:
        return any(c.distance < REACH_ for c in self.contacts(self.y, self.z, self.target))

    def brake(self) -> None:
        """Keep to the speed from which the rest of the way is enough to stop, and to this side of the goal."""
        for i, side in enumerate(self.side):
            left, v = side * (self.target[i] - self.y[i]), side * self.z[i] / self.tau
            curve = mp.sqrt(2 * self.limit[i] * max(left, 0))
            self.braking[i] = side != 0 and (left <= 0 or v > curve)
            if side and left <= 0:
                self.y[i], self.z[i] = self.target[i], min(v, 0) * side * self.tau
            elif self.braking[i]:
                self.z[i] = side * self.tau * curve

    def change(self, goal: Vector, scale: Vector, limit: np.ndarray | None) -> None:
        """Go for another goal with another time constant."""
        now, size = self.at(self.s, self.y)[0], self.scale + self.rise * mp.exp(-self.lag * (self.s - self.begin))
        self.ahead, self.rise = ((now - goal), (size - scale)) if self.lag else (0 * goal, 0 * goal)
        self.target, self.scale, self.begin = goal, scale, self.s
        self.limit = [mp.zero] * len(goal) if limit is None else list(exact(limit))
        for i, way in enumerate(goal - self.y):
            v = self.z[i] / self.tau
            brakes = self.limit[i] > 0 and way * v >= 0 and v**2 <= 2 * self.limit[i] * abs(way)
            self.side[i] = mp.sign(way) * brakes
        self.z, self.tau = self.z * (mp.mpf(NEW_TAU) / self.tau), mp.mpf(NEW_TAU)


def table(kind: str, name: str, given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> dict[str, Table]:
    """Return the tables of a run whose goal, scale and time constant change before the fourth step."""
    *ends, goal, scale = (exact(end) for end in given["ends"])
    run = Run(kind, exact(fixed["weights"]), float(fixed["filter"]), ends, fixed.get("capsules"))
    rows, brakes = [], False
    for k in chosen(len(given["dt"]), in_order=True):
        if k == 3:
            run.change(goal, scale, given.get("limit"))
        rows.append(array(run.step(mp.mpf(float(given["dt"][k])))))
        brakes = brakes or any(run.braking)
    if brakes != ("limit" in given):
        raise ValueError("brakes that do not act, or act without a limit")
    found = {}
    for part, values in zip(("y", "yd", "ydd"), np.split(filled(dict(enumerate(rows)), len(given["dt"])), 3, axis=1)):
        wanted = np.ascontiguousarray(values[None])
        found[f"PrimitiveStepper {kind} {name}{part}"] = {"fixed": fixed, "given": given, "wanted": wanted}
    return found


def tables() -> dict[str, Table]:
    """Return the tables of runs with a filter, of runs that brake, and of one around obstacles that move."""
    rng = np.random.default_rng(73)
    weights, ends, found = rng.normal(size=(5, 2)), rng.normal(size=(6, 2)), {}
    given = {"taus": np.array([RUN_TAU, NEW_TAU]), "ends": ends}
    for kind in (*SPRINGS, "position"):
        fixed = shape(kind, weights) | {"filter": np.array(FILTER)}
        found |= table(kind, "", {"dt": rng.uniform(1e-3, 0.2, 6), **given}, fixed)
    return found | brakes(np.random.default_rng(73)) | around(rng)


def brakes(rng: np.random.Generator) -> dict[str, Table]:
    """Return the tables of goals that come nearer on the way, so that one of two coordinates has to brake, or both."""
    found: dict[str, Table] = {}
    ends = np.array([[0.0, 0.1], [0.2, -0.1], [2.0, -2.1], [0.7, 0.4], [1.2, -1.2], [0.5, 0.3]])
    for kind, limit in LIMITS.items():
        fixed = shape(kind, 10 * rng.normal(size=(5, 2))) | {"filter": np.array(0.0 if kind == "time" else FILTER)}
        dt = np.concatenate([rng.uniform(0.008, 0.012, 3), rng.uniform(1e-3, 0.02, 7), [0.25]])
        given = {"dt": dt, "taus": np.array([RUN_TAU, NEW_TAU]), "ends": ends, "limit": limit}
        found |= table(kind, "brakes ", given, fixed)
    return found


def around(rng: np.random.Generator) -> dict[str, Table]:
    """Return the tables of ways past two obstacles, of which one comes nearer, in the plane."""
    found: dict[str, Table] = {}
    ends = np.array([[0.0, 0.1], [0.2, -0.1], [1.0, -1.1], [0.7, 0.4], [0.9, -0.8], [0.5, 0.3]])
    capsules = np.zeros((2, 10))
    capsules[:, :2], capsules[:, 3:5], capsules[:, 6] = [[0.4, -0.8], [0.9, 0.3]], [[0.4, -0.8], [0.8, 0.0]], 0.05
    capsules[:, 7:9] = [[-0.1, 0.2], [0.0, -0.05]]
    for kind in ("time", "position"):
        fixed = shape(kind, 2 * rng.normal(size=(5, 2))) | {
            "filter": np.array(FILTER),
            "capsules": capsules,
            "rule": RULE,
        }
        dt = np.concatenate([rng.uniform(5e-3, 0.04, 7), [0.3]])
        found |= table(kind, "around ", {"dt": dt, "taus": np.array([RUN_TAU, NEW_TAU]), "ends": ends}, fixed)
    return found
