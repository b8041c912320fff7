"""Contact wrench with presliding friction, sample by sample.

One step, with ``tau_e = model - measured = J^T F + error``:

1. y follows q with a play of +-resolution; z slides by dy. Its variance p relaxes towards 1, the largest that a
   variable in [-1, 1] can have, with the time constant REST_TIME, since friction during a long rest is unknown;
   displacement then reduces it: ``p <- p exp(-2 |dy| / delta)``.
2. qdd = (qd_k - qd_{k-1}) / dt; tau_e = rnea - x, with x of ``x + load s |x| = tau / gains - rotor qdd - friction(qd,
   z) - ripple(q)`` (`drive.load_of`).
3. tau_e passes a second-order Butterworth low-pass (state-variable form, exact for a varying dt up to frequency
   warping).
4. C_tau = diag(s^2(qd) + (doubt tau_e)^2 + static^2 p_filtered), static the friction at rest with load |x|, p
   low-passed like tau_e so that it stays as long as its error does. doubt: the uncertainty of the contact torque from
   gain and load friction; s already includes the errors of the arm's own torque.
5. The wrench from tau_e and C_tau, by one of the methods of `wrench.py`.

Methods with a bound (bounded, clip, interval) treat friction near rest as bounded instead of random. With the slowness
w = exp(-(qd / speed)^2), the Coulomb and Stribeck terms of the model count by 1 - w, the bound is ``torque max(w, p) +
floor`` with max(w, p) low-passed and torque grown by load |x|, and C_tau = diag(Cinf + (doubt tau_e)^2).

A step longer than GAP_STEPS first steps is a gap: friction during it is unknown, so all but the warmth is reset, as at
the first sample; the low-pass is reset again at the next one, which has an acceleration. Without an acceleration,
methods with a bound give no estimate: the inertial torque would count as contact.

Measured torques include gains, so ``tau / gains`` is the true torque; where the gains are off by a common share g, so
is F: its covariance grows by ``var(g) F F^T``, an interval at both ends by 3 deviations of g, within its box.

With a contact at a known point, F = S f for a force f, S = [1; hat(r)], and the solver works on A = S^T J.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .chain import Chain
from .drive import Drive, DriveState, drive_torque, heat, load_of, move, restart, sign, start
from .wrench import METHODS, solve_wrench, wrench_interval

REST_TIME = 0.5  # s
SETTLING = 60.0  # 1/s, of the acceleration in the rows of the parameters
GAP_STEPS = 5.0  # first steps; a longer step is a gap, of which nothing is known
UNKNOWN = 1.0  # largest variance of a variable in [-1, 1]
LARGEST = 1e100  # N m; a torque error beyond it would overflow in the filter and never leave it
WEAK_BELOW = 0.5
SPREAD_SIGMAS, BOX_SIGMAS = 3.0, 10.0  # of the interval
INVALID, WEAK, STUCK, INFEASIBLE, SINGULAR, TARED = 1, 2, 4, 8, 16, 32  # bits of the flags


def speed_variance(covariance: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return s^2 (n,) at velocities (n,) for covariance (5, n), rows C0, Cinf, shape, kind, doubt."""
    at_rest, at_speed, shape, kind, _ = covariance
    speed = np.abs(qd)
    weight = np.where(kind == 0, np.exp(-shape * speed), np.where(kind == 1, speed < shape, 0.0))
    return (at_rest - at_speed) * weight + at_speed


def parameter_variance(
    doubt: tuple[np.ndarray, ...] | None, chain: Chain, gravity: np.ndarray, drive: Drive, q: np.ndarray,
    qd: np.ndarray, qdd: np.ndarray, x: np.ndarray, state: DriveState,
) -> np.ndarray:  # fmt: skip
    """Return w C w^T (n,) beyond a mean (n,), for columns (n, W), -1 beyond those of a joint, and lower triangles of C.

    Columns are those of links (10 n), rotors (n), and of the joint's friction: viscous, Coulomb of either direction,
    offset, Stribeck, root, load.
    """
    n = chain.n
    if doubt is None:
        return np.zeros(n)
    s = sign(drive, qd, state)
    bell, one = np.exp(-((qd / drive.friction[5]) ** 2)), np.ones(n)
    friction = [qd, np.maximum(s, 0), np.minimum(s, 0), one, s * bell, s * np.sqrt(np.abs(qd)), s * np.abs(x)]
    whole = np.hstack([chain.rigid_regressor(q, qd, qdd, gravity), np.diag(qdd), np.stack(friction, axis=1)])
    out = np.zeros(n)
    for i, (columns, lower, mean) in enumerate(zip(*doubt)):
        w = whole[i, columns[columns >= 0].astype(int)]
        half = np.tril(lower)[: len(w), : len(w)]
        out[i] = w @ (half + np.tril(half, -1).T) @ w - mean
    return np.maximum(out, 0.0)


