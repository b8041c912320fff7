"""Static MAP contact wrench with presliding friction (specification; the compiled twin is native/estimator.cpp).

One step, with ``tau_e = model - measured = J^T F + error``:

1. y follows q with a play of +-resolution; z slides by dy. Its variance p relaxes towards 1, the largest that a
   variable in [-1, 1] can have, with the time constant REST_TIME, since what friction does during a long rest is not
   known; then displacement wipes it out: ``p <- p exp(-2 |dy| / delta)``.
2. qdd = (qd_k - qd_{k-1}) / dt; tau_e = rnea + rotor qdd + friction(qd, z) + ripple(q) - tau.
3. tau_e passes a second-order Butterworth low-pass (state-variable form, exact for a varying dt up to frequency
   warping).
4. C_tau = diag(s^2(qd) + static^2 p_filtered), with p low-passed like tau_e so that it stays as long as its error does.
5. S = J^T C_F J + C_tau, K = C_F J S^-1, F = K tau_e, P = (I - K J^T) C_F (I - K J^T)^T + K C_tau K^T.
"""

from __future__ import annotations

import numpy as np

from armlab.kernels._reference.arrays import read
from armlab.kernels._reference.chain import Chain
from armlab.kernels._reference.presliding import slide

__all__ = ["WrenchEstimator"]

REST_TIME = 0.5  # s
UNKNOWN = 1.0  # largest variance of a variable in [-1, 1]
LARGEST = 1e100  # N m; a torque error beyond it would overflow in the filter and never leave it


