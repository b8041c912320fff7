"""Momentum observer and Kalman filter in NumPy, built from Pinocchio's crba, Coriolis matrix, gravity and Jacobian."""

from __future__ import annotations

from math import expm1

import numpy as np
import pinocchio as pin
from peers import WORLD_AXES
from pinocchio_estimator import PinocchioEstimator
from scipy.linalg.lapack import dposv

from armlab.models import TorqueModel
from armlab.models.uncertainty import FORCE_RATES
from armlab.robots import Robot
from armlab.state import State

GAIN, LONGEST = 30.0, 20.0


class PinocchioMomentum(PinocchioEstimator):
    """Formulas of `armlab.contact.estimator`, methods "observer" and "kf", for steps without gaps.

    `filters` selects the Kalman filter instead of the observer. The other parameters are those of
    `PinocchioEstimator`.
    """

    def __init__(self, model: TorqueModel, robot: Robot, links: np.ndarray, prior: np.ndarray, filters: bool) -> None:
        noise = model.momentum
        alpha2 = noise.alpha2_kf if filters else noise.alpha2_observer
        self._filters, self._scale, self._rotor = filters, np.sqrt(prior), np.diag(model.rotor)
        self._memory, self._qd_variance = noise.memory, alpha2 * noise.qd_noise**2
        self._rate = alpha2 * np.square(FORCE_RATES["normal"]) / prior
        self._leak = 0.5 * self._rate
        super().__init__(model, robot, links, prior)
        c = model.covariance
        self._at_speed, self._excess = alpha2 * c.Cinf, alpha2 * (c.C0 - c.Cinf)
        self._of_step = None

    def reset(self) -> None:
        super().reset()
        self._count, self._seen = 0, 0.0
        self._residual, self._low_p = np.zeros(self._m.n), np.ones(self._m.n)

    def step(self, state: State) -> tuple[np.ndarray, ...]:
        """Return F and its covariance."""
        q, qd, dt, peer = state.q, state.qd, state.dt, self._peer
        first = self._play is None
        if first:
            self._play = q
        self._slide(q, dt)
        if first:
            self._p = np.ones(self._m.n)
        beta = pin.computeCoriolisMatrix(peer.model, peer.data, q, qd).T @ qd
        gravity = pin.computeGeneralizedGravity(peer.model, peer.data, q)
        M = pin.crba(peer.model, peer.data, q) + self._rotor
        u, p = self._load(self._true * state.tau, q, qd) + beta - gravity, M @ qd
        known = u if self._count < 2 else 0.5 * (u + self._known)
        middle = q if first else 0.5 * (q + self._q)
        self._known, self._q, self._count = u, q, self._count + 1
        found = (
            self._kalman(first, p, M, known, middle, dt, qd)
            if self._filters
            else self._observe(first, p, known, dt, qd)
        )
        self._momentum = p
        return found

    def _observe(
        self, first: bool, p: np.ndarray, known: np.ndarray, dt: float, qd: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        share = -expm1(-GAIN * dt)
        if first:
            self._low_p = self._p
        else:
            self._residual = self._residual + share * ((p - self._momentum) / dt - known - self._residual)
            self._low_p = self._low_p + share * (self._p - self._low_p)
            self._seen += share * (1.0 - self._seen)
        variance = self._variance(qd) + self._static2 * self._low_p + np.square(self._doubt * self._residual)
        J = pin.computeFrameJacobian(self._peer.model, self._peer.data, self._q, self._peer.tool, WORLD_AXES)
        return self._posterior(self._seen * J, self._residual, variance)[:2]

    def _kalman(
        self,
        first: bool,
        p: np.ndarray,
        M: np.ndarray,
        known: np.ndarray,
        middle: np.ndarray,
        dt: float,
        qd: np.ndarray,
    ) -> tuple[np.ndarray, ...]:
        n = len(p)
        J = pin.computeFrameJacobian(self._peer.model, self._peer.data, middle, self._peer.tool, WORLD_AXES)
        G = (J * self._scale[:, None]).T
        R = (M * self._qd_variance) @ M.T
        stays = self._static2 * self._p
        if not first:
            stays += np.square(self._doubt * (G @ self._x[n:]))
        variance = self._variance(qd)
        Qp = np.minimum(
            2.0 * variance * self._memory + stays * LONGEST, np.square(variance + stays) / (G * G @ self._rate)
        )
        if first:
            self._x, self._P = np.concatenate((p, np.zeros(6))), np.zeros((n + 6, n + 6))
            self._P[:n, :n], self._P[n:, n:] = R, np.eye(6)
        else:
            self._predict(G, known, dt, Qp)
            P, S = self._P, self._P[:n, :n] + R
            _, gain, failed = dposv(S, P[:n])
            if failed:
                raise ArithmeticError("S is not positive definite.")
            self._x = self._x + (p - self._x[:n]) @ gain
            self._P = P - P[:, :n] @ gain
        F = self._scale * self._x[n:]
        return F, self._of_gains(F, self._scale[:, None] * self._P[n:, n:] * self._scale)

    def _predict(self, G: np.ndarray, known: np.ndarray, h: float, Qp: np.ndarray) -> None:
        n, P = len(Qp), self._P
        if self._of_step is None or self._of_step[0] != h:  # integrals over a step, computed once per step length
            a = self._leak
            decay, phi, twice = np.exp(-a * h), -np.expm1(-a * h) / a, -np.expm1(-2 * a * h) / (2 * a)
            series = h**3 * (1 / 3 - a * h / 4 + 7 * (a * h) ** 2 / 60)
            self._of_step = h, decay, phi, twice, 0.5 * phi**2, series
        _, decay, phi, twice, mixed, square = self._of_step
        W = G * phi
        Ppz, Pzz = P[:n, n:] + W @ P[n:, n:], P[n:, n:]
        Ppp = P[:n, :n] + P[:n, n:] @ W.T + W @ Ppz.T + (G * (self._rate * square)) @ G.T
        Ppp.flat[:: n + 1] += Qp * h
        Ppz = Ppz * decay + G * (self._rate * mixed)
        new = np.empty_like(P)
        new[:n, :n], new[:n, n:], new[n:, :n] = Ppp, Ppz, Ppz.T
        new[n:, n:] = decay[:, None] * Pzz * decay
        new.flat[n * (n + 7) :: n + 7] += self._rate * twice
        z = self._x[n:]
        self._x, self._P = np.concatenate((self._x[:n] + W @ z + h * known, decay * z)), new