def contact_map(chain: Chain, q: np.ndarray, point: np.ndarray | None) -> np.ndarray:
    """Return S (6, k) of F = S x: the identity, or [1; hat(r)] of a force at a known point (3,) in tool axes."""
    if point is None:
        return np.eye(6)
    x, y, z = chain.forward(q)[:3, :3] @ point
    return np.vstack([np.eye(3), [[0, -z, y], [z, 0, -x], [-y, x, 0]]])


class Stepwise:
    """An estimator of `n` joints that takes samples one at a time; `interval` says whether it returns intervals."""

    interval = False

    def __init__(
        self,
        chain: Chain,
        gravity: np.ndarray,
        links: np.ndarray,
        rotor: np.ndarray,
        drive: Drive,
        gains: np.ndarray,
        gain_variance: float,
        covariance: np.ndarray,
        prior: np.ndarray,
        point: np.ndarray | None,
    ) -> None:
        self._chain, self.n, self._drive, self._gain_variance = chain, chain.n, drive, gain_variance
        given = (gravity, links, rotor, gains, covariance, prior)
        arrays = (np.array(a, dtype=float) for a in given)
        self._gravity, self._links, self._rotor, self._gains, self._covariance, self._prior = arrays
        self._point = None if point is None else np.array(point, dtype=float)
        self._static = 0.5 * (drive.friction[1] + drive.friction[2]) + np.maximum(drive.friction[4], 0.0)
        self.reset()

    def reset(self) -> None:
        raise NotImplementedError

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> tuple[Any, ...]:
        raise NotImplementedError

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> tuple[Any, ...]:
        """Step along a record (N, n) with steps dt (N,); return the outputs of `step` stacked over N."""
        rows = [self.step(*row) for row in zip(q, qd, tau, dt)]
        *stacked, interval = (np.array(column) for column in zip(*rows))
        return *stacked, interval if self.interval else None

    def _invalid(self) -> tuple[Any, ...]:
        missing = tuple(np.full(shape, np.nan) for shape in ((6,), (6, 6), (6,), (self.n,), (self.n,)))
        return *missing, INVALID, np.zeros(self.n, dtype=bool), np.full((6, 2), np.nan) if self.interval else None