class WrenchEstimator:
    """Contact wrench from joint motion and torque, one sample at a time.

    Parameters
    ----------
    chain : kinematics and dynamics kernel.
    gravity : (3,) [m/s^2], base axes.
    links : (n, 10) link parameters. rotor : (n,) rotor inertia.
    friction : (8, n) rows viscous, coulomb_pos, coulomb_neg, offset, stribeck, stribeck_speed, delta, resolution.
    ripple : (3, n) rows cycles, cosine, sine.
    covariance : (4, n) rows C0, Cinf, shape, kind (0 exp, 1 step, 2 const); C0 and Cinf already scaled.
    prior : (6,) prior variances of the wrench.
    cutoff : corner of the low-pass [Hz].
    """

    def __init__(
        self,
        chain: Chain,
        gravity: np.ndarray,
        links: np.ndarray,
        rotor: np.ndarray,
        friction: np.ndarray,
        ripple: np.ndarray,
        covariance: np.ndarray,
        prior: np.ndarray,
        cutoff: float,
    ) -> None:
        self._chain, n = chain, chain.n
        self._gravity = read(gravity, "gravity", (3,), exact=True).copy()
        self._links = read(links, "links", (n, 10), exact=True).copy()
        self._rotor = read(rotor, "rotor", (n,), exact=True).copy()
        self._friction = read(friction, "friction", (8, n), exact=True).copy()
        self._ripple = read(ripple, "ripple", (3, n), exact=True).copy()
        self._covariance = read(covariance, "covariance", (4, n), exact=True).copy()
        self._prior = read(prior, "prior", (6,), exact=True).copy()
        self._cutoff = float(cutoff)
        self._static = 0.5 * (self._friction[1] + self._friction[2]) + np.maximum(self._friction[4], 0.0)
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        n = len(self._rotor)
        self._play, self._started = np.zeros(n), False
        self._qd = np.zeros(n)
        self._z, self._p = np.zeros(n), np.full(n, UNKNOWN)
        self._low = np.zeros((2, 2 * n))

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
        """Advance by one sample; return F (6,), P (6, 6), observability (6,), filtered tau_e (n,), its variance (n,).

        A sample that is not finite, or whose torque error would not be, or dt <= 0, gives NaN everywhere and leaves the
        state unchanged.
        """
        n = len(self._rotor)
        q, qd, tau = (read(a, name, (n,), exact=True) for a, name in ((q, "q"), (qd, "qd"), (tau, "tau")))
        first = not self._started
        if not (np.isfinite(q).all() and np.isfinite(qd).all() and np.isfinite(tau).all() and 0.0 < dt < np.inf):
            return self._invalid()
        if first:
            self._play, self._qd = q.copy(), qd.copy()
        with np.errstate(over="ignore", invalid="ignore"):
            qdd = (qd - self._qd) / dt
            rigid = self._chain.rnea(q, qd, qdd, self._gravity, self._links) + self._rotor * qdd
            play, z, p = self._slide(q, dt)
            raw = rigid + self._drive_torque(q, qd, z) - tau
        if not np.all(np.abs(raw) < LARGEST):
            return self._invalid()
        self._play, self._z, self._p, self._qd, self._started = play, z, p, qd.copy(), True
        filtered = self._lowpass(np.concatenate([raw, self._p]), dt, first)
        torque, p = filtered[:n], np.clip(filtered[n:], 0.0, UNKNOWN)
        variance = self._variance(qd) + self._static**2 * p
        return (*self._posterior(self._chain.jacobian(q), torque, variance), torque, variance)

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> tuple[np.ndarray, ...]:
        """Step along a record (N, n) with steps dt (N,); return the outputs of `step` stacked over N."""
        n = len(self._rotor)
        dt = read(dt, "dt", np.shape(dt)[:1], exact=True)
        q, qd, tau = (read(a, name, (len(dt), n), exact=True) for a, name in ((q, "q"), (qd, "qd"), (tau, "tau")))
        rows = [self.step(*row) for row in zip(q, qd, tau, dt)]
        shapes = ((6,), (6, 6), (6,), (n,), (n,))
        return tuple(np.array([row[k] for row in rows]).reshape(len(rows), *shape) for k, shape in enumerate(shapes))

    def _invalid(self) -> tuple[np.ndarray, ...]:
        n = len(self._rotor)
        return tuple(np.full(shape, np.nan) for shape in ((6,), (6, 6), (6,), (n,), (n,)))

    def _slide(self, q: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the next play, presliding state and its variance."""
        delta, resolution = self._friction[6], self._friction[7]
        moved = np.clip(self._play, q - resolution, q + resolution)
        dy = moved - self._play
        p = self._p + (UNKNOWN - self._p) * (1.0 - np.exp(-dt / REST_TIME))
        return moved, slide(self._z, dy, delta), p * np.exp(-2.0 * np.abs(dy) / delta)

    def _drive_torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray) -> np.ndarray:
        viscous, positive, negative, offset, stribeck, speed, _, _ = self._friction
        coulomb = positive * np.maximum(z, 0) + negative * np.minimum(z, 0)
        friction = viscous * qd + coulomb + offset + stribeck * z * np.exp(-((qd / speed) ** 2))
        angle = self._ripple[0] * q
        return friction + self._ripple[1] * np.cos(angle) + self._ripple[2] * np.sin(angle)

    def _lowpass(self, x: np.ndarray, dt: float, first: bool) -> np.ndarray:
        if first:  # start in steady state, without a transient from zero
            self._low[0], self._low[1] = 0.0, x
            return x
        g = np.tan(np.pi * min(self._cutoff * dt, 0.45))
        a = 1.0 / (1.0 + g * (g + np.sqrt(2.0)))
        error = x - self._low[1]
        v1 = a * (self._low[0] + g * error)
        v2 = self._low[1] + g * v1
        self._low = np.stack([2.0 * v1 - self._low[0], 2.0 * v2 - self._low[1]])
        return v2

    def _variance(self, qd: np.ndarray) -> np.ndarray:
        at_rest, at_speed, shape, kind = self._covariance
        speed = np.abs(qd)
        weight = np.where(kind == 0, np.exp(-shape * speed), np.where(kind == 1, speed < shape, 0.0))
        return (at_rest - at_speed) * weight + at_speed

    def _posterior(self, J: np.ndarray, torque: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, ...]:
        prior = self._prior
        weighted = prior[:, None] * J
        S = J.T @ weighted + np.diag(variance)
        K = np.linalg.solve(S, weighted.T).T
        A = np.eye(6) - K @ J.T
        P = (A * prior) @ A.T + (K * variance) @ K.T
        P = 0.5 * (P + P.T)
        return K @ torque, P, 1.0 - np.diag(P) / prior
