"""The equation A_i s_k = Y p_ik of points on the tool: linear start, residuals and Jacobian, known marker or not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from armlab.calibrate._hand_eye_equation import Pair, full
from armlab.estimation import Measurement, NonlinearProblem
from armlab.estimation.tsqr import triangle
from armlab.frames import marker_pose
from armlab.lie import so3
from armlab.models import HandEye


class Points(NamedTuple):
    """Points (K, 3) in tool axes, and Y."""

    s: np.ndarray
    RY: np.ndarray
    tY: np.ndarray

    def plus(self, x: np.ndarray) -> Points:
        """Return them after a step x = (s, v_Y, w_Y)."""
        return Points(self.s + x[:-6].reshape(-1, 3), self.RY @ so3.exp(x[-3:]), self.tY + x[-6:-3])

    def parameters(self) -> np.ndarray:
        """Return the points, and position and rotation vector of Y (3 K + 6,)."""
        return np.concatenate([self.s.ravel(), self.tY, so3.log(self.RY)])


class Linear(NamedTuple):
    """Solution of A_i s_k = M p_ik + t_Y with any matrix M; misfit: RMS of what is left [m]."""

    s: np.ndarray
    M: np.ndarray
    misfit: float


@dataclass(frozen=True, eq=False)
class Sight:
    """What was seen: one row per point that was visible in a sample.

    Attributes
    ----------
    RA, tA : (N, 3, 3), (N, 3) of the samples.
    p : (m, 3) measured points in camera axes. sample, point : (m,) which of them.
    K : number of points.
    noise : variances (3,) or covariance (3, 3) or (m, 3, 3); None when it is to be estimated.
    noise_A : of the poses of the samples: variances (6,) or covariance (6, 6) or (N, 6, 6); None when they are exact.
    """

    RA: np.ndarray
    tA: np.ndarray
    p: np.ndarray
    sample: np.ndarray
    point: np.ndarray
    K: int
    noise: np.ndarray | None
    noise_A: np.ndarray | None = None

    @cached_property
    def spread(self) -> float:
        """RMS distance of the measured points from their mean [m]."""
        t = self.p - self.p.mean(axis=0)
        return float(np.sqrt(np.vdot(t, t) / len(t))) or 1.0

    def only(self, keep: np.ndarray) -> Sight:
        """Return it with some of its rows (m,)."""
        noise = self.noise[keep] if self.noise is not None and self.noise.ndim == 3 else self.noise
        return replace(self, p=self.p[keep], sample=self.sample[keep], point=self.point[keep], noise=noise)

    @cached_property
    def solution(self) -> Linear:
        """Linear solution of all samples."""
        return self.linear(self.RA, self.tA)

    def linear(self, RA: np.ndarray, tA: np.ndarray) -> Linear:
        """Return the linear solution with these poses of the robot, (N, 3, 3) and (N, 3)."""
        A, t = RA[self.sample], tA[self.sample]
        m, n = len(self.p), 3 * self.K
        rows = np.zeros((m, 3, n + 13))
        rows[:, :, :n].reshape(m, 3, self.K, 3)[np.arange(m), :, self.point] = A
        for i in range(3):
            rows[:, i, n + 3 * i : n + 3 * i + 3] = -self.p
            rows[:, i, n + 9 + i] = -1.0
        rows[:, :, -1] = -t
        R = triangle(rows.reshape(3 * m, -1))
        scale = np.linalg.norm(R[:, :-1], axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        x = np.linalg.lstsq(R[:, :-1] / scale, R[:, -1], rcond=1e-9)[0] / scale
        misfit = float(np.linalg.norm(R[:, :-1] @ x - R[:, -1]) / np.sqrt(m))
        return Linear(x[:n].reshape(-1, 3), x[n : n + 9].reshape(3, 3), misfit)

    def start(self) -> Points:
        """Return Y with the rotation nearest to the linear solution, and points and position that go with it."""
        RY = so3.project(self.solution.M)[0]
        m, n = len(self.p), 3 * self.K
        rows = np.zeros((m, 3, n + 4))
        rows[:, :, :n].reshape(m, 3, self.K, 3)[np.arange(m), :, self.point] = self.RA[self.sample]
        rows[:, :, n : n + 3] = -np.eye(3)
        rows[:, :, -1] = self.p @ RY.T - self.tA[self.sample]
        R = triangle(rows.reshape(3 * m, -1))
        x = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=None)[0]
        return Points(x[:n].reshape(-1, 3), RY, x[n:])

    def seen(self, s: np.ndarray, RY: np.ndarray, tY: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return R_Y^T R_A (m, 3, 3), ph that should be seen (m, 3), and the derivative of p - ph by Y (m, 3, 6)."""
        C = (self.RA.transpose(0, 2, 1).reshape(-1, 3) @ RY).reshape(-1, 3, 3).transpose(0, 2, 1)[self.sample]
        ph = (C @ s[self.point][:, :, None])[:, :, 0] + ((self.tA - tY) @ RY)[self.sample]
        J = np.empty((len(ph), 3, 6))
        J[:, :, :3], J[:, :, 3:] = RY.T, -so3.hat(ph)
        return C, ph, J

    def residuals(self, value: HandEye) -> np.ndarray:
        """Return measured minus predicted (m, 3) in camera axes [m]."""
        return self.p - self.seen(np.asarray(value.points), value.Y[:3, :3], value.Y[:3, 3])[1]

    def free(self) -> NonlinearProblem[Points]:
        """Return the problem of points of unknown place."""

        def evaluate(value: Points) -> list[Measurement]:
            C, ph, JY = self.seen(*value)
            J = np.zeros((len(ph), 3, 3 * self.K + 6))
            J[:, :, : 3 * self.K].reshape(-1, 3, self.K, 3)[np.arange(len(ph)), :, self.point] = -C
            J[:, :, -6:] = JY
            return self._measured(ph, J, C, value.s, value.RY)

        return NonlinearProblem(evaluate, Points.plus, what="hand-eye calibration from points")

    def marked(self, marker: np.ndarray) -> NonlinearProblem[Pair]:
        """Return the problem of a marker whose points (K, 3) are known."""
        body = so3.hat(marker)

        def evaluate(value: Pair) -> list[Measurement]:
            s = marker @ value.RX.T + value.tX
            C, ph, JY = self.seen(s, value.RY, value.tY)
            J = np.empty((len(ph), 3, 12))
            J[:, :, :3], J[:, :, 3:6] = -C, C @ (value.RX @ body)[self.point]
            J[:, :, 6:] = JY
            return self._measured(ph, J, C, s, value.RY)

        return NonlinearProblem(evaluate, Pair.plus, what="hand-eye calibration from points")

    def _measured(
        self, ph: np.ndarray, J: np.ndarray, C: np.ndarray, s: np.ndarray, RY: np.ndarray
    ) -> list[Measurement]:
        """Return measured minus expected points; by sample with noise of the robot, which the points of a sample share.

        Parameters
        ----------
        ph : (m, 3) expected. J : (m, 3, d). C : (m, 3, 3) R_Y^T R_A. s : (K, 3) points in tool axes. RY : (3, 3).
        """
        r = self.p - ph
        if self.noise_A is None:
            return [Measurement(r, J, self.noise, ("p",) * 3, self.sample)]
        G = np.concatenate([np.broadcast_to(-RY.T, C.shape), C @ so3.hat(s[self.point])], axis=2)
        found = []
        for rows in self._together:
            n, width = len(rows), 3 * rows.shape[1]
            sample, lever = self.sample[rows[:, 0]], G[rows].reshape(n, width, 6)
            of_A = self.noise_A[sample] if self.noise_A.ndim == 3 else full(self.noise_A)
            shared = lever @ of_A @ lever.transpose(0, 2, 1)
            cov = None if self.noise is None else shared + self._apart(rows)
            one = (r[rows].reshape(n, width), J[rows].reshape(n, width, -1), cov, ("p",) * width, sample)
            found.append(Measurement(*one, added=shared if cov is None else None))
        return found

    @cached_property
    def _together(self) -> list[np.ndarray]:
        """Rows (n, v) of the samples that have v points, for every such v."""
        counts = np.bincount(self.sample)
        first = np.cumsum(counts) - counts
        return [first[counts == v][:, None] + np.arange(v) for v in np.unique(counts[counts > 0])]

    def _apart(self, rows: np.ndarray) -> np.ndarray:
        """Return the covariance (n, 3 v, 3 v) of noise that no two points share; rows (n, v)."""
        noise = np.zeros(3) if self.noise is None else self.noise
        n, v = rows.shape
        cov = np.zeros((n, v, 3, v, 3))
        for k in range(v):
            cov[:, k, :, k, :] = noise[rows[:, k]] if noise.ndim == 3 else full(noise)
        return cov.reshape(n, 3 * v, 3 * v)


def marked_start(free: Points, marker: np.ndarray) -> Pair:
    """Return X that puts the marker onto the points, and Y.

    Parameters
    ----------
    free : points in tool axes, and Y. marker : (K, 3) the points in marker axes.
    """
    X = marker_pose(free.s[None], marker).T[0]
    return Pair(X[:3, :3], X[:3, 3], free.RY, free.tY)