class WrenchEstimator(Stepwise):
    """Contact wrench from joint motion and torque, one sample at a time."""

    def __init__(
        self, chain: Chain, gravity: Any, links: Any, rotor: Any, drive: Drive, gains: Any, gain_variance: float,
        covariance: Any, bound: Any, prior: Any, cutoff: float, method: int = 0, point: Any = None,
        doubt_columns: Any = None, doubt_cov: Any = None, doubt_mean: Any = None,
    ) -> None:  # fmt: skip
        self._doubt = None if doubt_columns is None else (doubt_columns, doubt_cov, doubt_mean)
        self._bound, self._cutoff = np.array(bound, dtype=float), float(cutoff)
        self.interval, self._method = METHODS[method] == "interval", method
        self._band = METHODS[method] in ("bounded", "clip", "interval")
        super().__init__(chain, gravity, links, rotor, drive, gains, gain_variance, covariance, prior, point)

    def reset(self) -> None:
        n = len(self._rotor)
        self._state, self._started = start(self._drive, np.zeros(n)), False
        self._fresh = False
        self._qd, self._p = np.zeros(n), np.full(n, UNKNOWN)
        self._low, self._nominal = np.zeros((2, 2 * n)), 0.0
        self._qdd = np.zeros(n)

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> tuple[Any, ...]:
        n = len(self._rotor)
        q, qd, tau = (np.asarray(a, dtype=float) for a in (q, qd, tau))
        first = not self._started
        if not (np.isfinite(q).all() and np.isfinite(qd).all() and np.isfinite(tau).all() and 0.0 < dt < np.inf):
            return self._invalid()
        apart = first or dt > GAP_STEPS * self._nominal
        before, last, p = self._state, self._qd, self._p
        if apart:
            before, last, p = restart(q, self._state), qd, np.full(n, UNKNOWN)
        with np.errstate(over="ignore", invalid="ignore"):
            qdd = (qd - last) / dt
            rigid = self._chain.rnea(q, qd, qdd, self._gravity, self._links)
            state, dy = move(self._drive, q, before)
            p = p + (UNKNOWN - p) * (1.0 - np.exp(-dt / REST_TIME))
            p = p * np.exp(-2.0 * np.abs(dy) / self._drive.friction[6])
            dry_share = 1.0 - self._slowness(qd) if self._band else 1.0  # near rest it is anything within the bound
            passing = tau / self._gains - self._rotor * qdd - drive_torque(self._drive, q, qd, state, dry_share)
            load = load_of(self._drive, passing, qd, state, dry_share)
            raw = rigid - load
        if not np.all(np.abs(raw) < LARGEST):
            return self._invalid()
        self._state, self._p = heat(self._drive, qd, dt, state), p
        self._qd, self._started = qd.copy(), True
        self._qdd = np.zeros(n) if apart else self._qdd - np.expm1(-SETTLING * dt) * (qdd - self._qdd)
        if first:
            self._nominal = dt
        unsure = np.maximum(self._slowness(qd), p) if self._band else p
        begins = np.repeat(
            [apart or self._fresh, apart], n
        )  # the doubt stays while one sample's noise is in the filter
        filtered = self._lowpass(np.concatenate([raw, unsure]), dt, begins)
        self._fresh = apart and not first
        torque, unsure = filtered[:n], np.clip(filtered[n:], 0.0, UNKNOWN)
        doubt = (self._covariance[4] * torque) ** 2 + parameter_variance(
            self._doubt, self._chain, self._gravity, self._drive, q, qd, self._qdd, load, state
        )
        more = self._drive.friction[10] * np.abs(load)
        if self._band:
            bound = np.full(n, LARGEST) if apart else (self._bound[0] + more) * unsure + self._bound[2]
            return self._solve(q, torque, self._covariance[1] + doubt, bound)
        variance = speed_variance(self._covariance, qd) + doubt + (self._static + more) ** 2 * unsure
        return self._solve(q, torque, variance, np.zeros(n))

    def _lowpass(self, x: np.ndarray, dt: float, begins: np.ndarray) -> np.ndarray:
        self._low[0, begins], self._low[1, begins] = 0.0, x[begins]  # in steady state: no initial transient
        g = np.tan(np.pi * min(self._cutoff * dt, 0.45))
        a = 1.0 / (1.0 + g * (g + np.sqrt(2.0)))
        error = x - self._low[1]
        v1 = a * (self._low[0] + g * error)
        v2 = self._low[1] + g * v1
        self._low = np.stack([2.0 * v1 - self._low[0], 2.0 * v2 - self._low[1]])
        return np.where(begins, x, v2)

    def _slowness(self, qd: np.ndarray) -> np.ndarray:
        return np.exp(-((qd / self._bound[1]) ** 2))

    def _solve(self, q: np.ndarray, torque: np.ndarray, variance: np.ndarray, bound: np.ndarray) -> tuple[Any, ...]:
        S = contact_map(self._chain, q, self._point)
        A = S.T @ self._chain.jacobian(q)
        prior = self._prior[: S.shape[1]]
        x, P, active, _, _, singular = solve_wrench(A, torque, variance, bound, prior, self._method)
        C = np.diag((S * prior) @ S.T)
        F, P = S @ x, S @ P @ S.T
        ratio = np.divide(np.diag(P), C, out=np.zeros(6), where=C > 0)
        observability = np.fmax(1.0 - ratio, 0.0)
        flags = (SINGULAR if singular else 0) | (WEAK if np.any(observability < WEAK_BELOW) else 0)
        if self._band and not active.any():
            flags |= STUCK
        interval = None
        if METHODS[self._method] == "interval":
            spread, box = bound + SPREAD_SIGMAS * np.sqrt(variance), BOX_SIGMAS * np.sqrt(prior)
            ends, violated = wrench_interval(A, torque, spread, box)
            if ends is None:
                interval, active, flags = np.full((6, 2), np.nan), violated, flags | INFEASIBLE
            else:
                widened = SPREAD_SIGMAS * np.sqrt(self._gain_variance) * np.abs(ends)
                ends = np.clip(ends + widened * [-1.0, 1.0], -box[:, None], box[:, None])
                up, down = np.maximum(S, 0.0), np.minimum(S, 0.0)
                interval = up @ ends + down @ ends[:, ::-1]
        P = P + self._gain_variance * np.outer(F, F)
        return F, P, observability, torque, variance, flags, active, interval
