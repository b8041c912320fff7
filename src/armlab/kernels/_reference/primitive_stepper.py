"""One run of a movement primitive, sample by sample (specification; the twin is native/primitive_stepper.cpp).

A goal that has moved is reached at once, or by ``g' = filter (target - g)``, exactly; so is the scale. Where a
coordinate brakes, ``v^2 <= 2 limit |target - y|`` on the way to the new goal, and y stays on the side of it where it
was; it brakes only if that holds already when the goal changes. Obstacles within reach add to the acceleration; then a
step is by Runge and Kutta, and 0.35 time constants of the spring at most.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import not_negative, positive
from armlab.kernels._reference.obstacles import Obstacles
from armlab.kernels._reference.primitive import Primitive, SpringStep, check_steps, finite, phase_at, read_times, share

__all__ = ["PrimitiveStepper", "many"]

COUPLED_STEP = 0.35  # time constants of the spring


class PrimitiveStepper:
    """One run of a primitive.

    Parameters
    ----------
    primitive : what runs. filter : rate of the goal filter times tau; 0: the goal changes at once.
    around : what it goes around, and moves on.
    """

    def __init__(self, primitive: Primitive, filter: float = 0.0, around: Obstacles | None = None) -> None:
        not_negative(np.array([filter]), "filter")
        self.primitive, self.filter, self._around = primitive, filter, around
        self.n = primitive.weights.shape[1]
        if around is not None and around.n != self.n:
            raise ShapeError(f"Expected obstacles for {self.n} coordinates, got {around.n}.")
        self.tau, self.elapsed = 1.0, 0.0
        self.y = self.z = self.y0 = self.g = self.target = self.scale = self.forcing = np.zeros(self.n)
        self._still()

    def _still(self) -> None:
        self.moved: float | None = None
        self.ahead = self.rise = self.limit = self.side = np.zeros(self.n)
        self.braking = np.zeros(self.n, dtype=bool)

    def start(self, y0: Any, v0: Any, g: Any, scale: Any, tau: float) -> None:
        """Begin at phase time 0.

        Parameters
        ----------
        y0, v0, g, scale : (n,). tau : time constant [s].
        """
        y0, v0, g, scale = (
            finite(a, name, (self.n,)) for a, name in ((y0, "y0"), (v0, "v0"), (g, "g"), (scale, "scale"))
        )
        positive(np.array([tau]), "tau")
        self.y = self.y0 = y0.copy()
        self.g = self.target = g.copy()
        self.z, self.scale, self.tau, self.elapsed = tau * v0, scale.copy(), tau, 0.0
        self._still()
        self.forcing = self._force(0.0, self.y, self.g)

    def _force(self, s: float, y: np.ndarray, g: np.ndarray) -> np.ndarray:
        x = phase_at(self.primitive, s)
        if self.primitive.phase == "position":
            way = g - self.y0
            x = np.where(way == 0, 0.0, np.clip((g - y) / np.where(way == 0, 1.0, way), 0.0, 1.0))
        return (self.scale + self.rise * self._left(s)) * self.primitive.forcing(x)

    def _goal(self, s: float) -> np.ndarray:
        return self.g if self.moved is None else self.target + self.ahead * self._left(s)

    def _left(self, s: float) -> float:
        """Return the share of the last change that the filter has not let through yet."""
        return 0.0 if self.moved is None else float(np.exp(-self.filter * (s - self.moved)))

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by dt and return y, yd, ydd.

        Parameters
        ----------
        dt : above zero [s].
        """
        positive(np.array([dt]), "dt")
        check_steps(self.primitive, dt, self.tau, self._around is not None)
        r = dt / self.tau
        if self._around is not None:
            self._step_coupled(r, self._around)
        elif self.primitive.phase == "position":
            self._step_position(r)
        else:
            self._step_spring(r)
        self._brake()
        return self.outputs()

    def _step_spring(self, r: float) -> None:
        p, times = self.primitive, self.elapsed + r * np.array([0.0, 0.5, 1.0])
        forces = [self.forcing, *(self._force(s, self.y, self.g) for s in times[1:])]
        pulls = [f + p.stiffness * (self._goal(s) - self.target) for f, s in zip(forces, times)]
        step = SpringStep(p.alpha, p.stiffness, r)
        self.y, self.z = step.advance(self.y, self.z, self.target, *pulls)
        self.g, self.elapsed, self.forcing = self._goal(times[2]), times[2], forces[2]

    def _step_position(self, r: float) -> None:
        p = self.primitive
        parts = max(int(np.ceil(max(p.alpha, np.sqrt(p.stiffness)) * r)), 1)
        for _ in range(parts):
            self._step_runge(r / parts)

    def _step_coupled(self, r: float, around: Obstacles) -> None:
        p = self.primitive
        parts = max(int(np.ceil(max(p.alpha, np.sqrt(p.stiffness)) * r / COUPLED_STEP)), 1)
        h = r / parts
        for _ in range(parts):
            if p.phase == "position" or around.acts(self.y):
                self._step_runge(h)
            else:
                self._step_spring(h)
                around.advance(h * self.tau)

    def _step_runge(self, h: float) -> None:
        s, y, z = self.elapsed, self.y, self.z
        a = self._slope(s, y, z)
        self._wait(h / 2)
        b = self._slope(s + h / 2, y + h / 2 * a[0], z + h / 2 * a[1])
        c = self._slope(s + h / 2, y + h / 2 * b[0], z + h / 2 * b[1])
        self._wait(h / 2)
        d = self._slope(s + h, y + h * c[0], z + h * c[1])
        self.y = y + h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
        self.z = z + h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
        self.elapsed = s + h
        self.g = self._goal(self.elapsed)
        self.forcing = self._force(self.elapsed, self.y, self.g)

    def _slope(self, s: float, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p, g, square = self.primitive, self._goal(s), self.tau**2
        a = p.stiffness * (g - y) - p.alpha * z + self._force(s, y, g)
        return z, a if self._around is None else square * self._around.add(y, z / self.tau, g, a / square)

    def _wait(self, r: float) -> None:
        if self._around is not None:
            self._around.advance(r * self.tau)

    def _brake(self) -> None:
        left, v = self.side * (self.target - self.y), self.side * self.z / self.tau
        there = (self.side != 0) & (left <= 0)
        curve = np.sqrt(2 * self.limit * np.maximum(left, 0.0))
        fast = (self.side != 0) & ~there & (v > curve)
        self.y = np.where(there, self.target, self.y)
        self.z = np.where(there & (v > 0), 0.0, np.where(fast, self.side * self.tau * curve, self.z))
        self.braking = there | fast

    def change_goal(self, g: Any, scale: Any, limit: Any = None) -> None:
        """Go for another goal from now on.

        Parameters
        ----------
        g, scale : (n,). limit : (n,) largest deceleration of the brake, 0 where there is none; None without brakes.
        """
        g, scale = finite(g, "g", (self.n,)), finite(scale, "scale", (self.n,))
        limit = np.zeros(self.n) if limit is None else finite(limit, "limit", (self.n,))
        not_negative(limit, "limit")
        now = self.scale + self.rise * self._left(self.elapsed)
        self.rise = now - scale if self.filter else np.zeros(self.n)
        self.scale, self.target = scale.copy(), g.copy()
        self.g = self.g if self.filter else g.copy()
        self.ahead, self.moved = self.g - g, self.elapsed if self.filter else None
        way, v = g - self.y, self.z / self.tau
        brakes = (limit > 0) & (way * v >= 0) & (way != 0) & (v**2 <= 2 * limit * abs(way))
        self.side, self.limit = np.where(brakes, np.sign(way), 0.0), limit
        self.braking = np.zeros(self.n, dtype=bool)
        self.forcing = self._force(self.elapsed, self.y, self.g)

    def change_tau(self, tau: float) -> None:
        """Go on with another time constant.

        Parameters
        ----------
        tau : above zero [s].
        """
        positive(np.array([tau]), "tau")
        self.z, self.tau = self.z * (tau / self.tau), tau

    def follow(self, t: Any) -> tuple[np.ndarray, ...]:
        """Return y, yd, ydd and the forcing over times, each (N, n).

        Parameters
        ----------
        t : (N,) times, the first of which is now [s].
        """
        times = read_times(t)
        check_steps(self.primitive, times[-1] - times[0], self.tau, self._around is not None)
        rows = [(*self.outputs(), self.forcing)]
        rows += [(*self.step(dt), self.forcing) for dt in np.diff(times)]
        return tuple(np.array(part) for part in zip(*rows))

    def outputs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return y, yd, ydd as they are now."""
        p, yd = self.primitive, self.z / self.tau
        ydd = (p.stiffness * (self.g - self.y) - p.alpha * self.z + self.forcing) / self.tau**2
        if self._around is not None:
            ydd = self._around.add(self.y, yd, self.g, ydd)
        return self.y.copy(), yd, np.where(self.braking, np.where(yd == 0, 0.0, -self.side * self.limit), ydd)


def many(
    p: Primitive,
    t: np.ndarray,
    tau: float,
    y0: np.ndarray,
    v0: np.ndarray,
    g: np.ndarray,
    scale: np.ndarray,
    weights: np.ndarray | None,
) -> tuple[np.ndarray, ...]:
    """Run K primitives over one clock: y, yd, ydd and f, each (N, K, n)."""
    if p.phase == "position":
        return _one_by_one(p, t, tau, y0, v0, g, scale, weights)
    half = np.empty(2 * len(t) - 1)
    half[::2], half[1::2] = t, 0.5 * (t[:-1] + t[1:])
    x = phase_at(p, (half - t[0]) / tau)
    psi = p.basis(x) * share(p, x)[:, None]
    forces = scale * (
        (psi @ p.weights)[:, None] if weights is None else np.einsum("tm,kmn->tkn", psi, weights, optimize=True)
    )
    y, z = y0, tau * v0
    rows = [(y, z)]
    for k in range(1, len(t)):
        step = SpringStep(p.alpha, p.stiffness, (t[k] - t[k - 1]) / tau)
        y, z = step.advance(y, z, g, *forces[2 * k - 2 : 2 * k + 1])
        rows.append((y, z))
    Y, Z = np.stack(rows, axis=1)
    f = forces[::2]
    return Y, Z / tau, (p.stiffness * (g - Y) - p.alpha * Z + f) / tau**2, f


def _one_by_one(
    p: Primitive,
    t: np.ndarray,
    tau: float,
    y0: np.ndarray,
    v0: np.ndarray,
    g: np.ndarray,
    scale: np.ndarray,
    weights: np.ndarray | None,
) -> tuple[np.ndarray, ...]:
    runs = []
    for k in range(len(y0)):
        own = p.weights if weights is None else weights[k]
        one = PrimitiveStepper(Primitive(p.centres, p.widths, own, p.alpha, p.stiffness, p.decay, p.pace, p.phase))
        one.start(y0[k], v0[k], g[k], scale[k], tau)
        rows = [(*one.outputs(), one.forcing)]
        rows += [(*one.step(dt), one.forcing) for dt in np.diff(t)]
        runs.append(np.array(rows))
    return tuple(np.array(runs).transpose(2, 1, 0, 3))
