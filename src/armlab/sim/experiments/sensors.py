"""Sensor experiments with known ground truth: hand-eye at rest and in motion, force sensor, accelerometer, scanner.

Reordering the code changes the random numbers. The scanned plates e_j.x = 1 are at ranges of up to 0.2 m. Scans
are drawn in batches, so their distribution follows the specification, but the individual samples differ. Scans nearly
parallel to a plate are redrawn, because the fit would reject them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.kinematics import forward
from armlab.lie import quaternion, se3, so3
from armlab.robots import Robot, load

if TYPE_CHECKING:
    from armlab.log import Table

CAMERA = (0.5e-3, np.radians(0.05))  # m, rad
MARKER = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])


@dataclass(frozen=True, eq=False)
class Poses:
    """Noisy poses A of a robot and B of a marker, and the ground truth: X, Y, and the noise-free poses."""

    A: np.ndarray
    B: np.ndarray
    X: np.ndarray
    Y: np.ndarray
    A_exact: np.ndarray
    B_exact: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments for `calibrate.fit_hand_eye`."""
        return {"T_base_tool": self.A, "T_cam_marker": self.B}


@dataclass(frozen=True, eq=False)
class Sights:
    """Noisy robot poses A and marker points p (N, 3, 3), and the ground truth: X, Y, noise-free poses and points."""

    A: np.ndarray
    p: np.ndarray
    X: np.ndarray
    Y: np.ndarray
    visible: np.ndarray
    A_exact: np.ndarray
    p_exact: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments for `calibrate.fit_hand_eye_points`."""
        return {"T_base_tool": self.A, "p_cam": self.p}


def rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return uniformly distributed random rotations (count, 3, 3)."""
    q = rng.standard_normal((count, 4))
    return quaternion.to_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))


