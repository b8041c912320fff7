"""Model of a sensor with a load under gravity: residuals with Jacobian, closed forms, initial guesses.

    f_i = R^T R_base_tool,i^T gamma + b_f,        tau_i = c x (R^T R_base_tool,i^T gamma) + b_tau

with gamma = s m g in base axes; for an accelerometer, gamma = -scale g. For forces with known gravity and isotropic
noise, the maximum-likelihood load has a closed form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from armlab.estimation import Measurement, NonlinearProblem
from armlab.lie import so3

ROUNDING = 1e-11  # rounding errors relative to the largest reading
FLOOR = 1e-6  # noise, relative to the readings, below which it counts as rounding error
ROUNDS = 50  # maximum number of reweighting steps
SETTLED = 1e-3  # change of the weights at convergence, relative to the largest weight
SHORT = 1e-3  # smallest residual used in the weights, relative to the median residual
FAR = 4.0  # ratio to the median residual above which a sample is excluded from the initial guess
NULL = 1e-9  # relative singular value that counts as zero
ALIKE = 0.5  # ratio of the mean weight in tool axes to the weight above which the mirror solution is also a minimum


class Load(NamedTuple):
    """Unknown parameters of a load and its sensor."""

    R: np.ndarray  # (3, 3) rotation from sensor to tool
    gamma: np.ndarray  # (3,) weight in base axes
    bias: np.ndarray  # (k,)
    centre: np.ndarray  # (3,) centre of mass in sensor axes [m]


@dataclass(frozen=True, eq=False)
class WeightEquation:
    RA: np.ndarray  # (N, 3, 3) R_base_tool
    y: np.ndarray  # (N, 3) forces, or (N, 6) with torques
    pull: np.ndarray | None  # (3,) s g, derivative of gamma with respect to the mass; None if gravity is unknown
    bias: bool  # whether the readings have a bias
    mass: float | None  # known mass; None: estimated
    noise: np.ndarray | None  # variances (k,), or covariance (k, k) or (N, k, k); None: estimated
    classes: tuple[str, ...]  # noise class of each column of y
    what: str

    @property
    def N(self) -> int:
        return len(self.y)

    @property
    def torque(self) -> bool:
        return self.y.shape[1] == 6

    @cached_property
    def widths(self) -> dict[str, int]:
        mass = 3 if self.pull is None else int(self.mass is None)
        found = {"rotation": 3, "mass": mass, "force bias": 3 * self.bias, "centre": 3 * self.torque}
        found["torque bias"] = 3 * (self.bias and self.torque)
        return {kind: count for kind, count in found.items() if count}

    @cached_property
    def places(self) -> dict[str, slice]:
        ends = list(accumulate(self.widths.values(), initial=0))
        return {kind: slice(a, b) for kind, a, b in zip(self.widths, ends[:-1], ends[1:])}

    def plus(self, load: Load, x: np.ndarray) -> Load:
        at, bias = self.places, load.bias.copy()
        gamma, centre = load.gamma, load.centre
        if "mass" in at:
            gamma = gamma + (x[at["mass"]] if self.pull is None else x[at["mass"]] * self.pull)
        if self.bias:
            bias[:3] += x[at["force bias"]]
        if self.torque:
            centre = centre + x[at["centre"]]
            if self.bias:
                bias[3:] += x[at["torque bias"]]
        return Load(load.R @ so3.exp(x[:3]), gamma, bias, centre)

    def evaluate(self, load: Load) -> list[Measurement]:
        M = self.RA @ load.R
        u = load.gamma @ M
        turned = so3.hat(u)
        size = sum(self.widths.values())
        at, J = self.places, np.zeros((self.N, self.y.shape[1], size))
        J[:, :3, at["rotation"]] = -turned
        if "mass" in at:
            per = M.transpose(0, 2, 1) if self.pull is None else (self.pull @ M)[:, :, None]
            J[:, :3, at["mass"]] = -per
        expected = u
        if self.torque:
            lever = so3.hat(load.centre)
            J[:, 3:] = lever @ J[:, :3]
            J[:, 3:, at["centre"]] = turned
            expected = np.concatenate([u, np.cross(load.centre, u)], axis=1)
        if self.bias:
            J[:, :3, at["force bias"]] = -np.eye(3)
            if self.torque:
                J[:, 3:, at["torque bias"]] = -np.eye(3)
        return [Measurement(self.y - expected - load.bias, J, self.noise, self.classes)]

    def problem(self) -> NonlinearProblem[Load]:
        return NonlinearProblem(
            self.evaluate, self.plus, what=self.what, residue=ROUNDING * (float(np.abs(self.y).max()) or 1.0)
        )

    def only(self, kept: np.ndarray) -> WeightEquation:
        noise = self.noise[kept] if self.noise is not None and self.noise.ndim == 3 else self.noise
        return replace(self, RA=self.RA[kept], y=self.y[kept], noise=noise)

    @cached_property
    def weights(self) -> np.ndarray:
        """Inverse mean variance (N,) of the force of each sample; 1 if the noise is unknown."""
        if self.noise is None:
            return np.ones(self.N)
        variances = self.noise if self.noise.ndim == 1 else np.diagonal(self.noise, axis1=-2, axis2=-1)
        return np.broadcast_to(1.0 / np.mean(variances[..., :3], axis=-1), (self.N,))

    @cached_property
    def turn(self) -> Turn:
        """Closed-form rotation and mass from all samples, for known gravity."""
        return Turn.of(self)

    def start(self) -> Load:
        """Return the closed-form load, which is optimal for forces with isotropic noise."""
        R, gamma = self._unknown_gravity() if self.pull is None else (self.turn.R, self.turn.m * self.pull)
        u = gamma @ (self.RA @ R)
        w = self.weights[:, None] / self.weights.sum()
        bias = np.zeros(self.y.shape[1])
        if self.bias:
            bias[:3] = np.sum(w * (self.y[:, :3] - u), axis=0)
        if not self.torque:
            return Load(R, gamma, bias, np.zeros(3))
        rows = [-so3.hat(u).reshape(-1, 3)]
        if self.bias:
            rows.append(np.tile(np.eye(3), (self.N, 1)))
        found = np.linalg.lstsq(np.hstack(rows), self.y[:, 3:].ravel(), rcond=None)[0]
        bias[3:] = found[3:] if self.bias else 0.0
        return Load(R, gamma, bias, found[:3])

    def centred(self, values: np.ndarray) -> np.ndarray:
        """Return values (N, ...) minus their weighted mean if there is a bias."""
        if not self.bias:
            return values
        return values - np.tensordot(self.weights / self.weights.sum(), values, axes=1)

    def _unknown_gravity(self) -> tuple[np.ndarray, np.ndarray]:
        """Return R and gamma from R f_i = R_i^T gamma, which is linear in both."""
        root = np.sqrt(self.weights)
        D = (self.centred(self.RA.transpose(0, 2, 1)) * root[:, None, None]).reshape(-1, 3)
        f = self.centred(self.y[:, :3]) * root[:, None]
        F = np.einsum("nk,ij->nikj", f, np.eye(3)).reshape(-1, 9)  # multiplies vec(R), column by column
        (QD, _), (QF, RF) = np.linalg.qr(D), np.linalg.qr(F)
        v = np.linalg.svd(QD.T @ QF)[2][0]
        R = np.linalg.lstsq(RF, v, rcond=None)[0].reshape(3, 3).T
        U, _, V = np.linalg.svd(R * np.sign(np.linalg.det(R)))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
        return R, np.linalg.lstsq(D, (f @ R.T).ravel(), rcond=None)[0]


class Turn(NamedTuple):
    """Closed-form rotation, mass and bias that minimise ``sum w_i |f_i - m R^T h_i - b|^2``.

    Here ``h_i = R_base_tool,i^T pull``. If there is a bias, weighted means are subtracted. With ``H = sum w h h^T`` and
    ``S = sum w h f^T`` with signed singular values s, R is the rotation nearest to S and ``m = (s1 + s2 + s3) / tr H``
    (Umeyama 1991). The best left-handed solution has -s3 instead of s3.
    """

    R: np.ndarray  # (3, 3)
    H: np.ndarray  # (3, 3) second moments of gravity in tool axes
    S: np.ndarray  # (3, 3) cross moments of gravity in tool axes and the forces
    m: float  # mass
    other_m: float  # mass of the best left-handed solution
    power: float  # residual sum of squares
    signal: float  # total sum of squares; both sums are divided by the variance if the noise is given
    moved: list[float]  # relative variation of gravity in tool axes along three axes, in ascending order
    difference: float  # Delta: chi^2 of the best left-handed solution minus chi^2 of the best rotation

    @property
    def mirrored(self) -> np.ndarray:
        """Best left-handed solution (3, 3)."""
        U, _, V = np.linalg.svd(self.S)
        third = U[:, 2:] * V[2]
        return self.R - 2.0 * np.vdot(third, self.R) * third

    @classmethod
    def of(cls, equation: WeightEquation, kept: np.ndarray | None = None) -> Turn:
        """Return the solution for the samples in the mask `kept` (N,), or for all samples."""
        w = (equation.weights if kept is None else equation.weights * kept)[:, None]
        pull = np.zeros(3) if equation.pull is None else equation.pull
        h, f = pull @ equation.RA, equation.y[:, :3]
        weights = float(w.sum())
        h_mean, f_mean = ((w * rows).sum(axis=0) / weights * equation.bias for rows in (h, f))
        h, f = h - h_mean, f - f_mean
        H, S = (w * h).T @ h, (w * h).T @ f
        R, sigma = so3.nearest(S)
        size, s1, s2, s3 = max(float(np.trace(H)), np.finfo(float).tiny), *sigma.tolist()
        along, other = s1 + s2 + s3, s1 + s2 - s3
        m, other_m = (along / size, other / size) if equation.mass is None else (equation.mass, equation.mass)
        residuals = f - m * (h @ R)
        power, signal = (float(np.vdot(w * rows, rows)) for rows in (residuals, f))
        other_power = max(signal - 2.0 * other_m * other + other_m**2 * size, 0.0)
        moved = np.sqrt(np.maximum(np.linalg.eigvalsh(H / (weights * (pull @ pull))), 0.0)).tolist()
        scale = 1.0
        if equation.noise is None:
            N = equation.N if kept is None else int(np.count_nonzero(kept))
            floor = max(FLOOR**2 * signal / N, np.finfo(float).tiny)  # for noise-free, or zero, readings
            scale = max(min(power, other_power) / max(3 * N - 7, 1), floor)
        return cls(R, H, S, m, other_m, power, signal, moved, (other_power - power) / scale)


def likely_samples(equation: WeightEquation) -> np.ndarray:
    """Return the mask (N,) of the samples for the initial guess, selected by a robust linear regression.

    Forces are linear in the tool orientation, ``f_i = sum_k c_k (R_i)_k + b``; for known gravity, they are linear in
    gravity in tool axes. The regression minimises ``sum |r_i|``, which is convex and robust against contacts.
    """
    X = equation.RA.reshape(equation.N, 9) if equation.pull is None else equation.pull @ equation.RA
    if equation.bias:
        X = np.hstack([X - X.mean(axis=0), np.ones((equation.N, 1))])
    U, size, _ = np.linalg.svd(X, full_matrices=False)
    Q, f, w = U[:, size > NULL * size[0]], equation.y[:, :3], np.ones(equation.N)
    r = w
    if 2 * Q.shape[1] > equation.N:  # the regression would interpolate half of the samples
        return np.ones(equation.N, dtype=bool)
    for _ in range(ROUNDS):
        weighted = Q.T * w
        r = np.linalg.norm(f - Q @ np.linalg.lstsq(weighted @ Q, weighted @ f, rcond=None)[0], axis=1)
        before, w = w, 1.0 / np.maximum(r, max(SHORT * float(np.median(r)), np.finfo(float).tiny))
        w = w / w.max()
        if np.abs(w - before).max() < SETTLED:
            break
    return r <= FAR * np.median(r)


def mirror_solution(equation: WeightEquation, load: Load) -> Load | None:
    """Return the load with its weight reversed and the sensor rotated by half a turn about the weight.

    Both loads fit equally well to first order in the tilts, because ``R^T (u x w) = (H R)^T (-u x w)`` with H the half
    turn about u; the bias absorbs the mean. Returns None for large tilts or without a bias.
    """
    u = load.gamma @ equation.RA.mean(axis=0)
    length = float(np.linalg.norm(u))
    if not equation.bias or length <= ALIKE * np.linalg.norm(load.gamma):
        return None
    R, gamma = so3.exp(np.pi * u / length) @ load.R, -load.gamma
    expected = gamma @ (equation.RA @ R)
    if equation.torque:
        expected = np.hstack([expected, np.cross(load.centre, expected)])
    return Load(R, gamma, np.median(equation.y - expected, axis=0), load.centre)
