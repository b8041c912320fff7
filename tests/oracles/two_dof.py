"""Two-degree-of-freedom control of a movement primitive.

One phase x and one time constant tau_a for all n coordinates, after Karlsson et al. (IFAC 2017), with the state z
instead of yc', which would be stiff::

    e'  = alpha_e (ya - yc - e),   d = sign(e) max(|e| - dead_zone, 0),   d' = e' where d is not 0, else 0
    tau_a = tau (1 + kc sum (d / unit)^2),   tau_a' = 2 tau kc sum d d' / unit^2
    yc' = v z / tau_a,   z' = v (stiffness (g - yc) - alpha z + scale f) / tau_a
    x'  = -v decay x / tau_a (canonical, position),   v pace / tau_a (time)
    yc'' = (v z' - yc' tau_a') / tau_a + v' z / tau_a
    ya_ref'' = kp (yc - ya) + kv (yc' - ya') + yc''

with the forcing f of `primitive.py`. v is the speed: 1 as the primitive says, 0 for a stop; it scales all rates, so
the path stays the same. Where ``max |ya - yc| / unit > e_max`` at the beginning of a step, yc, z and x stand still
until it is below ``0.8 e_max``.

The state is ``[yc, z, e, ya, ya', x, frozen]``. All states are integrated jointly by RK4.
"""

from __future__ import annotations

import numpy as np

from .primitive import Primitive, share

MOST = 32  # coordinates
THAW = 0.8


class TwoDof:
    """The law above for one primitive on its way to one goal."""

    def __init__(
        self,
        primitive: Primitive,
        tau: float,
        y0: np.ndarray,
        g: np.ndarray,
        scale: np.ndarray,
        gains: np.ndarray,
        dead_zone: np.ndarray,
        unit: np.ndarray,
    ) -> None:
        self._primitive, self._tau = primitive, tau
        self.n = primitive.weights.shape[1]
        self._y0, self._g, self._scale = (np.array(value, dtype=float) for value in (y0, g, scale))
        self._gains = np.array(gains, dtype=float)
        self._dead_zone = np.array(dead_zone, dtype=float)
        self._unit = np.array(unit, dtype=float)

    def advance(self, state: np.ndarray, dt: float, steps: int, driven: np.ndarray, speed: np.ndarray) -> np.ndarray:
        n = self.n
        y = np.array(state, dtype=float)
        driven = np.asarray(driven, dtype=float)
        speed = np.asarray(speed, dtype=float)
        moved = np.isfinite(driven)
        y[4 * n : 5 * n] = np.where(moved, driven, y[4 * n : 5 * n])
        if dt == 0.0:
            y[-1] = self._frozen(y)
            return y
        h, rate = dt / steps, (speed[1] - speed[0]) / dt
        for k in range(steps):
            y[-1] = self._frozen(y)
            start = speed[0] + rate * (k * h)
            k1 = self._rates(y, start, rate, moved)
            k2 = self._rates(y + 0.5 * h * k1, start + 0.5 * h * rate, rate, moved)
            k3 = self._rates(y + 0.5 * h * k2, start + 0.5 * h * rate, rate, moved)
            k4 = self._rates(y + h * k3, start + h * rate, rate, moved)
            y = y + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
        return y

    def reference(self, state: np.ndarray, speed: np.ndarray) -> np.ndarray:
        y = np.asarray(state, dtype=float)
        speed = np.asarray(speed, dtype=float)
        return self._law(y, speed[1], speed[2])[:3].copy()

    def slopes(self, state: np.ndarray, speed: np.ndarray) -> np.ndarray:
        y = np.asarray(state, dtype=float)
        speed = np.asarray(speed, dtype=float)
        return self._rates(y, speed[1], speed[2], np.zeros(self.n, dtype=bool))

    def follow(
        self, state: np.ndarray, dt: float, steps: int, speed: np.ndarray, ya: np.ndarray, yad: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        n = self.n
        y = self.advance(state, dt, steps, np.asarray(state)[4 * n : 5 * n], speed)
        ya, yad = np.asarray(ya, dtype=float), np.asarray(yad, dtype=float)
        if np.isfinite(ya).all() and np.isfinite(yad).all():
            y[3 * n : 4 * n], y[4 * n : 5 * n] = ya, yad
        y[-1] = self._frozen(y)
        return y, self.reference(y, speed)

    def time_constant(self, state: np.ndarray) -> float:
        y = np.asarray(state, dtype=float)
        return float(self._slowed(y[2 * self.n : 3 * self.n])[0])

    def _frozen(self, y: np.ndarray) -> float:
        n, e_max = self.n, self._gains[4]
        worst = np.max(np.abs(y[3 * n : 4 * n] - y[:n]) / self._unit)
        return 1.0 if worst > (THAW * e_max if y[-1] else e_max) else 0.0

    def _slowed(self, e: np.ndarray) -> tuple[float, np.ndarray]:
        """Return tau_a and d / unit^2."""
        d = np.sign(e) * np.maximum(np.abs(e) - self._dead_zone, 0.0)
        weighted = d / self._unit**2
        return self._tau * (1.0 + self._gains[2] * float(d @ weighted)), weighted

    def _law(self, y: np.ndarray, v: float, rate: float) -> np.ndarray:
        """Return yc', yc'', ya_ref'', z', e', and x' in every column: (6, n)."""
        n = self.n
        yc, z, e, ya, yad, x = *y[: 5 * n].reshape(5, n), y[-2]
        p, tau = self._primitive, self._tau
        kp, kv, kc, alpha_e, _ = self._gains
        if y[-1]:
            v = rate = 0.0
        tau_a, weighted = self._slowed(e)
        ed = alpha_e * (ya - yc - e)
        tau_ad = 2.0 * tau * kc * float(weighted @ ed)
        ycd = v * z / tau_a
        zd = v * (p.stiffness * (self._g - yc) - p.alpha * z + self._scale * self._forcing(x, yc)) / tau_a
        ycdd = (v * zd - ycd * tau_ad + rate * z) / tau_a
        xd = v * (p.pace if p.phase == "time" else -p.decay * x) / tau_a
        return np.array([ycd, ycdd, kp * (yc - ya) + kv * (ycd - yad) + ycdd, zd, ed, np.full(n, xd)])

    def _rates(self, y: np.ndarray, v: float, rate: float, moved: np.ndarray) -> np.ndarray:
        ycd, _, yadd, zd, ed, xd = self._law(y, v, rate)
        yad = y[4 * self.n : 5 * self.n]
        return np.concatenate((ycd, zd, ed, yad, np.where(moved, 0.0, yadd), xd[:1], [0.0]))

    def _forcing(self, x: float, yc: np.ndarray) -> np.ndarray:
        p = self._primitive
        if p.phase != "position":
            return (p.basis(x) @ p.weights) * share(p, np.asarray(x))
        way = self._g - self._y0
        left = np.clip(np.where(way == 0.0, 0.0, (self._g - yc) / np.where(way == 0.0, 1.0, way)), 0.0, 1.0)
        return np.einsum("ij,ji->i", p.basis(left), p.weights) * left
