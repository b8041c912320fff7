"""Movement primitives of orientations.

With time in units of tau, ' = d/d(t/tau), and z = tau w, base axes::

    q' = z q / 2,    z' = stiffness e - alpha z + map f,    e = the rotation vector of goal q^-1 on the shorter way

f is the forcing of a primitive of three coordinates; `map` (3, 3) turns and scales it. A step of Runge and Kutta is
taken in the chart exp(theta) q around the orientation at its start, where ::

    theta' = z - theta x z / 2 + theta x (theta x z) / 12

to fourth order in theta, with the forcing at the start, the middle and the end of the step: of fourth order, and on
the group. A step longer than the spring allows is parted.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .primitive import Primitive, phase_at

BACK = np.array([1.0, -1.0, -1.0, -1.0])


class RotationStepper:
    """One run of orientations, sample by sample."""

    def __init__(self, primitive: Primitive) -> None:
        self._primitive, self.tau, self.elapsed = primitive, 1.0, 0.0
        self._q, self._z, self._goal, self._map = BACK * [1, 0, 0, 0], np.zeros(3), BACK * [1, 0, 0, 0], np.eye(3)
        self._f = np.zeros(3)

    def start(self, q0: Any, w0: Any, goal: Any, map: Any, tau: float) -> None:
        """Begin at phase time 0 with orientation (4,), angular velocity (3,), goal (4,) and map (3, 3)."""
        q0, goal = orientation(q0, "q0"), orientation(goal, "goal")
        w0, map = np.asarray(w0, dtype=float), np.asarray(map, dtype=float)
        self._q, self._z, self.tau, self.elapsed = q0, tau * w0, tau, 0.0
        self.change_goal(goal, map)

    def change_goal(self, goal: Any, map: Any) -> None:
        """Go to another goal from now on."""
        self._goal, self._map = orientation(goal, "goal"), np.asarray(map, dtype=float)
        self._f = self._force(self.elapsed)

    def change_tau(self, tau: float) -> None:
        """Go on with another time constant."""
        self._z = (tau / self.tau) * self._z
        self.tau = tau

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by dt and return q, w, wd."""
        r = dt / self.tau
        parts = max(int(np.ceil(max(self._primitive.alpha, np.sqrt(self._primitive.stiffness)) * r)), 1)
        h, begin = r / parts, self.elapsed
        for part in range(1, parts + 1):
            middle, end = self._force(begin + (part - 0.5) * h), self._force(begin + part * h)
            self._advance(h, (self._f, middle, middle, end))
            self._f = end
        self.elapsed = begin + r
        return self.outputs()

    def outputs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, w and wd as they are now."""
        pull = self._primitive.stiffness * self._error(self._q) - self._primitive.alpha * self._z + self._f
        return self._q.copy(), (1.0 / self.tau) * self._z, (1.0 / self.tau**2) * pull

    def _force(self, s: float) -> np.ndarray:
        return self._map @ self._primitive.forcing(phase_at(self._primitive, s))

    def _error(self, q: np.ndarray) -> np.ndarray:
        way = product(self._goal, BACK * q)
        way = -way if way[0] < 0 else way
        length = math.sqrt(way[1:] @ way[1:])
        return (2.0 * math.atan2(length, way[0]) / length if length > 0 else 2.0) * way[1:]

    def _advance(self, h: float, forces: tuple[np.ndarray, ...]) -> None:
        p = self._primitive
        theta, z = np.zeros(3), self._z
        theta_sum, z_sum = theta, self._z
        for stage, (force, weight, reach) in enumerate(
            zip(forces, (h / 6, h / 3, h / 3, h / 6), (h / 2, h / 2, h, 0.0))
        ):
            rate = chart(theta, z) if stage else z
            pull = p.stiffness * self._error(turned(theta, self._q)) - p.alpha * z + force
            theta_sum, z_sum = theta_sum + weight * rate, z_sum + weight * pull
            theta, z = reach * rate, self._z + reach * pull
        self._q, self._z = turned(theta_sum, self._q), z_sum


def rotation_rollout(
    primitive: Primitive, t: Any, tau: float, q0: Any, w0: Any, goal: Any, map: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return orientations q (N, 4), angular velocities and accelerations (N, 3) over times (N,)."""
    stepper, t = RotationStepper(primitive), np.asarray(t, dtype=float)
    stepper.start(q0, w0, goal, map, tau)
    rows = [stepper.outputs(), *(stepper.step(dt) for dt in np.diff(t))]
    q, w, wd = (np.array(part) for part in zip(*rows))
    return q, w, wd


def orientation(value: Any, name: str) -> np.ndarray:
    """Return a quaternion (4,) of length 1."""
    q = np.asarray(value, dtype=float)
    return q / np.linalg.norm(q)


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the product of two quaternions (4,)."""
    a, b, c, d = p.tolist()
    e, f, g, h = q.tolist()
    return np.array(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ]
    )


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors (3,)."""
    x, y, z = a.tolist()
    u, v, w = b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def turned(theta: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return ``exp(theta) q``, of length 1."""
    half = 0.5 * math.sqrt(theta @ theta)
    k = 0.5 * math.sin(half) / half if half > 0 else 0.5
    x, y, z = (k * theta).tolist()
    found = product(np.array([math.cos(half), x, y, z]), q)
    return found / math.sqrt(found @ found)


def chart(theta: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the rate of theta of ``exp(theta) q`` at the angular velocity z."""
    once = cross(theta, z)
    return z - 0.5 * once + cross(theta, once) / 12.0
