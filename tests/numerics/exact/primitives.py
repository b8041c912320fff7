"""Tables of movement primitives: forcing over the position, runs sample by sample, control.

Exact springs are matrix exponentials, derivatives along a motion are differences; steps of Runge and Kutta are taken as
they are said to be, without rounding: what they leave out of a motion is not in these tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from filters import CENTRES, DECAY, PACE, SPRINGS, WIDTHS, forcing, kernels
from mpmath import mp
from rigid import array, exact, series

Table = dict[str, Any]
SPRING = {**SPRINGS, "position": (25.0, 156.25)}
TAU, SMALL = mp.mpf(0.8), mp.mpf(10) ** -26
Y0, GOAL, SCALE = np.array([0.1, -0.4]), np.array([0.9, -1.1]), np.array([1.3, -0.7])
GAINS, DEAD_ZONE, UNIT = np.array([81.0, 18.0, 30.0, 5.0, 0.3]), np.array([0.01, 0.0]), np.array([0.5, 2.0])
RUN_TAU, FILTER = 0.8, 4.0
Vector = mp.matrix


def phase(kind: str, s: Any) -> Any:
    return mp.exp(-mp.mpf(DECAY) * s) if kind == "canonical" else mp.mpf(PACE) * s


def share(kind: str, x: Any) -> Any:
    """Return what is left of the forcing, by the forcing of ones."""
    return forcing(kind, x, mp.ones(len(CENTRES), 1))[0]


def by_position(y: Vector, start: Vector, goal: Vector, weights: Vector) -> Vector:
    left = [min(max((g - at) / (g - a), mp.zero), mp.one) if g != a else mp.zero for at, a, g in zip(y, start, goal)]
    return mp.matrix([(weights[:, i].T * kernels("position", p))[0] * p for i, p in enumerate(left)])


def times(a: Vector, b: Vector) -> Vector:
    return mp.matrix([x * y for x, y in zip(a, b)])


def runge(slope: Callable[[Any, Vector], Vector], s: Any, y: Vector, h: Any) -> Vector:
    """Return y after the classical step of fourth order."""
    a = slope(s, y)
    b = slope(s + h / 2, y + h / 2 * a)
    c = slope(s + h / 2, y + h / 2 * b)
    return y + h / 6 * (a + 2 * b + 2 * c + slope(s + h, y + h * c))


def spring_step(kind: str, y: Vector, z: Vector, g: Vector, forces: Sequence[Vector], r: Any) -> tuple[Vector, Vector]:
    """Return y and z after a time r under the quadratic through three forces."""
    alpha, stiffness = (mp.mpf(value) for value in SPRING[kind])
    f0, f1, f2 = forces
    linear, curve = (4 * f1 - 3 * f0 - f2) / r, 4 * (f0 - 2 * f1 + f2) / r**2
    A = mp.zeros(5)  # of y - g, z, and what is left of the force and its derivatives
    A[0, 1], A[1, 0], A[1, 1], A[1, 2], A[2, 3], A[3, 4] = 1, -stiffness, -alpha, 1, 1, 1
    after = series(A * r) * mp.matrix([list(y - g), list(z), list(f0), list(linear), list(curve)])
    return after[0, :].T + g, after[1, :].T


def positions(t: np.ndarray, weights: Vector, ends: np.ndarray) -> mp.matrix:
    """Return y, yd, ydd (N, 3 n) where the forcing is that of the position."""
    alpha, stiffness = (mp.mpf(value) for value in SPRING["position"])
    start, v, g, scale = (exact(end) for end in ends)
    n, clock, tau = len(start), exact(t), mp.mpf(RUN_TAU)
    state = mp.matrix([*start, *(tau * v)])

    def slope(_: Any, state: Vector) -> Vector:
        y, z = state[:n, 0], state[n:, 0]
        pull = stiffness * (g - y) - alpha * z + times(scale, by_position(y, start, g, weights))
        return mp.matrix([*z, *pull])

    rows = []
    for k in range(len(t)):
        r = (clock[k] - clock[k - 1]) / tau if k else mp.zero
        parts = max(int(mp.ceil(max(alpha, mp.sqrt(stiffness)) * r)), 1)
        for _ in range(parts if k else 0):
            state = runge(slope, 0, state, r / parts)
        rows.append([*state[:n, 0], *(state[n:, 0] / tau), *(slope(0, state)[n:, 0] / tau**2)])
    return mp.matrix(rows)


def responses(kind: str, t: np.ndarray, longest: float) -> mp.matrix:
    """Return positions, then velocities, of each kernel alone, and of y0, v0 and g: (N, 2 m + 6)."""
    m, clock, tau = len(CENTRES), exact(t), mp.mpf(RUN_TAU)
    y, z, g = (mp.zeros(m + 3, 1) for _ in range(3))
    y[m], z[m + 1], g[m + 2] = 1, tau, 1

    def forces(s: Any) -> Vector:
        x = phase(kind, s)
        return mp.matrix([*(kernels(kind, x) * share(kind, x)), 0, 0, 0])

    rows = [[*y, *(z / tau)]]
    for before, now in pairwise(clock):
        parts = max(int(mp.ceil((now - before) / mp.mpf(longest))), 1)
        r = (now - before) / parts / tau
        for part in range(parts):
            s = (before - clock[0]) / tau + part * r
            y, z = spring_step(kind, y, z, g, [forces(s + r * half / 2) for half in (0, 1, 2)], r)
        rows.append([*y, *(z / tau)])
    return mp.matrix(rows)


class Law:
    """The law of control with two degrees of freedom of `n` coordinates."""

    def __init__(self, kind: str, weights: Vector, speed: Sequence[Any], moved: bool = False) -> None:
        self.kind, self.weights, self.moved, self.n = kind, weights, moved, 2
        self.speed, self.rate = mp.mpf(speed[0]), mp.mpf(speed[1])
        self.y0, self.g, self.scale, self.gains = exact(Y0), exact(GOAL), exact(SCALE), exact(GAINS)
        self.dead_zone, self.unit = exact(DEAD_ZONE), exact(UNIT)

    def slowed(self, e: Vector) -> Any:
        d = [max(abs(x) - zone, 0) / unit for x, zone, unit in zip(e, self.dead_zone, self.unit)]
        return TAU * (1 + self.gains[2] * mp.fsum(x * x for x in d))

    def flow(self, state: Vector, v: Any) -> Vector:
        """Return yc', z', e', ya', and x'."""
        n, (alpha, stiffness) = self.n, (mp.mpf(value) for value in SPRING[self.kind])
        yc, z, e, ya = (state[k * n : (k + 1) * n, 0] for k in range(4))
        x, v = state[5 * n], mp.zero if state[5 * n + 1] else v
        tau = self.slowed(e)
        position = self.kind == "position"
        f = by_position(yc, self.y0, self.g, self.weights) if position else forcing(self.kind, x, self.weights)
        zd = v * (stiffness * (self.g - yc) - alpha * z + times(self.scale, f)) / tau
        xd = v * (mp.mpf(PACE) if self.kind == "time" else -mp.mpf(DECAY) * x) / tau
        return mp.matrix([*(v * z / tau), *zd, *(self.gains[3] * (ya - yc - e)), *state[4 * n : 5 * n, 0], xd])

    def reference(self, state: Vector, v: Any) -> tuple[Vector, Vector, Vector]:
        """Return yc', its derivative along the flow, and ya_ref''."""
        n, flow = self.n, self.flow(state, v)
        rate = mp.zero if state[5 * n + 1] else self.rate
        way = SMALL * mp.matrix([*flow[: 4 * n, 0], *mp.zeros(n, 1), flow[4 * n], 0])
        ends = [self.flow(state + side * way, v + side * SMALL * rate)[:n, 0] for side in (1, -1)]
        curve = (ends[0] - ends[1]) / (2 * SMALL)
        yc, ya, yad = state[:n, 0], state[3 * n : 4 * n, 0], state[4 * n : 5 * n, 0]
        kp, kv = self.gains[0], self.gains[1]
        return flow[:n, 0], curve, kp * (yc - ya) + kv * (flow[:n, 0] - yad) + curve

    def slopes(self, s: Any, state: Vector) -> Vector:
        n, v = self.n, self.speed + self.rate * s
        flow = self.flow(state, v)
        faster = mp.zeros(n, 1) if self.moved else self.reference(state, v)[2]
        return mp.matrix([*flow[: 4 * n, 0], *faster, flow[4 * n], 0])

    def advance(self, state: Vector, dt: Any, count: int) -> Vector:
        for k in range(count):
            state = runge(self.slopes, dt * k / count, state, dt / count)
        return state


