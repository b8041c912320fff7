"""Experiments of known truth that several test files share; the draws are in the order of the specification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from armlab.lie import quaternion, se3, so3

CAMERA = (0.5e-3, np.radians(0.05))


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a robot and of a marker, with the truth behind them."""

    A: np.ndarray
    B: np.ndarray
    X: np.ndarray
    Y: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments of the fit."""
        return {"T_base_tool": self.A, "T_cam_marker": self.B}


class HandEyeData:
    """Generators H1 to H4."""

    camera = CAMERA

    def rotations(self, rng: np.random.Generator, count: int) -> np.ndarray:
        q = rng.standard_normal((count, 4))
        return quaternion.to_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))

    def tilted(self, rng: np.random.Generator, count: int, angle: float) -> np.ndarray:
        axes = rng.standard_normal((count, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        middle = self.rotations(rng, 1)[0]
        return middle @ so3.exp(axes * rng.uniform(0.0, angle, count)[:, None])

    def noisy(self, rng: np.random.Generator, T: np.ndarray, noise: tuple[float, float]) -> np.ndarray:
        R = T[:, :3, :3] @ so3.exp(noise[1] * rng.standard_normal((len(T), 3)))
        return se3.from_rp(R, T[:, :3, 3] + noise[0] * rng.standard_normal((len(T), 3)))

    def draw(
        self,
        seed: Any,
        N: int = 30,
        tilt: float | None = None,
        camera: tuple[float, float] = CAMERA,
        robot: tuple[float, float] | None = None,
    ) -> Poses:
        """H1; H2 with tilt [rad]; H4 with noise of the robot."""
        rng = np.random.default_rng(seed)
        RX, tX = self.rotations(rng, 1)[0], 0.1 * rng.standard_normal(3)
        RY, tY = self.rotations(rng, 1)[0], rng.standard_normal(3)
        X, Y = se3.from_rp(RX, tX), se3.from_rp(RY, tY)
        R = self.rotations(rng, N) if tilt is None else self.tilted(rng, N, tilt)
        A = se3.from_rp(R, rng.uniform(-0.5, 0.5, (N, 3)))
        B = self.noisy(rng, se3.inv(Y) @ A @ X, camera)
        return Poses(A if robot is None else self.noisy(rng, A, robot), B, X, Y)

    def spoilt(self, rng: np.random.Generator, B: np.ndarray, bad: list[int]) -> np.ndarray:
        """H3: some poses of the marker turned by 10 degrees and moved by 50 mm."""
        B = B.copy()
        for i in bad:
            u, v = rng.standard_normal(3), rng.standard_normal(3)
            B[i, :3, :3] = B[i, :3, :3] @ so3.exp(np.radians(10.0) * u / np.linalg.norm(u))
            B[i, :3, 3] += 0.05 * v / np.linalg.norm(v)
        return B


@pytest.fixture(scope="session")
def hand_eye() -> HandEyeData:
    return HandEyeData()


@dataclass(frozen=True, eq=False)
class Sights:
    """Poses of a robot and points of a marker, with the truth behind them."""

    A: np.ndarray
    p: np.ndarray
    X: np.ndarray
    Y: np.ndarray
    visible: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments of the fit."""
        return {"T_base_tool": self.A, "p_cam": self.p}


class MarkerData:
    """Generator H5: three LEDs."""

    marker = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])
    sigma = 0.5e-3

    def draw(self, seed: Any, N: int = 100, sigma: float = 0.5e-3) -> Sights:
        rng = np.random.default_rng(seed)

        def poses(count: int, size: float) -> np.ndarray:
            n = rng.standard_normal((count, 12))  # per pose nine numbers, then three
            return se3.from_rp(so3.project(n[:, :9].reshape(-1, 3, 3))[0], size * n[:, 9:])

        A = poses(N, 0.5)
        Y, X = poses(1, 1.0)[0], poses(1, 0.1)[0]
        T = se3.inv(Y) @ A @ X
        p = np.einsum("nij,kj->nki", T[:, :3, :3], self.marker) + T[:, None, :3, 3]
        p = p + sigma * rng.standard_normal((N, 3, 3))
        return Sights(A, p, X, Y, rng.random((N, 3)) >= 0.2)


@pytest.fixture(scope="session")
def leds() -> MarkerData:
    return MarkerData()


