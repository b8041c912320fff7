"""Movement primitives: spring, damper and forcing over a phase.

With time in units of tau, ' = d/d(t/tau), and z = tau yd::

    y' = z,    z' = stiffness (g - y) - alpha z + scale f

    canonical:  x = exp(-decay t/tau),   f = x psi(x) w
    time:       u = pace t/tau,          f = gate(u) psi(u) w,    gate 1 up to u = 1, a quintic step to 0 at 1.1
    periodic:   phi = pace t/tau,        f = psi(phi) w,              psi_j with 2 sin((phi - c_j) / 2) for x - c_j
    position:   p = (g - y) / (g - y0) clipped to [0, 1], coordinate by coordinate,   f = p psi(p) w

psi_j = exp(-(x - c_j)^2 / (2 sd_j^2)) over its sum, as a soft-max: exponents more than FADED below the largest are left
out. A step takes the spring exactly and f as the quadratic through its values at the start, the middle and the end: of
fourth order, stable for any step. Where f depends on the position, it is one Runge-Kutta step, or as many as the spring
requires.

With G the impulse response of the spring and I_k = integral of G(r - s) s^k over the step r,
``stiffness I_k + alpha k I_(k-1) + k (k - 1) I_(k-2) = r^k`` (k = 0: ``- G'``; k = 1: ``- G``), upwards for long steps
and downwards from the series of I_1 and I_2 for short ones, where it would cancel. Steps that are long for the damping
but not for the spring, ``stiffness r < alpha``, are a short step, doubled: the first half evolves freely in the second,
``I_k(2 r) = (1 - stiffness I_0) I_k + G I_k' + sum of (k over j) r^(k - j) I_j``.

One run of a movement primitive, sample by sample.

A goal that has moved is reached at once, or by ``g' = filter (target - g)``, exactly; so is the scale. Where a
coordinate brakes, ``v^2 <= 2 limit |target - y|`` on the way to the new goal, and y stays on the side of it where it
was; it brakes only if that holds already when the goal changes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

PHASES = ("canonical", "time", "position", "periodic")
FADED = 40.0
GATE_WIDTH = 0.1  # of the duration


class SpringStep:
    """Weights of state and forces in one step of length r."""

    def __init__(self, alpha: float, stiffness: float, r: float) -> None:
        r = max(r, 1e-100)  # shorter steps change nothing, and their powers would be 0
        fastest = max(alpha, np.sqrt(stiffness))
        if fastest * r < 1.0 or stiffness * r < alpha:  # what is slow has hardly moved: its moments would cancel
            h, doublings = r, 0
            while fastest * h >= 1.0:
                h, doublings = 0.5 * h, doublings + 1
            first, second = _short_moments(alpha, stiffness, h)
            zeroth = 0.5 * (h * h - stiffness * second) - alpha * first
            G = h - alpha * zeroth - stiffness * first
            slope = 1.0 - alpha * G - stiffness * zeroth
            for _ in range(doublings):  # the first half evolves freely, the second adds its own
                stays = slope + alpha * G + 1.0
                second = stays * second + 2.0 * (G + h) * first + h * h * zeroth
                first = stays * first + (G + h) * zeroth
                zeroth = stays * zeroth + G * G
                slope, G = slope * slope - stiffness * (G * G), G * (2.0 * slope + alpha * G)
                h *= 2.0
        else:
            G, slope = _long_response(alpha, stiffness, r)
            zeroth = (1.0 - slope - alpha * G) / stiffness
            first = (r - alpha * zeroth - G) / stiffness
            second = (r * r - 2.0 * alpha * first - 2.0 * zeroth) / stiffness
        linear, quadratic, rate, curve = first / r, second / r**2, zeroth / r, first / r**2
        self.state = np.array([[slope + alpha * G, G], [-stiffness * G, slope]])
        self.forces = np.array(
            [
                [zeroth - 3 * linear + 2 * quadratic, 4 * (linear - quadratic), 2 * quadratic - linear],
                [G - 3 * rate + 4 * curve, 4 * rate - 8 * curve, 4 * curve - rate],
            ]
        )

    def advance(
        self, y: np.ndarray, z: np.ndarray, g: np.ndarray, *forces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return y and z after the step."""
        d, v = self.state @ np.stack([y - g, z]).reshape(2, -1) + self.forces @ np.stack(forces).reshape(3, -1)
        return g + d.reshape(y.shape), v.reshape(y.shape)


