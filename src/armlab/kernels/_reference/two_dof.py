"""Two-degree-of-freedom control of a movement primitive (specification; the compiled twin is native/two_dof.cpp).

One phase x and one time constant tau_a for all n coordinates, after Karlsson et al. (IFAC 2017), with the state z
instead of yc', which would be stiff::

    e'  = alpha_e (ya - yc - e),   d = sign(e) max(|e| - dead_zone, 0),   d' = e' where d is not 0, else 0
    tau_a = tau (1 + kc sum (d / unit)^2),   tau_a' = 2 tau kc sum d d' / unit^2
    yc' = v z / tau_a,   z' = v (stiffness (g - yc) - alpha z + scale f) / tau_a
    x'  = -v decay x / tau_a (canonical, position),   v pace / tau_a (time)
    yc'' = (v z' - yc' tau_a') / tau_a + v' z / tau_a
    ya_ref'' = kp (yc - ya) + kv (yc' - ya') + yc''

with the forcing f of `primitive.py`. v is the speed: 1 as the primitive says, 0 for a stop; all rates have it, so the
path stays the same. Where ``max |ya - yc| / unit > e_max`` at the beginning of a step, yc, z and x stand still until it
is below ``0.8 e_max``.

The state is ``[yc, z, e, ya, ya', x, frozen]``. Steps are Runge and Kutta's of fourth order, of all of it at once.
"""

from __future__ import annotations

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import not_negative, positive, read
from armlab.kernels._reference.primitive import Primitive, finite, share

__all__ = ["TwoDof"]

MOST = 32  # coordinates
THAW = 0.8


class TwoDof:
    """The law above for one primitive on its way to one goal.

    Parameters
    ----------
    primitive : spring, basis and weights. tau : its time constant [s].
    y0, g, scale : (n,) start, from which the position phase counts, goal, and factor of the forcing.
    gains : (5,) kp [1/s^2], kv [1/s], kc, alpha_e [1/s], e_max, which may be infinite.
    dead_zone, unit : (n,) of the error e.

    Raises
    ------
    ShapeError : wrong shapes, more than 32 coordinates, or numbers that are not finite or out of their range.
    """

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
        n = self.n = primitive.weights.shape[1]
        if n > MOST:
            raise ShapeError(f"Expected at most {MOST} coordinates, got {n}.")
        self._y0, self._g, self._scale = (
            finite(value, name, (n,)).copy() for value, name in ((y0, "y0"), (g, "g"), (scale, "scale"))
        )
        self._gains = read(gains, "gains", (5,), exact=True).copy()
        self._dead_zone = read(dead_zone, "dead_zone", (n,), exact=True).copy()
        self._unit = read(unit, "unit", (n,), exact=True).copy()
        positive(np.array([tau]), "tau")
        positive(self._unit, "unit")
        not_negative(self._gains[:4], "gains")
        not_negative(self._dead_zone, "dead_zone")
        if not self._gains[4] > 0.0:
            raise ShapeError("Expected e_max above zero, got another number.")

    def advance(self, state: np.ndarray, dt: float, steps: int, driven: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the state (5 n + 2,) after dt seconds.

        Parameters
        ----------
        state : (5 n + 2,). dt : seconds, made in `steps` equal steps, at least one.
        driven : (n,) velocity with which something else moves ya; NaN where ya'' is ya_ref''.
        speed : (3,) v at the beginning and at the end, linear between them, and v' after the end.

        Raises
        ------
        ShapeError : wrong shapes, no step, or a dt that is negative or not finite.
        """
        n = self.n
        y = read(state, "state", (5 * n + 2,), exact=True).copy()
        driven = read(driven, "driven", (n,), exact=True)
        speed = read(speed, "speed", (3,), exact=True)
        if not 0.0 <= dt < np.inf or steps < 1:
            raise ShapeError("Expected a finite dt from 0 in at least one step, got others.")
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
        """Return (3, n) yc', yc'' and ya_ref'' of a state (5 n + 2,), at the end of `speed` (3,).

        Raises
        ------
        ShapeError : wrong shapes.
        """
        y = read(state, "state", (5 * self.n + 2,), exact=True)
        speed = read(speed, "speed", (3,), exact=True)
        return self._law(y, speed[1], speed[2])[:3].copy()

    def slopes(self, state: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the time derivative (5 n + 2,) of a state whose ya'' is ya_ref'', at the end of `speed` (3,).

        Raises
        ------
        ShapeError : wrong shapes.
        """
        y = read(state, "state", (5 * self.n + 2,), exact=True)
        speed = read(speed, "speed", (3,), exact=True)
        return self._rates(y, speed[1], speed[2], np.zeros(self.n, dtype=bool))

    def follow(
        self, state: np.ndarray, dt: float, steps: int, speed: np.ndarray, ya: np.ndarray, yad: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the state dt seconds later, when ya and ya' (n,) are measured, and `reference` of it.

        In between ya moves with the velocity that was measured before. A sample that is not finite is passed over: ya
        goes on as it did.

        Raises
        ------
        ShapeError : as `advance`.
        """
        n = self.n
        y = self.advance(state, dt, steps, np.asarray(state)[4 * n : 5 * n], speed)
        ya, yad = read(ya, "ya", (n,), exact=True), read(yad, "yad", (n,), exact=True)
        if np.isfinite(ya).all() and np.isfinite(yad).all():
            y[3 * n : 4 * n], y[4 * n : 5 * n] = ya, yad
        y[-1] = self._frozen(y)
        return y, self.reference(y, speed)

    def time_constant(self, state: np.ndarray) -> float:
        """Return tau_a [s] of a state (5 n + 2,).

        Raises
        ------
        ShapeError : wrong shape.
        """
        y = read(state, "state", (5 * self.n + 2,), exact=True)
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
