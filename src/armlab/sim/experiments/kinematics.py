"""Kinematic calibration experiments with known ground truth; reordering the code changes the random numbers.

The arm is an IRB 2400 with a perturbed DH table or perturbed frames; poses, distances or a second arm serve as
measurements. The ground truth is computed frame by frame, independently of the kernels used by the fits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from armlab.lie import se3, so3
from armlab.robots import Robot, from_local_poe
from armlab.sim.experiments import sensors

DEGREE = np.pi / 180.0
ALPHA = np.array([-90.0, 0.0, -90.0, -90.0, 90.0, 0.0]) * DEGREE
A = np.array([0.1, 0.705, 0.135, 0.0, 0.0, 0.0])
D = np.array([0.615, 0.0, 0.0, 0.755, 0.0, 0.085])
OFFSET = np.array([0.0, -90.0, 0.0, 180.0, 0.0, 0.0]) * DEGREE
TOOL = (0.1, 0.05, 0.1)
NOISE = (1e-4, 0.01 * DEGREE)  # m, rad
VALIDATION = 200
POINTS = np.array([[0.05, 0.0, 0.02], [-0.03, 0.06, 0.0], [0.0, -0.04, 0.07]])
ANCHOR = np.array([1.5, 0.3, 0.2])
TURN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class LocalArm:
    """``T = F_1 exp(xi_1 q_1) ... F_{n+1}``, with amplitudes (n, 2 m) of joint errors of orders 1 to m."""

    frames: np.ndarray
    screws: np.ndarray
    amplitudes: np.ndarray

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Return the tool poses (N, 4, 4)."""
        turned, T = np.array(q, dtype=float), np.broadcast_to(np.eye(4), (len(q), 4, 4))
        for k in range(self.amplitudes.shape[1] // 2):
            cosine, sine = self.amplitudes[:, 2 * k], self.amplitudes[:, 2 * k + 1]
            turned += cosine * np.cos((k + 1) * q) + sine * np.sin((k + 1) * q)
        for frame, screw, angle in zip(self.frames, self.screws, turned.T):
            T = T @ frame @ se3.exp(screw * angle[:, None])
        return T @ self.frames[-1]


@dataclass(frozen=True, eq=False)
class KinematicRun:
    """Experiment with a nominal robot, the true arm, joint positions, noisy poses and a validation set."""

    noise: ClassVar[tuple[float, float]] = NOISE  # noise of the poses (m, rad)
    robot: Robot
    truth: LocalArm
    q: np.ndarray
    pose: np.ndarray
    q_valid: np.ndarray
    pose_valid: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments for `calibrate.fit_kinematics`."""
        return {"robot": self.robot, "q": self.q, "pose": self.pose}

    def error(self, T: np.ndarray) -> tuple[float, float]:
        """Return the RMS position error [mm] and angle error [deg] of validation poses (200, 4, 4)."""
        away = np.sum((T - self.pose_valid)[:, :3, 3] ** 2, axis=1)
        turn = so3.angle(T[:, :3, :3], self.pose_valid[:, :3, :3])
        return 1e3 * float(np.sqrt(np.mean(away))), float(np.sqrt(np.mean(turn**2))) / DEGREE

    def points(self, K: int) -> np.ndarray:
        """Return positions (N, K, 3) of up to three points on the measured tool."""
        return self.pose[:, None, :3, 3] + np.einsum("nab,kb->nka", self.pose[:, :3, :3], POINTS[:K])


def dh_arm(table: tuple[np.ndarray, ...] = (OFFSET, D, A, ALPHA), tool: bool = False) -> LocalArm:
    """Return the arm of a DH table (theta, d, a, alpha): ``A = Rz(q + theta) Tz(d) Tx(a) Rx(alpha)``, F = A(0)."""
    frames = [_dh(*row) for row in zip(*table)]
    end = np.eye(4)
    end[:3, 3] = TOOL if tool else (0.0, 0.0, 0.0)
    screws = np.stack([se3.adjoint_inv(frame) @ TURN for frame in frames])
    return LocalArm(np.stack([*frames, end]), screws, np.zeros((len(frames), 0)))


def _dh(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    along = se3.from_rp(so3.exp([0.0, 0.0, theta]), [0.0, 0.0, d])
    return along @ se3.from_rp(so3.exp([alpha, 0.0, 0.0]), [a, 0.0, 0.0])


def as_robot(arm: LocalArm, name: str = "irb2400") -> Robot:
    """Return the nominal robot."""
    return from_local_poe(name, arm.frames, arm.screws)


def sliding_robot() -> Robot:
    """Return an arm whose third joint is prismatic."""
    arm = dh_arm(tool=True)
    screws = arm.screws.copy()
    screws[2] = [0.0, np.sin(0.3), np.cos(0.3), 0.0, 0.0, 0.0]
    return from_local_poe("5r1p", arm.frames, screws)


def moved(arm: LocalArm, shifts: np.ndarray, turns: np.ndarray) -> LocalArm:
    """Return the arm with perturbed frames ``F_j [Exp(turn), shift]``."""
    return LocalArm(arm.frames @ se3.from_rp(so3.exp(turns), shifts), arm.screws, arm.amplitudes)


def noisy(T: np.ndarray, rng: np.random.Generator, noise: tuple[float, float] = NOISE) -> np.ndarray:
    """Return poses with noise (m, rad); the rotation noise is drawn first."""
    return sensors.noisy(rng, T, noise)


def perturbed(rng: np.random.Generator, truth: str, tool: bool) -> LocalArm:
    """Return the true arm: "lpoe" perturbs every frame, "dh" every DH parameter."""
    if truth == "dh":
        e = rng.standard_normal((6, 4)) * [0.1 * DEGREE, 5e-4, 5e-4, 0.1 * DEGREE]
        return dh_arm((OFFSET + e[:, 0], D + e[:, 1], A + e[:, 2], ALPHA + e[:, 3]), tool)
    shifts = 5e-4 * rng.standard_normal((7, 3))
    return moved(dh_arm(tool=tool), shifts, 0.1 * DEGREE * rng.standard_normal((7, 3)))


def kinematic_run(
    run: int,
    seed: int = 2000,
    n: int = 50,
    truth: str = "lpoe",
    tool: bool = False,
    harmonics: bool = False,
    wrong: int = 0,
) -> KinematicRun:
    """Return experiment K1, K2, K3, K4 or K7; see `CalibrationCell.kinematics`."""
    rng = np.random.default_rng([seed, run])
    arm = perturbed(rng, truth, tool)
    q, q_valid = (rng.uniform(-np.pi, np.pi, (m, 6)) for m in (n, VALIDATION))
    if harmonics:
        arm = LocalArm(arm.frames, arm.screws, 0.02 * DEGREE * rng.standard_normal((6, 4)))
    pose = spoilt(noisy(arm.forward(q), rng), rng, wrong, 2.0 * DEGREE, 0.02)
    return KinematicRun(as_robot(dh_arm(tool=tool)), arm, q, pose, q_valid, arm.forward(q_valid))


@dataclass(frozen=True, eq=False)
class DistanceRun(KinematicRun):
    """Experiment with an anchor point (3,), its distances (N,) from the tool, and its initial `guess`."""

    noise_distance: ClassVar[float] = 5e-5  # m
    anchor: np.ndarray
    guess: np.ndarray
    distance: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments for `calibrate.fit_kinematics`."""
        return {"robot": self.robot, "q": self.q, "distance": self.distance, "anchor": self.guess}


def distance_run(run: int, seed: int = 2300, n: int = 120) -> DistanceRun:
    """Return experiment K5 with an anchor point and distances with 0.05 mm of noise."""
    rng = np.random.default_rng([seed, run])
    arm = perturbed(rng, "lpoe", True)
    q, q_valid = (rng.uniform(-np.pi, np.pi, (m, 6)) for m in (n, VALIDATION))
    anchor = ANCHOR + 0.01 * rng.standard_normal(3)
    pose = arm.forward(q)
    away = np.linalg.norm(pose[:, :3, 3] - anchor, axis=1)
    distance = away + DistanceRun.noise_distance * rng.standard_normal(n)
    robot = as_robot(dh_arm(tool=True))
    return DistanceRun(robot, arm, q, pose, q_valid, arm.forward(q_valid), anchor, ANCHOR.copy(), distance)


def spoilt(pose: np.ndarray, rng: np.random.Generator, wrong: int, angle: float, length: float) -> np.ndarray:
    """Return poses with outliers: the first `wrong` poses are rotated and shifted in random directions."""
    pose = pose.copy()
    for T in pose[:wrong]:
        u, v = (w / np.linalg.norm(w) for w in rng.standard_normal((2, 3)))
        T[:3, :3] = T[:3, :3] @ so3.exp(angle * u)
        T[:3, 3] += length * v
    return pose


@dataclass(frozen=True, eq=False)
class DualRun:
    """Experiment with two nominal robots, the true arms, joint positions, and poses of tool b relative to tool a."""

    noise: ClassVar[tuple[float, float]] = NOISE  # noise of the poses (m, rad)
    robot_a: Robot
    robot_b: Robot
    truth_a: LocalArm
    truth_b: LocalArm
    T_basea_baseb: np.ndarray
    q_a: np.ndarray
    q_b: np.ndarray
    pose: np.ndarray
    q_valid_a: np.ndarray
    q_valid_b: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments for `calibrate.fit_dual_arm`."""
        names = ("robot_a", "robot_b", "q_a", "q_b", "pose")
        return {name: getattr(self, name) for name in names}

    def relative(self, q_a: np.ndarray, q_b: np.ndarray) -> np.ndarray:
        """Return ``T_a^-1 T_basea_baseb T_b`` (N, 4, 4)."""
        return se3.inv(self.truth_a.forward(q_a)) @ self.T_basea_baseb @ self.truth_b.forward(q_b)


NOMINAL_PAIR = se3.from_rp(so3.exp([0.0, 0.0, np.pi]), [1.8, 0.0, 0.0])


def dual_run(run: int, seed: int = 2400, n: int = 60, wrong: int = 0) -> DualRun:
    """Return experiment K6 with two arms whose tools face each other, and outliers as in K7."""
    rng = np.random.default_rng([seed, run])
    arms = []
    for _ in range(2):
        turns = 0.1 * DEGREE * rng.standard_normal((7, 3))
        arms.append(moved(dh_arm(tool=True), 5e-4 * rng.standard_normal((7, 3)), turns))
    turn = so3.exp(DEGREE * rng.standard_normal(3))
    T_basea_baseb = NOMINAL_PAIR @ se3.from_rp(turn, 5e-3 * rng.standard_normal(3))
    q_a, q_b, q_valid_a, q_valid_b = (rng.uniform(-np.pi, np.pi, (m, 6)) for m in (n, n, VALIDATION, VALIDATION))
    robots = [as_robot(dh_arm(tool=True), name) for name in ("arm_a", "arm_b")]
    found = DualRun(robots[0], robots[1], arms[0], arms[1], T_basea_baseb, q_a, q_b, np.zeros(0), q_valid_a, q_valid_b)
    pose = noisy(found.relative(q_a, q_b), rng)
    return replace(found, pose=spoilt(pose, rng, wrong, 2.0 * DEGREE, 0.02))
