"""Movement primitives: spring, damper and forcing over a phase (specification; the twin is native/primitive.cpp).

With time in units of tau, ' = d/d(t/tau), and z = tau yd::

    y' = z,    z' = stiffness (g - y) - alpha z + scale f

    canonical:  x = exp(-decay t/tau),   f = x psi(x) w
    time:       u = pace t/tau,          f = gate(u) psi(u) w,    gate 1 up to u = 1, a quintic step to 0 at 1.1
    periodic:   phi = pace t/tau,        f = psi(phi) w,              psi_j with 2 sin((phi - c_j) / 2) for x - c_j
    position:   p = (g - y) / (g - y0) clipped to [0, 1], coordinate by coordinate,   f = p psi(p) w

psi_j = exp(-(x - c_j)^2 / (2 sd_j^2)) over its sum, as a soft-max: exponents more than FADED below the largest are left
out. A step takes the spring exactly and f as the quadratic through its values at the start, the middle and the end: of
fourth order, stable for any step. Where f depends on the position it is a step of Runge and Kutta, or as many as the
spring asks for.

With G the impulse response of the spring and I_k = integral of G(r - s) s^k over the step r,
``stiffness I_k + alpha k I_(k-1) + k (k - 1) I_(k-2) = r^k`` (k = 0: ``- G'``; k = 1: ``- G``), upwards for long steps
and downwards from the series of I_1 and I_2 for short ones, where it would cancel. Steps that are long for the damping
but not for the spring, ``stiffness r < alpha``, are a short one, doubled: the first half goes on freely in the second,
``I_k(2 r) = (1 - stiffness I_0) I_k + G I_k' + sum of (k over j) r^(k - j) I_j``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import positive, read, result

__all__ = ["Primitive", "SpringStep", "check_steps", "finite", "phase_at", "share"]

PHASES = ("canonical", "time", "position", "periodic")
FADED = 40.0
GATE_WIDTH = 0.1  # of the duration
LONGEST_SPRING = 1e7  # time constants of the spring that a position phase integrates in one call


def finite(value: Any, name: str, tail: tuple[int, ...], exact: bool = True) -> np.ndarray:
    """Return a float64 array of that shape without NaN or Inf.

    Raises
    ------
    ShapeError : another shape or content.
    """
    array = read(value, name, tail, exact=exact)
    wrong = np.flatnonzero(~np.isfinite(array))
    if len(wrong):
        raise ShapeError(f"Expected finite {name}, got NaN or Inf at number {wrong[0]}. Correct it.")
    return array


def check_steps(primitive: Primitive, span: float, tau: float, coupled: bool = False) -> None:
    """Refuse a position phase, or obstacles, over more time constants than can be integrated.

    Raises
    ------
    ShapeError : it is.
    """
    rate = max(primitive.alpha, np.sqrt(primitive.stiffness))
    if (coupled or primitive.phase == "position") and not span / tau * rate < LONGEST_SPRING:
        raise ShapeError("Expected less than 1e7 time constants of the spring, got more. Ask for a shorter motion.")


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
            for _ in range(doublings):  # the first half goes on freely, the second adds its own
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
    """Spring, damper and forcing of n coordinates with m kernels.

    Parameters
    ----------
    centres, widths : (m,) of the kernels; widths are standard deviations. weights : (m, n).
    alpha, stiffness : damping and stiffness of the spring, in units of tau. decay, pace : of the phase.
    phase : "canonical", "time", "position" or "periodic".

    Raises
    ------
    ShapeError : parameters that do not fit together, are not finite or not positive.
    """

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
        m = np.size(centres)
        if m < 1:
            raise ShapeError("Expected at least one kernel, got none.")
        self.centres, self.widths = finite(centres, "centres", (m,)), read(widths, "widths", (m,), exact=True)
        weights = np.asarray(weights, dtype=float)
        if weights.ndim != 2 or len(weights) != m or weights.shape[1] < 1:
            raise ShapeError(f"Expected weights of shape ({m}, n), one row per kernel, got {weights.shape}.")
        self.weights = finite(weights, "weights", weights.shape)
        positive(self.widths, "widths")
        positive(np.array([alpha, stiffness, decay, pace]), "alpha, stiffness, decay and pace")
        if phase not in PHASES:
            raise ShapeError(f"Expected canonical, time, position or periodic as phase, got {phase!r}.")
        self.alpha, self.stiffness, self.decay, self.pace, self.phase = alpha, stiffness, decay, pace, phase

    def basis(self, x: Any, out: Any = None) -> np.ndarray:
        """Return the normalised kernels (..., m) at phases (...)."""
        x = finite(x, "x", (), exact=False)
        off = x[..., None] - self.centres
        off = 2.0 * np.sin(0.5 * off) if self.phase == "periodic" else off
        exponents = -(off**2) * (0.5 / self.widths**2)
        exponents -= exponents.max(axis=-1, keepdims=True)
        psi = np.where(exponents < -FADED, 0.0, np.exp(np.maximum(exponents, -FADED)))
        return result(psi / psi.sum(axis=-1, keepdims=True), out, x=x)

    def design(self, x: Any, factors: Any, rows: int, columns: int) -> np.ndarray:
        """Return zeros (columns, rows) with the kernels at phases (N,), times factors (N,), in their corner [:m, :N].

        Raises
        ------
        ShapeError : other shapes, not finite, less room than that.
        """
        x = finite(x, "x", (np.size(x),))
        factors = finite(factors, "factors", x.shape)
        if rows < len(x) or columns < len(self.centres):
            raise ShapeError("Expected room for every phase and kernel, got too few rows or columns.")
        matrix = np.zeros((columns, rows))
        matrix[: len(self.centres), : len(x)] = (self.basis(x) * factors[:, None]).T
        return matrix

    def forcing(self, x: Any, out: Any = None) -> np.ndarray:
        """Return the forcing (..., n) at phases (...), or (..., n) where every coordinate has its own."""
        if self.phase == "position":
            x = finite(x, "x", (self.weights.shape[1],), exact=False)
            f = np.einsum("...ij,ji->...i", self.basis(x), self.weights) * x
        else:
            x = finite(x, "x", (), exact=False)
            f = (self.basis(x) @ self.weights) * share(self, x)[..., None]
        return result(f, out, x=x)

    def rollout(
        self, t: Any, tau: float, y0: Any, v0: Any, g: Any, scale: Any, weights: Any = None
    ) -> tuple[np.ndarray, ...]:
        """Return y, yd, ydd, x and f over times (N,).

        Parameters
        ----------
        t : (N,) increasing. tau : time constant [s]. y0, v0, g, scale : (n,) or (K, n). weights : (K, m, n) or None.

        Raises
        ------
        ShapeError : arguments that do not fit together or are not finite.
        """
        from armlab.kernels._reference.primitive_stepper import many

        t, n = read_times(t), self.weights.shape[1]
        positive(np.array([tau]), "tau")
        check_steps(self, t[-1] - t[0], tau)
        y0 = finite(y0, "y0", (n,), exact=False)
        if y0.ndim > 2:
            raise ShapeError(f"Expected y0 of shape (n,) or (K, n), got {y0.shape}.")
        v0, g, scale = (finite(a, name, y0.shape) for a, name in ((v0, "v0"), (g, "g"), (scale, "scale")))
        own = weights if weights is None else finite(weights, "weights", (len(np.atleast_2d(y0)), *self.weights.shape))
        x = phase_at(self, (t - t[0]) / tau)
        starts, speeds, goals, scales = (np.atleast_2d(a) for a in (y0, v0, g, scale))
        y, yd, ydd, f = many(self, t, tau, starts, speeds, goals, scales, own)
        y, yd, ydd, f = (a.reshape(len(t), *y0.shape) for a in (y, yd, ydd, f))
        return y, yd, ydd, x, f

    def response(self, t: Any, tau: float, longest: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (N, m + 3) that each kernel alone, then y0, v0 and g, make.

        Parameters
        ----------
        t : (N,) increasing. tau : time constant [s]. longest : of a step [s].

        Raises
        ------
        ShapeError : a position phase, whose response is not linear.
        """
        t, m = read_times(t), len(self.centres)
        positive(np.array([tau, longest]), "tau and longest step")
        if self.phase == "position":
            raise ShapeError(
                "Expected a phase that does not depend on the motion, got 'position': its response is not linear."
            )
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


def read_times(t: Any) -> np.ndarray:
    """Return times (N,) that increase, N at least 1."""
    t = finite(t, "t", (np.size(t),))
    if not len(t):
        raise ShapeError("Expected at least one time, got none.")
    wrong = np.flatnonzero(np.diff(t) <= 0)
    if len(wrong):
        raise ShapeError(
            f"Expected times that increase, got one that does not at row {wrong[0] + 1}. Drop repeated samples."
        )
    return t


def phase_at(p: Primitive, s: Any) -> np.ndarray:
    """Return the phase after the time s, in units of tau."""
    return np.exp(-p.decay * np.asarray(s)) if p.phase == "canonical" else p.pace * np.asarray(s)


def share(p: Primitive, x: np.ndarray) -> np.ndarray:
    """Return the share of the forcing that is left at phase x."""
    if p.phase == "periodic":
        return np.ones_like(x)
    if p.phase != "time":
        return x
    late = np.clip((x - 1.0) / GATE_WIDTH, 0.0, 1.0)
    return 1.0 - late**3 * (late * (6.0 * late - 15.0) + 10.0)