def tilted(rng: np.random.Generator, count: int, angle: float) -> np.ndarray:
    """Return rotations (count, 3, 3) within `angle` [rad] of a random rotation."""
    axes = rng.standard_normal((count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    middle = rotations(rng, 1)[0]
    return middle @ so3.exp(axes * rng.uniform(0.0, angle, count)[:, None])


def noisy(rng: np.random.Generator, T: np.ndarray, noise: tuple[float, float]) -> np.ndarray:
    """Return poses (N, 4, 4) with noise (m, rad); the rotation noise is drawn first."""
    R = T[:, :3, :3] @ so3.exp(noise[1] * rng.standard_normal((len(T), 3)))
    return se3.from_rp(R, T[:, :3, 3] + noise[0] * rng.standard_normal((len(T), 3)))


def spoilt(rng: np.random.Generator, B: np.ndarray, bad: Any) -> np.ndarray:
    """Return poses with outliers that are rotated by 10 degrees and moved by 50 mm (H3)."""
    B = B.copy()
    for i in bad:
        u, v = rng.standard_normal(3), rng.standard_normal(3)
        B[i, :3, :3] = B[i, :3, :3] @ so3.exp(np.radians(10.0) * u / np.linalg.norm(u))
        B[i, :3, 3] += 0.05 * v / np.linalg.norm(v)
    return B


def seen_poses(
    seed: Any,
    N: int = 30,
    tilt: float | None = None,
    camera: tuple[float, float] = CAMERA,
    robot: tuple[float, float] | None = None,
    wrong: int = 0,
) -> Poses:
    """Return experiment H1, or H2 with `tilt` [rad], H3 with `wrong` outliers, H4 with `robot` noise."""
    rng = np.random.default_rng(seed)
    RX, tX = rotations(rng, 1)[0], 0.1 * rng.standard_normal(3)
    RY, tY = rotations(rng, 1)[0], rng.standard_normal(3)
    X, Y = se3.from_rp(RX, tX), se3.from_rp(RY, tY)
    R = rotations(rng, N) if tilt is None else tilted(rng, N, tilt)
    A = se3.from_rp(R, rng.uniform(-0.5, 0.5, (N, 3)))
    exact = se3.inv(Y) @ A @ X
    B = spoilt(rng, noisy(rng, exact, camera), range(wrong))
    return Poses(A if robot is None else noisy(rng, A, robot), B, X, Y, A, exact)


def seen_points(
    seed: Any,
    N: int = 100,
    sigma: float = 0.5e-3,
    missing: float = 0.2,
    robot: tuple[float, float] | None = None,
) -> Sights:
    """Return experiment H5 with three LEDs, some of them hidden, and optional robot noise."""
    rng = np.random.default_rng(seed)

    def poses(count: int, size: float) -> np.ndarray:
        n = rng.standard_normal((count, 12))  # nine numbers per pose, then three
        return se3.from_rp(so3.project(n[:, :9].reshape(-1, 3, 3))[0], size * n[:, 9:])

    A = poses(N, 0.5)
    Y, X = poses(1, 1.0)[0], poses(1, 0.1)[0]
    T = se3.inv(Y) @ A @ X
    exact = np.einsum("nij,kj->nki", T[:, :3, :3], MARKER) + T[:, None, :3, 3]
    p = exact + sigma * rng.standard_normal((N, 3, 3))
    visible = rng.random((N, 3)) >= missing
    return Sights(A if robot is None else noisy(rng, A, robot), p, X, Y, visible, A, exact)


RATE = 250.0  # Hz
REACH = 0.7  # rad, in each direction
SLOW, FAST = 0.05, 0.12  # Hz
AHEAD = 0.2  # s from the first row of the arm's recording to the first image


@dataclass(frozen=True, eq=False)
class MovingSights:
    """Recordings of joint positions q and poses T_cam_marker during one motion, and the true poses."""

    robot: Robot
    arm: Table
    camera: Table
    T_tool_marker: np.ndarray
    T_base_cam: np.ndarray


def moving_sights(seed: Any, looked: np.ndarray) -> MovingSights:
    """Return both recordings of a smooth IRB 2400 motion, with images at the times `looked` (N,) [s]."""
    from armlab.log import Column, Table  # lazy import, because `armlab sim` does not need it

    rng, robot = np.random.default_rng(seed), load("irb2400")
    frequency, phase = rng.uniform(SLOW, FAST, robot.n), rng.uniform(-np.pi, np.pi, robot.n)
    looked = looked + AHEAD

    def joints(t: np.ndarray) -> np.ndarray:
        return REACH * np.sin(2.0 * np.pi * frequency * t[:, None] + phase)

    X = se3.from_rp(rotations(rng, 1)[0], 0.1 * rng.standard_normal(3))
    Y = se3.from_rp(rotations(rng, 1)[0], rng.standard_normal(3))
    seen = noisy(rng, se3.inv(Y) @ forward(robot, joints(looked)) @ X, CAMERA)
    t = np.arange(0.0, looked[-1] + AHEAD, 1.0 / RATE)
    arm = Table(t, {"q": joints(t)})
    camera = Table(looked, {"T_cam_marker": seen}, {"T_cam_marker": Column(unit="1", kind="pose")})
    return MovingSights(robot, arm, camera, X, Y)


GRAVITY = np.array([0.0, 0.0, -9.82])
STANDARD = np.array([0.0, 0.0, -9.80665])
CONTACT = 20.0  # N


@dataclass(frozen=True, eq=False)
class Weighed:
    """Tool orientations and readings of a sensor with a load, and the ground truth.

    `bias` contains -R^T o in the notation of the specification, followed by the torque bias. `weight` is in base axes.
    `exact` contains the readings without noise and contact; `touched` marks the samples with contact.
    """

    RA: np.ndarray
    y: np.ndarray
    R: np.ndarray
    bias: np.ndarray
    centre: np.ndarray
    weight: np.ndarray
    exact: np.ndarray
    touched: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments for `calibrate.fit_force_sensor`."""
        return {"T_base_tool": self.RA, "wrench": self.y, "gravity": GRAVITY}


def weighed(
    seed: Any,
    N: int = 100,
    sigma: float = 0.1,
    tilt: float | None = None,
    torque: float | None = None,
    unknown: bool = False,
    bias: bool = True,
    contacts: int = 0,
) -> Weighed:
    """Return experiment F1, or F2 with `tilt` [rad], F3 with `contacts`, F4 with `torque`, F5 with `unknown`."""
    rng = np.random.default_rng(seed)
    R = rotations(rng, 1)[0]
    weight = GRAVITY
    if unknown:
        weight = rng.standard_normal(3)
        weight = 9.82 * weight / np.linalg.norm(weight)
    o = rng.standard_normal(3) if bias else np.zeros(3)
    RA = rotations(rng, N)
    if tilt is not None:
        RA = tilted(rng, N, tilt)
    r, o_tau = 0.1 * rng.standard_normal((2, 3)) if torque is not None else (np.full(3, np.nan), np.zeros(0))
    u = weight @ RA @ R
    exact = u - o @ R
    y = exact + sigma * rng.standard_normal((N, 3))
    there = np.arange(N) < contacts
    if contacts:
        y = touched(rng, y, there)
    if torque is not None:
        exact = np.hstack([exact, np.cross(r, u) - o_tau])
        y = np.hstack([y, exact[:, 3:] + torque * rng.standard_normal((N, 3))])
    return Weighed(RA, y, R, np.concatenate([-o @ R, -o_tau]), r, weight, exact, there)


def touched(rng: np.random.Generator, y: np.ndarray, rows: Any) -> np.ndarray:
    """Return readings with contacts of 20 N in some rows (F3)."""
    y = y.copy()
    y[rows, :3] += CONTACT * rotations(rng, len(y))[rows, 0]
    return y


def accelerated(seed: Any, N: int = 50, sigma: float = 0.02) -> Weighed:
    """Return experiment F6: an accelerometer at rest."""
    rng = np.random.default_rng(seed)
    R = rotations(rng, 1)[0]
    bias = 0.2 * rng.standard_normal(3)
    RA = rotations(rng, N)
    exact = -STANDARD @ RA @ R + bias
    y = exact + sigma * rng.standard_normal((N, 3))
    return Weighed(RA, y, R, bias, np.full(3, np.nan), -STANDARD, exact, np.zeros(N, dtype=bool))


SIGMA = 0.5e-3  # m
ANGLE = SIGMA * np.sqrt(12.0) / 0.2  # rad, of a line fitted over 0.2 m
TRIES = 1500
FLATTEST = 0.06  # sine of the angle between plate and laser plane


@dataclass(frozen=True, eq=False)
class Scanned:
    """Scans of plates, and the ground truth: sensor pose X, normals n, offsets d, and noise-free scans."""

    A: np.ndarray
    scans: np.ndarray
    plane: np.ndarray
    X: np.ndarray
    n: np.ndarray
    d: np.ndarray
    exact: np.ndarray

    @property
    def given(self) -> dict[str, Any]:
        """Arguments for `calibrate.fit_laser_plane`."""
        return {"T_base_tool": self.A, "scans": self.scans, "plane": self.plane}


def turns(angles: np.ndarray) -> np.ndarray:
    """Return Rz(r) Ry(p) Rx(y) for angles (..., 3)."""
    r, p, y = (so3.exp(angles[..., i, None] * np.eye(3)[2 - i]) for i in range(3))
    return r @ p @ y


def scanned(seed: Any, N: int = 60, size: float = 1.0, plates: int = 3, wrong: int = 0) -> Scanned:
    """Return experiment L1 with noise of `size` times 0.5 mm, or L3 with the first `wrong` scans as outliers."""
    rng = np.random.default_rng(seed)
    X = se3.from_rp(turns(rng.standard_normal(3)), 0.5 * rng.standard_normal(3))
    plane = np.arange(N) % plates
    A, scan = np.empty((N, 4, 4)), np.empty((N, 4))
    for j in range(plates):
        at = np.flatnonzero(plane == j)
        while len(at):
            T, hit = hits(rng, X, j)
            A[at[: len(T)]], scan[at[: len(T)]] = T[: len(at)], hit[: len(at)]
            at = at[len(T) :]
    turn = size * ANGLE * rng.standard_normal(N)
    p = scan[:, :2] + size * SIGMA * rng.standard_normal((N, 2))
    p[:wrong, 1] += 0.02
    turn[:wrong] += np.radians(10.0)
    c, s = np.cos(turn), np.sin(turn)
    line = np.column_stack([c * scan[:, 2] - s * scan[:, 3], s * scan[:, 2] + c * scan[:, 3]])
    return Scanned(A, np.hstack([p, line]), plane, X, np.eye(3)[:plates], np.ones(plates), scan)


def hits(rng: np.random.Generator, X: np.ndarray, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the tool poses and exact lines (n, 4) of random trials that hit plate j."""
    e = np.eye(3)[j]
    A = se3.from_rp(turns(1.5 * rng.standard_normal((TRIES, 3))), 0.6 * rng.standard_normal((TRIES, 3)) + 2 * e)
    S = A @ X
    line = np.cross(e, S[:, :3, 2])
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    local = np.einsum("nij,ni->nj", S[:, :3, :3], line)
    reach = (1.0 - S[:, j, 3]) / S[:, j, 1]
    steep = np.hypot(S[:, j, 0], S[:, j, 1]) > FLATTEST
    good = steep & (reach >= 0) & (reach <= 0.2) & (local[:, 1] >= np.cos(np.radians(120.0)))
    return A[good], np.column_stack([np.zeros(good.sum()), reach[good], local[good, :2]])