@dataclass(frozen=True, eq=False)
class Weighed:
    """Orientations of a tool and readings of what hangs on it, with the truth behind them."""

    RA: np.ndarray
    y: np.ndarray
    R: np.ndarray
    bias: np.ndarray
    centre: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments of the fit."""
        return {"T_base_tool": self.RA, "wrench": self.y, "gravity": ForceData.gravity}


class ForceData(HandEyeData):
    """Generators F1, F2 and F4: 1 kg."""

    gravity = np.array([0.0, 0.0, -9.82])

    def draw(  # type: ignore[override]
        self, seed: Any, N: int = 100, sigma: float = 0.1, tilt: float | None = None, torque: float | None = None
    ) -> Weighed:
        """F1; F2 with tilt [rad]; F4 with the noise of the torque [N m]. Biases are -R^T o of the specification."""
        rng = np.random.default_rng(seed)
        R, o = self.rotations(rng, 1)[0], rng.standard_normal(3)
        RA = self.rotations(rng, N) if tilt is None or torque is not None else self.tilted(rng, N, tilt)
        r, o_tau = (0.1 * rng.standard_normal((2, 3))) if torque is not None else (np.full(3, np.nan), np.zeros(0))
        u = self.gravity @ RA @ R
        y = u - o @ R + sigma * rng.standard_normal((N, 3))
        if torque is not None:
            y = np.hstack([y, np.cross(r, u) - o_tau + torque * rng.standard_normal((N, 3))])
        return Weighed(RA, y, R, np.concatenate([-o @ R, -o_tau]), r)

    def touched(self, rng: np.random.Generator, y: np.ndarray, rows: Any) -> np.ndarray:
        """F3: contacts of 20 N."""
        y = y.copy()
        y[rows, :3] += 20.0 * self.rotations(rng, len(y[rows]))[:, 0]
        return y


@pytest.fixture(scope="session")
def weights() -> ForceData:
    return ForceData()


@dataclass(frozen=True, eq=False)
class Scanned:
    """Scans of plates, with the truth behind them."""

    A: np.ndarray
    scans: np.ndarray
    plane: np.ndarray
    X: np.ndarray
    n: np.ndarray
    d: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments of the fit."""
        return {"T_base_tool": self.A, "scans": self.scans, "plane": self.plane}


class LaserData:
    """Generator L1, with many draws at once: plates e_j.x = 1, scans that hit them within 0.2 m."""

    sigma = 0.5e-3
    angle = 0.5e-3 * np.sqrt(12.0) / 0.2

    def turns(self, angles: np.ndarray) -> np.ndarray:
        """Rz(r) Ry(p) Rx(y)."""
        r, p, y = (so3.exp(angles[..., i, None] * np.eye(3)[2 - i]) for i in range(3))
        return r @ p @ y

    def draw(self, seed: Any, N: int = 60, size: float = 1.0, plates: int = 3) -> Scanned:
        rng = np.random.default_rng(seed)
        X = se3.from_rp(self.turns(rng.standard_normal(3)), 0.5 * rng.standard_normal(3))
        poses, scans, plane = [], [], np.arange(N) % plates
        for j in range(plates):
            need = int(np.sum(plane == j))
            while need:
                A, scan = self.hits(rng, X, j)
                poses.append((A[:need], np.flatnonzero(plane == j)[-need:][: len(A)]))
                scans.append(scan[:need])
                need -= len(A[:need])
        order = np.argsort(np.concatenate([at for _, at in poses]))
        A, scan = np.concatenate([T for T, _ in poses])[order], np.concatenate(scans)[order]
        turn = size * self.angle * rng.standard_normal(N)
        p = scan[:, :2] + size * self.sigma * rng.standard_normal((N, 2))
        c, s = np.cos(turn), np.sin(turn)
        line = np.column_stack([c * scan[:, 2] - s * scan[:, 3], s * scan[:, 2] + c * scan[:, 3]])
        return Scanned(A, np.hstack([p, line]), plane, X, np.eye(3)[:plates], np.ones(plates))

    def hits(self, rng: np.random.Generator, X: np.ndarray, j: int) -> tuple[np.ndarray, np.ndarray]:
        e = np.eye(3)[j]
        A = se3.from_rp(self.turns(1.5 * rng.standard_normal((1500, 3))), 0.6 * rng.standard_normal((1500, 3)) + 2 * e)
        S = A @ X
        line = np.cross(e, S[:, :3, 2])
        line /= np.linalg.norm(line, axis=1, keepdims=True)
        local = np.einsum("nij,ni->nj", S[:, :3, :3], line)
        reach = (1.0 - S[:, j, 3]) / S[:, j, 1]
        steep = np.hypot(S[:, j, 0], S[:, j, 1]) > 0.06  # flatter scans are refused
        good = steep & (reach >= 0) & (reach <= 0.2) & (local[:, 1] >= -0.5)
        return A[good], np.column_stack([np.zeros(good.sum()), reach[good], local[good, :2]])


@pytest.fixture(scope="session")
def laser() -> LaserData:
    return LaserData()
