"""One step of the momentum filter.

State [p; z]: the momentum p (n,) and m hidden inputs z, each a random walk with leak ``dz/dt = -a z + w``, w of
intensity q. Between samples ``dp/dt = u + G z + w_p``, w_p of intensity Qp. The matrix [[0, G], [0, -diag(a)]] has an
exponential, and the noise of a step (Van Loan 1978), in closed form; with ``phi(s) = (1 - e^(-a s))/a``

    Phi = [[I, G diag(phi(h))], [0, diag(e^(-a h))]]
    Qzz = diag(q int e^(-2 a s)),  Qpz = G diag(q phi(h)^2 / 2),  Qpp = diag(Qp) h + G diag(q int phi^2) G^T

then an update with the measured momentum y = p + v, v ~ N(0, R), in Joseph's form.

Contact wrench by the generalised momentum.

With p = M qd and beta = C^T qd the arm obeys ``dp/dt = u + J^T F``, ``u = x + beta - G``, with x of ``x + load s |x| =
tau / gains - F_f``: no acceleration is needed (De Luca and Mattone 2003; Wahrburg et al., IEEE T-ASE 15(2), 2018), so
what the rotor takes counts as load. u is the mean of its values at the ends of a step (at the first, its end: friction
is unknown at the beginning). A step longer than GAP_STEPS first steps is a gap: u and the motion during it are unknown,
so momentum and friction are reset after it. Unknown gains add to the covariance as in `estimator.py`.

Observer: ``r <- r + (1 - e^(-K h)) ((p - p_before) / h - u - r)`` is J^T F through a low-pass, stable for any step;
then the most probable wrench, as in `estimator.py`, with C_tau = diag(s^2(qd) + (doubt r)^2 + static^2 p_filtered).
For a wrench present at the start, r is only the share ``1 - e^(-K t)`` of J^T F.

Kalman filter: state [p; z; b], z the wrench in units of its prior, a random walk with leak; the measurement is p = M qd
with velocity noise, R = M diag(qd_noise^2) M^T; J is taken in the middle of the step. The torque error has the variance
v = s^2 + (doubt J^T z)^2 + static^2 p: the velocity-dependent error, forgotten within `memory`; the uncertainty of the
wrench's own torque from gains and load friction; and unknown friction after a rest, static and p as in
`estimator.py`. The last two persist and must not be averaged away: noise of intensity ``v^2 / (J^T rate J)_ii`` leaves
the wrench the doubt v. The noise has this intensity or ``2 s^2 memory + (v - s^2) LONGEST``, whichever is smaller. When
biased, friction is a state b instead, which enters with -1: its variance rises at rest as p does, up to static^2, and
it decays with displacement like the presliding state, ``db = -b |dq| / delta``; at rest it stays, except for CREEP.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .chain import Chain
from .drive import Drive, DriveState, drive_torque, heat, load_of, move, restart, start
from .estimator import (
    GAP_STEPS,
    LARGEST,
    REST_TIME,
    SETTLING,
    TARED,
    WEAK,
    WEAK_BELOW,
    Stepwise,
    contact_map,
    parameter_variance,
    speed_variance,
)
from .wrench import solve_wrench

SERIES_BELOW = 1.0  # of a h: there the closed form of int phi^2 loses digits


def leak_integrals(a: np.ndarray, h: float) -> tuple[np.ndarray, ...]:
    """Return e^(-a h), phi(h), int e^(-2 a s), int phi e^(-a s), int phi^2 over 0 ... h for leaks a (m,) >= 0."""
    x = a * h
    decay = np.exp(-x)
    safe = np.where(x > 0, a, 1.0)
    phi = np.where(x > 0, -np.expm1(-x) / safe, h)
    twice = np.where(x > 0, -np.expm1(-2.0 * x) / (2.0 * safe), h)
    near, series, term = np.minimum(x, SERIES_BELOW), np.zeros(np.shape(x)), np.full(np.shape(x), 1 / 6)
    for k in range(20):
        series, term = series + term * (2.0 ** (k + 2) - 2.0), term * -near / (k + 4)
    far = np.where(x > SERIES_BELOW, a, 1.0)
    return decay, phi, twice, 0.5 * phi**2, np.where(x > SERIES_BELOW, (h - 2.0 * phi + twice) / far**2, h**3 * series)


def momentum_step(
    x: np.ndarray,
    P: np.ndarray,
    G: np.ndarray,
    u: np.ndarray,
    y: np.ndarray,
    R: np.ndarray,
    h: float,
    Qp: np.ndarray,
    q: np.ndarray,
    a: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    G = np.asarray(G, dtype=float)
    n, m = G.shape
    x, P = np.asarray(x, dtype=float), np.asarray(P, dtype=float)
    u, y, Qp = (np.asarray(a, dtype=float) for a in (u, y, Qp))
    R, q, a = np.asarray(R, dtype=float), np.asarray(q, dtype=float), np.asarray(a, dtype=float)
    decay, phi, zz, pz, pp = leak_integrals(a, h)
    Phi = np.block([[np.eye(n), G * phi], [np.zeros((m, n)), np.diag(decay)]])
    noise = np.block([[np.diag(Qp * h) + (G * (q * pp)) @ G.T, G * (q * pz)], [(G * (q * pz)).T, np.diag(q * zz)]])
    x = Phi @ x
    x[:n] += h * u
    P = Phi @ P @ Phi.T + noise
    K = np.linalg.solve(P[:n, :n] + R, P[:n]).T
    A = np.eye(n + m)
    A[:, :n] -= K
    P = A @ P @ A.T + K @ R @ K.T
    return x + K @ (y - x[:n]), 0.5 * (P + P.T)


CREEP = 1e-3  # 1/s, growth of the variance of friction at rest, as a share of its prior
LONGEST = 20.0  # s, memory of friction at rest for a joint that no contact turns
AT_REST = 0.5  # variance of the presliding state above which a joint rests
STILL = 1.0  # presliding distances that a joint may move before a tare is void


class MomentumEstimator(Stepwise):
    """Momentum-based contact wrench from joint motion and torque, one sample at a time."""

    def __init__(
        self, chain: Chain, gravity: Any, links: Any, rotor: Any, drive: Drive, gains: Any, gain_variance: float,
        covariance: Any, prior: Any, memory: Any, qd_noise: Any, rate: Any, leak: Any, gain: float,
        filters: bool, biased: bool, point: Any = None, doubt_columns: Any = None, doubt_cov: Any = None,
        doubt_mean: Any = None,
    ) -> None:  # fmt: skip
        self._doubt = None if doubt_columns is None else (doubt_columns, doubt_cov, doubt_mean)
        arrays = (np.array(a, dtype=float) for a in (memory, qd_noise, rate, leak))
        self._memory, self._qd_noise, self._rate, self._leak = arrays
        self._gain, self._filters, self._biased = gain, filters, biased
        self._k = 6 if point is None else 3
        super().__init__(chain, gravity, links, rotor, drive, gains, gain_variance, covariance, prior, point)

    def reset(self) -> None:
        n = self._chain.n
        self._state: DriveState = start(self._drive, np.zeros(n))
        self._unsure, self._q, self._known, self._p = np.ones(n), np.zeros(n), np.zeros(n), np.zeros(n)
        self._r, self._low, self._seen = np.zeros(n), np.ones(n), 0.0
        self._since_tare, self._tared = np.zeros(n), False
        self._nominal, self._started, self._fresh = 0.0, False, False
        self._qd, self._qdd = np.zeros(n), np.zeros(n)

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> tuple[Any, ...]:
        n = self._chain.n
        q, qd, tau = (np.asarray(a, dtype=float) for a in (q, qd, tau))
        if not (np.isfinite(q).all() and np.isfinite(qd).all() and np.isfinite(tau).all() and 0.0 < dt < np.inf):
            return self._invalid()
        first = not self._started
        apart = first or dt > GAP_STEPS * self._nominal
        before = restart(q, self._state) if apart else self._state
        rise = (1.0 - self._unsure) * (1.0 - np.exp(-dt / REST_TIME))
        with np.errstate(over="ignore", invalid="ignore"):
            p, beta = self._chain.momentum(q, qd, self._links)
            p = p + self._rotor * qd
            state, dy = move(self._drive, q, before)
            gravity = self._chain.rnea(q, 0 * q, 0 * q, self._gravity, self._links)
            load = load_of(self._drive, tau / self._gains - drive_torque(self._drive, q, qd, state), qd, state)
            u = load + beta - gravity
        if not (np.all(np.abs(u) < LARGEST) and np.all(np.abs(p) < LARGEST)):
            return self._invalid()
        moved = np.abs(dy) / self._drive.friction[6]
        rest = self._static + self._drive.friction[10] * np.abs(load)
        known = u if apart or self._fresh else 0.5 * (u + self._known)
        middle = q if apart else 0.5 * (q + self._q)
        change, self._p = p - self._p, p
        share = -np.expm1(-SETTLING * dt)
        self._qdd = np.zeros(n) if apart else self._qdd + share * ((qd - self._qd) / dt - self._qdd)
        self._qd = qd.copy()
        unknown = parameter_variance(
            self._doubt, self._chain, self._gravity, self._drive, q, qd, self._qdd, load, state
        )
        self._state, self._q, self._known = heat(self._drive, qd, dt, state), q.copy(), u
        self._unsure = np.ones(n) if apart else (self._unsure + rise) * np.exp(-2.0 * moved)
        if self._filters:
            found = self._filter(first, apart, q, qd, middle, known, dt, moved, rise, rest, unknown)
        else:
            found = self._observe(apart, q, qd, change / dt - known, dt, rest, unknown)
        self._nominal, self._started = dt if first else self._nominal, True
        self._fresh = apart
        self._since_tare = np.full(n, np.inf) if apart else self._since_tare + moved
        self._tared = self._tared and bool(np.all(self._since_tare <= STILL))
        return self._tell(q, *found)

    def tare(self) -> bool:
        if not (self._started and self._filters and self._biased and np.all(self._unsure > AT_REST)):
            return False
        z = slice(self._chain.n, self._chain.n + self._k)
        gain = np.linalg.solve(self._P[z, z], self._P[z]).T
        self._x = self._x - gain @ self._x[z]
        P = self._P - gain @ self._P[z]
        self._x[z] = P[z] = P[:, z] = 0.0
        self._P = 0.5 * (P + P.T)
        self._since_tare, self._tared = np.zeros(self._chain.n), True
        return True

    def _tell(
        self, q: np.ndarray, x: np.ndarray, P: np.ndarray, error: np.ndarray, variance: np.ndarray
    ) -> tuple[Any, ...]:
        S = contact_map(self._chain, q, self._point)
        C = np.diag((S * self._prior[: self._k]) @ S.T)
        F, P = S @ x, S @ P @ S.T
        observability = np.fmax(1.0 - np.divide(np.diag(P), C, out=np.zeros(6), where=C > 0), 0.0)
        flags = (WEAK if np.any(observability < WEAK_BELOW) else 0) | (TARED if self._tared else 0)
        P = P + self._gain_variance * np.outer(F, F)
        return F, P, observability, error, variance, flags, np.ones(self._chain.n, dtype=bool), None

    def _observe(
        self, apart: bool, q: np.ndarray, qd: np.ndarray, raw: np.ndarray, dt: float, rest: np.ndarray,
        unknown: np.ndarray,
    ) -> tuple[np.ndarray, ...]:  # fmt: skip
        share = -np.expm1(-self._gain * dt)
        if apart:
            self._r, self._low, self._seen = np.zeros(len(q)), self._unsure, 0.0
        else:
            self._r = self._r + share * (raw - self._r)
            self._low = self._low + share * (self._unsure - self._low)
            self._seen = self._seen + share * (1.0 - self._seen)
        doubt = (self._covariance[4] * self._r) ** 2 + unknown
        variance = speed_variance(self._covariance, qd) + doubt + rest**2 * self._low
        A = contact_map(self._chain, q, self._point).T @ self._chain.jacobian(q) * self._seen
        x, P, *_ = solve_wrench(A, self._r, variance, 0 * variance, self._prior[: self._k], 0)
        return x, P, self._r, variance

    def _filter(
        self, first: bool, apart: bool, q: np.ndarray, qd: np.ndarray, middle: np.ndarray, known: np.ndarray, dt: float,
        moved: np.ndarray, rise: np.ndarray, rest: np.ndarray, unknown: np.ndarray,
    ) -> tuple[np.ndarray, ...]:  # fmt: skip
        n, k, scale = self._chain.n, self._k, np.sqrt(self._prior[: self._k])
        M = self._chain.mass_matrix(q, self._links) + np.diag(self._rotor)
        R = (M * self._qd_noise**2) @ M.T
        variance, friction = speed_variance(self._covariance, qd), rest**2
        strength = 2.0 * variance * self._memory
        G = (contact_map(self._chain, middle, self._point).T @ self._chain.jacobian(middle)).T * scale
        rate, leak = self._rate[:k] / self._prior[:k], self._leak[:k]
        speed = G**2 @ rate  # of the torque that the wrench's walk makes
        doubt = np.zeros(n) if first else (self._covariance[4] * (G @ self._x[n : n + k])) ** 2
        doubt = doubt + unknown
        lasting = doubt if self._biased else doubt + friction * self._unsure
        strength, variance = strength + lasting * LONGEST, variance + lasting
        Qp = np.where(speed > 0, np.minimum(strength * speed, variance**2) / np.where(speed > 0, speed, 1.0), strength)
        if self._biased:
            G = np.hstack([G, -np.eye(n)])
            leak = np.concatenate([leak, moved / dt])
            rate = np.concatenate([rate, friction * (rise / dt + CREEP)])
        if first:
            self._x, self._P = np.zeros(n + k), np.diag(np.concatenate([np.zeros(n), np.ones(k)]))
        if apart:
            self._restart(R, rate[:k], leak[:k], 0.0 if first else dt, friction if self._biased else np.zeros(0))
        else:
            self._x, self._P = momentum_step(self._x, self._P, G, known, self._p, R, dt, Qp, rate, leak)
        x, P = scale * self._x[n : n + k], np.outer(scale, scale) * self._P[n : n + k, n : n + k]
        return x, P, G @ self._x[n:], variance

    def _restart(self, R: np.ndarray, rate: np.ndarray, leak: np.ndarray, dt: float, friction: np.ndarray) -> None:
        """Let the wrench drift for a time dt; reset the momentum to its measurement and friction to its prior."""
        n, z = self._chain.n, slice(self._chain.n, self._chain.n + self._k)
        decay, _, wandered, _, _ = leak_integrals(leak, dt)
        wrench = np.outer(decay, decay) * self._P[z, z] + np.diag(rate * wandered)
        self._x = np.concatenate([self._p, decay * self._x[z], np.zeros(len(friction))])
        P = np.zeros((len(self._x),) * 2)
        P[:n, :n], P[z, z] = R, wrench
        P[z.stop :, z.stop :] = np.diag(friction)
        self._P = P
