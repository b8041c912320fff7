"""The equation A_i X = Y B_i: closed-form start, residuals with their Jacobian, and how noise of A shows in them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from armlab import kernels
from armlab.estimation import Measurement, NonlinearProblem
from armlab.lie import so3

CLASSES = ("t",) * 3 + ("R",) * 3


class Pair(NamedTuple):
    """Two poses, X and Y."""

    RX: np.ndarray
    tX: np.ndarray
    RY: np.ndarray
    tY: np.ndarray

    def plus(self, x: np.ndarray) -> Pair:
        """Return the pair after a step x = (v_X, w_X, v_Y, w_Y): v in the parent's axes, w in the child's."""
        turn = so3.exp(x.reshape(4, 3)[1::2])
        return Pair(self.RX @ turn[0], self.tX + x[:3], self.RY @ turn[1], self.tY + x[6:9])

    def parameters(self) -> np.ndarray:
        """Return position and rotation vector of both poses (12,)."""
        return np.concatenate([self.tX, so3.log(self.RX), self.tY, so3.log(self.RY)])

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return X and Y (4, 4)."""
        X, Y = np.eye(4), np.eye(4)
        X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3] = self.RX, self.tX, self.RY, self.tY
        return X, Y


@dataclass(frozen=True, eq=False)
class Equation:
    """Pairs of poses.

    Attributes
    ----------
    RA, tA : (N, 3, 3) and (N, 3) of A. RB, tB : of B, which is measured.
    noise : of B: variances (6,) or covariance (6, 6) or (N, 6, 6); None when it is to be estimated.
    noise_A : of A, in the same forms; None when A is exact.
    """

    RA: np.ndarray
    tA: np.ndarray
    RB: np.ndarray
    tB: np.ndarray
    noise: np.ndarray | None = None
    noise_A: np.ndarray | None = None

    @property
    def N(self) -> int:
        """Number of pairs."""
        return len(self.tA)

    @cached_property
    def _sample(self) -> np.ndarray:
        """The numbers of the pairs (N,)."""
        return np.arange(self.N)

    @cached_property
    def mean(self) -> np.ndarray:
        """Mean of R_A (3, 3): no rotation, and the shorter the more they turn."""
        return self.RA.sum(axis=0) / self.N

    @cached_property
    def spread(self) -> float:
        """Length by which positions are judged [m]: their RMS distance from their mean, of the record that has more."""
        both = (t - t.sum(axis=0) / self.N for t in (self.tA, self.tB))
        return max(float(np.sqrt(np.vdot(t, t) / self.N)) for t in both) or 1.0

    def product(self) -> np.ndarray:
        """Return K = mean of R_A (x) R_B (9, 9), for which K vec(R_X) = vec(R_Y), row by row.

        Its largest singular value is 1 - sigma_R^2 where A and B belong together.
        """
        K = self.RA.reshape(-1, 9).T @ self.RB.reshape(-1, 9) / self.N
        return K.reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)

    def start(self) -> Pair:
        """Return rotations by the singular vectors of K, positions by least squares: no units, no guess."""
        U, _, V = np.linalg.svd(self.product())
        RX, RY = V[0].reshape(3, 3), U[:, 0].reshape(3, 3)
        (RX, RY), _ = kernels.so3_nearest(np.sign(np.linalg.det(RX)) * np.stack([RX, RY]))
        M, c = self.mean, self.tB @ RY.T - self.tA
        middle = c.sum(axis=0) / self.N
        pulled = c.ravel() @ self.RA.reshape(-1, 3) / self.N - M.T @ middle
        tX = np.linalg.solve(np.eye(3) - M.T @ M, pulled)
        return Pair(RX, tX, RY, M @ tX - middle)

    def evaluate(self, pair: Pair) -> list[Measurement]:
        """Return r_t = t_B - t_h in camera axes and r_R = Log(R_h^T R_B) in marker axes, where h = Y^-1 A X."""
        r, J = kernels.hand_eye_rows(self.RA, self.tA, self.RB, self.tB, *pair)
        of_A = self._noise_of_A(pair, -J[:, :3, :3])
        if self.noise is None:
            return [Measurement(r, J, None, CLASSES, self._sample, added=of_A)]
        return [Measurement(r, J, self.noise if of_A is None else full(self.noise) + of_A, CLASSES, self._sample)]

    def _noise_of_A(self, pair: Pair, C: np.ndarray) -> np.ndarray | None:
        """Return G S_A G^T (N, 6, 6), G = [[-R_Y^T, C hat(t_X)], [0, -R_X^T]]: the lever t_X couples both.

        Parameters
        ----------
        C : (N, 3, 3) R_Y^T R_A.
        """
        if self.noise_A is None:
            return None
        G = np.zeros((self.N, 6, 6))
        G[:, :3, :3] = -pair.RY.T
        G[:, :3, 3:] = C @ so3.hat(pair.tX)
        G[:, 3:, 3:] = -pair.RX.T
        return G @ full(self.noise_A) @ G.transpose(0, 2, 1)

    def problem(self) -> NonlinearProblem[Pair]:
        """Return what the solver needs."""
        return NonlinearProblem(self.evaluate, Pair.plus, what="hand-eye calibration")


def full(noise: np.ndarray) -> np.ndarray:
    """Return variances (k,) as a covariance (k, k); a covariance as it is."""
    return np.diag(noise) if noise.ndim == 1 else noise


def rotation_sd(noise: np.ndarray | None) -> float:
    """Return the deviation of one component of a rotation [rad] of a covariance of poses; 0 for None."""
    if noise is None:
        return 0.0
    variance = noise if noise.ndim == 1 else np.diagonal(noise, axis1=-2, axis2=-1)
    return float(np.sqrt(np.mean(variance[..., 3:])))


def robot_side(
    R: np.ndarray, t: np.ndarray, noise: np.ndarray | None, setup: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return rotations, positions and noise of A: of the robot's poses, or of their inverses with the eye in the hand.

    Parameters
    ----------
    R, t : (N, 3, 3), (N, 3) of T_base_tool. noise : of it; None or all zero where it is exact.
    """
    noise = noise if noise is not None and noise.any() else None
    if setup == "eye_to_hand":
        return R, t, noise
    inverse = np.ascontiguousarray(R.transpose(0, 2, 1))
    return inverse, -(inverse @ t[:, :, None])[:, :, 0], None if noise is None else inverse_noise(noise, R, t)


def inverse_noise(noise: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the covariance (N, 6, 6) of the inverses of noisy poses: v' = hat(p') w - R^T v, w' = -R w.

    Parameters
    ----------
    noise : of the poses. R, t : (N, 3, 3), (N, 3) of them; p' = -R^T t.
    """
    M = np.zeros((len(R), 6, 6))
    Rt = R.transpose(0, 2, 1)
    M[:, :3, :3] = -Rt
    M[:, :3, 3:] = so3.hat(-(Rt @ t[:, :, None])[:, :, 0])
    M[:, 3:, 3:] = -R
    return M @ full(noise) @ M.transpose(0, 2, 1)