def _short_moments(alpha: float, stiffness: float, r: float) -> tuple[float, float]:
    before, g, power = 0.0, 1.0, r**3 / 6
    first, second = power, 0.0
    for j in range(1, 60):
        term = 2 * power * r / (j + 3) * g
        second += term
        before, g = g, -(alpha * g + stiffness * before)
        power *= r / (j + 3)
        first += power * g
        if abs(term) < 1e-18 * second and abs(power * g) < 1e-18 * first:
            break
    return first, second


def _long_response(alpha: float, stiffness: float, r: float) -> tuple[float, float]:
    sigma = alpha / 2
    square = sigma**2 - stiffness
    mu = np.sqrt(abs(square))
    if mu * r < 1e-3:
        a, decay = square * r**2, np.exp(-sigma * r)
        even, odd = decay * (1 + a / 2 * (1 + a / 12)), decay * r * (1 + a / 6 * (1 + a / 20))
    elif square > 0:
        slow, fast = np.exp((mu - sigma) * r), np.exp(-(mu + sigma) * r)
        even, odd = (slow + fast) / 2, (slow - fast) / (2 * mu)
    else:
        decay = np.exp(-sigma * r)
        even, odd = decay * np.cos(mu * r), decay * np.sin(mu * r) / mu
    return float(odd), float(even - sigma * odd)


class Primitive:
    """Spring, damper and forcing of n coordinates with m kernels."""

    def __init__(
        self,
        centres: Any,
        widths: Any,
        weights: Any,
        alpha: float,
        stiffness: float,
        decay: float,
        pace: float,
        phase: str,
    ) -> None:
        self.centres, self.widths = np.asarray(centres, dtype=float), np.asarray(widths, dtype=float)
        self.weights = np.asarray(weights, dtype=float)
        self.alpha, self.stiffness, self.decay, self.pace, self.phase = alpha, stiffness, decay, pace, phase

    def basis(self, x: Any) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        off = x[..., None] - self.centres
        off = 2.0 * np.sin(0.5 * off) if self.phase == "periodic" else off
        exponents = -(off**2) * (0.5 / self.widths**2)
        exponents -= exponents.max(axis=-1, keepdims=True)
        psi = np.where(exponents < -FADED, 0.0, np.exp(np.maximum(exponents, -FADED)))
        return psi / psi.sum(axis=-1, keepdims=True)

    def forcing(self, x: Any) -> np.ndarray:
        if self.phase == "position":
            x = np.asarray(x, dtype=float)
            f = np.einsum("...ij,ji->...i", self.basis(x), self.weights) * x
        else:
            x = np.asarray(x, dtype=float)
            f = (self.basis(x) @ self.weights) * share(self, x)[..., None]
        return f

    def rollout(
        self, t: Any, tau: float, y0: Any, v0: Any, g: Any, scale: Any, weights: Any = None
    ) -> tuple[np.ndarray, ...]:
        t, y0, v0, g, scale = (np.asarray(a, dtype=float) for a in (t, y0, v0, g, scale))
        runs = []
        for k, begin in enumerate(zip(*(np.atleast_2d(a) for a in (y0, v0, g, scale)))):
            one = PrimitiveStepper(self if weights is None else self._with(weights[k]))
            one.start(*begin, tau)
            runs.append(one.follow(t))
        y, yd, ydd, f = (np.stack(part, axis=1).reshape(len(t), *y0.shape) for part in zip(*runs))
        return y, yd, ydd, phase_at(self, (t - t[0]) / tau), f

    def _with(self, weights: np.ndarray) -> Primitive:
        shape = self.alpha, self.stiffness, self.decay, self.pace, self.phase
        return Primitive(self.centres, self.widths, weights, *shape)

    def response(self, t: Any, tau: float, longest: float) -> tuple[np.ndarray, np.ndarray]:
        t, m = np.asarray(t, dtype=float), len(self.centres)
        y, z, g = np.zeros((3, m + 3))
        y[m], z[m + 1], g[m + 2] = 1.0, tau, 1.0

        Y, Z = [y], [z]
        for k in range(1, len(t)):
            parts = max(int(np.ceil((t[k] - t[k - 1]) / longest)), 1)
            r = (t[k] - t[k - 1]) / parts / tau
            step = SpringStep(self.alpha, self.stiffness, r)
            starts = (t[k - 1] - t[0]) / tau + r * np.arange(parts)
            x = phase_at(self, starts[:, None] + r * np.array([0.0, 0.5, 1.0]))
            forces = np.concatenate([self.basis(x) * share(self, x)[..., None], np.zeros((parts, 3, 3))], axis=-1)
            for three in forces:
                y, z = step.advance(y, z, g, *three)
            Y.append(y)
            Z.append(z)
        return np.array(Y), np.array(Z) / tau


