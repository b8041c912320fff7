"""Estimator step built from Pinocchio's rnea and Jacobian; the rest is fast NumPy and LAPACK code."""

from __future__ import annotations

from math import exp, pi, sqrt, tan

import numpy as np
import pinocchio as pin
from peers import WORLD_AXES, Pinocchio
from scipy.linalg.lapack import dposv

from armlab.models import TorqueModel
from armlab.robots import Robot
from armlab.state import State

REST_TIME = 0.5


class PinocchioEstimator:
    """Static MAP wrench with presliding friction, using the formulas of `armlab.contact.estimator`.

    Parameters
    ----------
    links : (n, 10) link parameters with masses, which give the same torques as the model. prior : (6,) variances.
    """

    def __init__(self, model: TorqueModel, robot: Robot, links: np.ndarray, prior: np.ndarray) -> None:
        self._peer = Pinocchio(robot, links)
        self._m, self._f, self._r, self._c = model, model.friction, model.ripple, model.covariance
        self._ripples = bool(np.any(self._r.cosine) or np.any(self._r.sine))
        self._rooted, smooth = bool(np.any(self._f.root)), self._f.smooth_speed
        self._loaded = bool(np.any(self._f.load))
        self._smooth = 1.0 / np.where(smooth > 0, smooth, 1.0) if np.any(smooth > 0) else None
        self._speed_scale, self._delta_scale = 1.0 / self._f.stribeck_speed, -1.0 / self._f.delta
        self._static2 = self._f.static**2
        self._at_speed, self._excess = self._c.alpha2 * self._c.Cinf, self._c.alpha2 * (self._c.C0 - self._c.Cinf)
        self._true, self._unsure = 1.0 / model.gains, model._gain_variance
        self._doubt = model.contact_doubt
        self._prior, self._prior_column = prior, prior[:, None]
        self._prior_matrix = np.diag(prior)
        self.reset()

    def reset(self) -> None:
        n = self._m.n
        self._z, self._p, self._play = np.zeros(n), np.ones(n), None
        self._low = np.zeros((2, 2 * n))

    def step(self, state: State) -> tuple[np.ndarray, ...]:
        """Return F, its covariance, observability, filtered torque error and its variance."""
        q, qd, dt, n = state.q, state.qd, state.dt, self._m.n
        first = self._play is None
        if first:
            self._play, self._qd = q, qd
        self._slide(q, dt)
        qdd = (qd - self._qd) / dt
        self._qd = qd
        peer = self._peer
        load = self._load(self._true * state.tau - self._m.rotor * qdd, q, qd)
        off = pin.rnea(peer.model, peer.data, q, qd, qdd) - load
        low = self._lowpass(np.concatenate((off, self._p)), dt, first)
        error = low[:n]
        variance = self._variance(qd) + self._static2 * np.minimum(np.maximum(low[n:], 0.0), 1.0)
        variance += np.square(self._doubt * error)
        J = pin.computeFrameJacobian(peer.model, peer.data, q, peer.tool, WORLD_AXES)
        return *self._posterior(J, error, variance), error, variance

    def _load(self, tau: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Return the part of the motor torque transmitted to the links."""
        f, z = self._f, self._z
        if self._smooth is not None:
            z = np.where(f.smooth_speed > 0, np.tanh(qd * self._smooth), z)
        y = tau - self._drive(z, q, qd)
        if not self._loaded:
            return y
        load = y / (1.0 + f.load * z * np.sign(y))
        self._static2 = np.square(f.static + f.load * np.abs(load))
        return load

    def _drive(self, z: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        f = self._f
        drive = f.viscous * qd + f.offset + np.where(z > 0, f.coulomb_pos, f.coulomb_neg) * z
        drive += f.stribeck * z * np.exp(-np.square(qd * self._speed_scale))
        if self._rooted:
            drive += f.root * z * np.sqrt(np.abs(qd))
        if self._ripples:
            angle = self._r.cycles * q
            drive += self._r.cosine * np.cos(angle) + self._r.sine * np.sin(angle)
        return drive

    def _slide(self, q: np.ndarray, dt: float) -> None:
        resolution = self._f.resolution
        moved = np.minimum(np.maximum(self._play, q - resolution), q + resolution)
        dy = moved - self._play
        sign = np.sign(dy)
        kept = np.exp(np.abs(dy) * self._delta_scale)
        self._z, self._play = sign + (self._z - sign) * kept, moved
        self._p = (self._p + (1.0 - self._p) * (1.0 - exp(-dt / REST_TIME))) * kept * kept

    def _lowpass(self, x: np.ndarray, dt: float, first: bool) -> np.ndarray:
        low = self._low
        if first:
            low[1] = x
            return x
        g = tan(pi * min(self._m.cutoff * dt, 0.45))
        v1 = (low[0] + g * (x - low[1])) / (1.0 + g * (g + sqrt(2.0)))
        v2 = low[1] + g * v1
        low[0], low[1] = 2.0 * v1 - low[0], 2.0 * v2 - low[1]
        return v2

    def _variance(self, qd: np.ndarray) -> np.ndarray:
        if self._c.kind == "exp":
            return self._at_speed + self._excess * np.exp(-self._c.shape * np.abs(qd))
        return self._c.variance(qd)

    def _posterior(self, J: np.ndarray, error: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, ...]:
        weighted = self._prior_column * J
        S = J.T @ weighted
        S.flat[:: len(variance) + 1] += variance
        _, gain, failed = dposv(S, weighted.T)
        if failed:
            raise ArithmeticError("S is not positive definite.")
        P = self._prior_matrix - weighted @ gain
        F = error @ gain
        return F, self._of_gains(F, P), 1.0 - P.diagonal() / self._prior

    def _of_gains(self, F: np.ndarray, P: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) including the uncertainty of the torque gains."""
        return P + np.outer(self._unsure * F, F)