def shape(kind: str, weights: np.ndarray) -> dict[str, np.ndarray]:
    rates = np.array([*SPRING[kind], DECAY, PACE])
    return {"centres": CENTRES, "widths": WIDTHS, "weights": weights, "rates": rates}


def runs(rng: np.random.Generator) -> dict[str, Table]:
    """Return the tables of runs over time."""
    t, weights, ends = np.cumsum(rng.uniform(1e-3, 0.2, 7)), rng.normal(size=(5, 2)), rng.normal(size=(6, 2))
    W, found = exact(weights), {}
    whole = array(positions(t, W, ends[:4]))
    for k, name in enumerate(("y", "yd", "ydd")):
        wanted = np.ascontiguousarray(whole[None, :, 2 * k : 2 * k + 2])
        given = {"t": t, "tau": np.array(RUN_TAU), "ends": ends[:4]}
        found[f"rollout position {name}"] = {"fixed": shape("position", weights), "given": given, "wanted": wanted}
    for kind in SPRINGS:
        given = {"t": t[:5], "tau": np.array(RUN_TAU), "longest": np.array(0.11)}
        wanted = array(responses(kind, t[:5], 0.11))
        found[f"response {kind}"] = {"fixed": shape(kind, weights), "given": given, "wanted": wanted[None]}
    x = np.array([-0.1, 0.0, 1e-300, 1e-9, 0.3, 0.99, 1.0, 1.05, 1.2])
    for kind in SPRING:
        call = (
            (lambda v: by_position(mp.matrix([-v, -v]), mp.matrix([-1, -1]), mp.zeros(2, 1), W))
            if kind == "position"
            else (lambda v, kind=kind: forcing(kind, v, W))
        )
        part = np.stack([x, x], axis=-1)[(x >= 0) & (x <= 1)] if kind == "position" else x
        wanted = np.array([array(call(mp.mpf(float(np.ravel(v)[0])))) for v in part])
        found[f"forcing {kind}"] = {"fixed": shape(kind, weights), "given": {"phase": part}, "wanted": wanted}
    return found