def phase_at(p: Primitive, s: Any) -> np.ndarray:
    """Return the phase after the time s, in units of tau."""
    return np.exp(-p.decay * np.asarray(s)) if p.phase == "canonical" else p.pace * np.asarray(s)


def share(p: Primitive, x: np.ndarray) -> np.ndarray:
    """Return the share of the forcing that remains at phase x."""
    if p.phase == "periodic":
        return np.ones_like(x)
    if p.phase != "time":
        return x
    late = np.clip((x - 1.0) / GATE_WIDTH, 0.0, 1.0)
    return 1.0 - late**3 * (late * (6.0 * late - 15.0) + 10.0)


class PrimitiveStepper:
    """One run of a primitive."""

    def __init__(self, primitive: Primitive, filter: float = 0.0) -> None:
        self.primitive, self.filter = primitive, filter
        self.n = primitive.weights.shape[1]
        self.tau, self.elapsed = 1.0, 0.0
        self.y = self.z = self.y0 = self.g = self.target = self.scale = self.forcing = np.zeros(self.n)
        self._still()

    def _still(self) -> None:
        self.moved: float | None = None
        self.ahead = self.rise = self.limit = self.side = np.zeros(self.n)
        self.braking = np.zeros(self.n, dtype=bool)

    def start(self, y0: Any, v0: Any, g: Any, scale: Any, tau: float) -> None:
        y0, v0, g, scale = (np.asarray(a, dtype=float) for a in (y0, v0, g, scale))
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
        """Return the share of the last change that the filter has not yet passed."""
        return 0.0 if self.moved is None else float(np.exp(-self.filter * (s - self.moved)))

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r = dt / self.tau
        if self.primitive.phase == "position":
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

    def _step_runge(self, h: float) -> None:
        s, y, z = self.elapsed, self.y, self.z
        a = self._slope(s, y, z)
        b = self._slope(s + h / 2, y + h / 2 * a[0], z + h / 2 * a[1])
        c = self._slope(s + h / 2, y + h / 2 * b[0], z + h / 2 * b[1])
        d = self._slope(s + h, y + h * c[0], z + h * c[1])
        self.y = y + h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
        self.z = z + h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
        self.elapsed = s + h
        self.g = self._goal(self.elapsed)
        self.forcing = self._force(self.elapsed, self.y, self.g)

    def _slope(self, s: float, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p, g = self.primitive, self._goal(s)
        return z, p.stiffness * (g - y) - p.alpha * z + self._force(s, y, g)

    def _brake(self) -> None:
        left, v = self.side * (self.target - self.y), self.side * self.z / self.tau
        there = (self.side != 0) & (left <= 0)
        curve = np.sqrt(2 * self.limit * np.maximum(left, 0.0))
        fast = (self.side != 0) & ~there & (v > curve)
        self.y = np.where(there, self.target, self.y)
        self.z = np.where(there & (v > 0), 0.0, np.where(fast, self.side * self.tau * curve, self.z))
        self.braking = there | fast

    def change_goal(self, g: Any, scale: Any, limit: Any = None) -> None:
        g, scale = np.asarray(g, dtype=float), np.asarray(scale, dtype=float)
        limit = np.zeros(self.n) if limit is None else np.asarray(limit, dtype=float)
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
        self.z, self.tau = self.z * (tau / self.tau), tau

    def follow(self, t: Any) -> tuple[np.ndarray, ...]:
        times = np.asarray(t, dtype=float)
        rows = [(*self.outputs(), self.forcing)]
        rows += [(*self.step(dt), self.forcing) for dt in np.diff(times)]
        return tuple(np.array(part) for part in zip(*rows))

    def outputs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        p, yd = self.primitive, self.z / self.tau
        ydd = (p.stiffness * (self.g - self.y) - p.alpha * self.z + self.forcing) / self.tau**2
        return self.y.copy(), yd, np.where(self.braking, np.where(yd == 0, 0.0, -self.side * self.limit), ydd)
