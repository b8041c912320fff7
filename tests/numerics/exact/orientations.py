"""Tables of movement primitives of orientations: whole runs, and runs sample by sample to goals that change.

Steps are those of Runge and Kutta in the chart exp(theta) R, without rounding; rotations are matrices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from filters import SPRINGS, forcing
from mpmath import mp
from primitives import RUN_TAU, phase, runge, shape
from rigid import array, chosen, exact, filled, hat, logarithm, nearest, quaternion, series

Table = dict[str, Any]
Vector = Any
TAUS = np.array([RUN_TAU, 0.5])
OUTPUTS = {"q": slice(0, 4), "w": slice(4, 7), "wd": slice(7, 10)}


class Run:
    """One run of a primitive of orientations."""

    def __init__(self, kind: str, weights: Vector, q0: np.ndarray, w0: np.ndarray) -> None:
        self.kind, self.weights, self.s = kind, weights, mp.zero
        self.alpha, self.stiffness = (mp.mpf(value) for value in SPRINGS[kind])
        self.R, self.q, self.tau = matrix(q0), exact(q0) / mp.norm(exact(q0)), mp.mpf(RUN_TAU)
        self.z = self.tau * exact(w0)

    def change(self, goal: np.ndarray, turn: np.ndarray, tau: float) -> None:
        """Go for a goal, with a map of the forcing and a time constant."""
        self.aim, self.turn = matrix(goal), exact(turn)
        self.z, self.tau = self.z * (mp.mpf(tau) / self.tau), mp.mpf(tau)

    def pull(self, s: Any, R: Vector, z: Vector) -> Vector:
        f = self.turn * forcing(self.kind, phase(self.kind, s), self.weights)
        return self.stiffness * logarithm(nearest(self.aim * R.T)) - self.alpha * z + f

    def slope(self, s: Any, state: Vector) -> Vector:
        theta, z = state[:3, 0], state[3:, 0]
        once = hat(theta) * z
        return mp.matrix([*(z - once / 2 + hat(theta) * once / 12), *self.pull(s, turned(theta, self.R), z)])

    def step(self, dt: Any) -> None:
        r = dt / self.tau
        parts = max(int(mp.ceil(max(self.alpha, mp.sqrt(self.stiffness)) * r)), 1)
        for _ in range(parts):
            state = runge(self.slope, self.s, mp.matrix([0, 0, 0, *self.z]), r / parts)
            self.R, self.z, self.s = turned(state[:3, 0], self.R), state[3:, 0], self.s + r / parts
            q = quaternion(self.R)
            self.q = q if mp.fdot(q, self.q) > 0 else -q  # no step turns by as much as a half turn

    def outputs(self) -> list[Any]:
        """Return quaternion, angular velocity and acceleration."""
        return [*self.q, *(self.z / self.tau), *(self.pull(self.s, self.R, self.z) / self.tau**2)]


def turned(theta: Vector, R: Vector) -> Vector:
    return series(hat(theta)) * R


def matrix(q: np.ndarray) -> Vector:
    """Return the rotation of a quaternion: the exponential of twice its logarithm."""
    w, *v = exact(q) / mp.norm(exact(q))
    length = mp.norm(mp.matrix(v))
    return series(hat(mp.matrix(v) * (2 * mp.atan2(length, w) / length)))


def table(name: str, run: Run, steps: list[Any], given: dict[str, np.ndarray], fixed: dict[str, np.ndarray]) -> Table:
    """Return the tables of a run whose goal, map and time constant change before the fourth step, where others are."""
    goals, turns, taus = given["goals"], given["turns"], given["taus"]
    run.change(goals[0], turns[0], taus[0])
    rows = {}
    for k in chosen(len(steps) + 1, in_order=True):
        if k == 4 and len(goals) > 1:
            run.change(goals[1], turns[1], taus[1])
        if k:
            run.step(steps[k - 1])
        rows[k] = array(run.outputs())
    whole = filled(rows, len(steps) + 1)
    return {
        f"{name} {output}": {"fixed": fixed, "given": given, "wanted": np.ascontiguousarray(whole[None, :, columns])}
        for output, columns in OUTPUTS.items()
    }


def tables() -> dict[str, Table]:
    """Return all of them, for each kind of phase that orientations have."""
    rng, found = np.random.default_rng(31), {}
    q0, goals = np.array([0.8, 0.0, -0.6, 0.0]), np.array([[-0.1, 0.7, 0.1, 0.7], [0.5, -0.1, 0.3, 0.8]])
    for kind in SPRINGS:
        W, w0, turns = rng.normal(size=(5, 3)), rng.normal(size=3), rng.normal(size=(2, 3, 3))
        t, dt = np.cumsum(rng.uniform(1e-3, 0.2, 6)), rng.uniform(1e-3, 0.2, 6)
        fixed, clock = shape(kind, W), exact(t)
        begin = {"q0": q0, "w0": w0}
        given = {"t": t, **begin, "goals": goals[:1], "turns": turns[:1], "taus": TAUS[:1]}
        steps = [clock[k + 1] - clock[k] for k in range(len(t) - 1)]
        found |= table(f"rotation_rollout {kind}", Run(kind, exact(W), q0, w0), steps, given, fixed)
        given = {"dt": dt, **begin, "goals": goals, "turns": turns, "taus": TAUS}
        found |= table(f"RotationStepper {kind}", Run(kind, exact(W), q0, w0), list(exact(dt)), given, fixed)
    return found