def controls(rng: np.random.Generator) -> dict[str, Table]:
    """Return the tables of control with two degrees of freedom."""
    found: dict[str, Table] = {}
    weights = 20 * rng.normal(size=(5, 2))
    for kind in ("canonical", "time", "position"):
        states = rng.normal(size=(6, 12)) * np.array([0.5, 0.5, 1, 1, 0.1, 0.2, 0.5, 0.5, 1, 1, 1, 0])
        states[:, 10], states[1, 11], states[:3, 4:6] = (
            rng.uniform(0, 1.1, 6),
            1.0,
            [[0.001, -1e-9], [0.01, 0], [0, -1e-300]],
        )
        states[3:, 6:8] = states[3:, :2] + [0.01, 0.02]
        speed = np.array([0.4, 0.9, 0.7])
        fixed = shape(kind, weights) | {
            "tau": np.array(float(TAU)), "y0": Y0, "goal": GOAL, "scale": SCALE, "gains": GAINS,
            "dead_zone": DEAD_ZONE, "unit": UNIT,
        }  # fmt: skip
        law = Law(kind, exact(weights), (0.9, 0.7))
        rows = [law.reference(exact(state), law.speed) for state in states]
        wanted = np.concatenate([np.array([array(part) for part in row]) for row in rows])
        given = {"states": states, "speed": speed}
        found[f"TwoDof {kind} reference"] = {"fixed": fixed, "given": given, "wanted": wanted}
        wanted = np.array([array(law.slopes(mp.zero, exact(state))) for state in states])
        found[f"TwoDof {kind} slopes"] = {"fixed": fixed, "given": given, "wanted": wanted}
        wanted = np.array([array([law.slowed(exact(state)[4:6, 0])]) for state in states])
        found[f"TwoDof {kind} time_constant"] = {"fixed": fixed, "given": given, "wanted": wanted}
        for name, driven in (("advance", False), ("driven", True)):
            flow = Law(kind, exact(weights), (mp.mpf(0.4), (mp.mpf(0.9) - mp.mpf(0.4)) / mp.mpf(0.02)), driven)
            wanted = np.array([array(flow.advance(exact(state), mp.mpf(0.02), 2)) for state in states[3:]])
            found[f"TwoDof {kind} {name}"] = {
                "fixed": fixed,
                "given": {"states": states[3:], "speed": speed},
                "wanted": wanted,
            }
    return found


def tables() -> dict[str, Table]:
    """Return all of them."""
    rng = np.random.default_rng(29)
    return runs(rng) | controls(rng)
