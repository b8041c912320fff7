"""Start of a kinematic calibration: the nominal robot, its base moved to the frame of the measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armlab.calibrate.kinematics.measurements import Kind
from armlab.calibrate.kinematics.model import Arm
from armlab.errors import ShapeError
from armlab.lie import se3, so3

FAR = 0.1  # m or rad from the nominal robot: another measurement frame
MILLIMETRES = 30.0  # times too large: no arm is that far from its description
STILL = 1e-4  # times: no other unit of length, but what did not move


def start_arm(arm: Arm, kinds: tuple[Kind, ...]) -> tuple[Arm, np.ndarray]:
    """Return the arm at its start and tool points (K, 3), where several are unknown."""
    by_name = {kind.name: kind for kind in kinds}
    T = arm.move(arm.first()).T
    points = np.zeros((0, 3))
    if "pose" in by_name and by_name["pose"].kept.max() >= 3:
        return _from_poses(arm, T, by_name["pose"]), _points(arm, T, by_name.get("position"))
    if "position" in by_name:
        kind = by_name["position"]
        if kind.values.shape[1] > 1:
            return _from_points(arm, T, kind)
        rows = np.flatnonzero(kind.visible[:, 0])
        return _from_positions(arm, T[rows, :3, 3], kind.values[rows, 0], len(kind.kept) == 3), points
    if "pose" in by_name:
        kind = by_name["pose"]
        rows = np.flatnonzero(kind.visible)
        return _from_positions(arm, T[rows, :3, 3], kind.values[rows, :3, 3], len(kind.kept) == 3), points
    return arm, points


def kabsch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) with ``b = R a + p`` in the least squares of points (N, 3)."""
    U, _, V = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    return se3.from_rp(R, b.mean(axis=0) - R @ a.mean(axis=0))


def check_scale(nominal: float, measured: float, what: str) -> None:
    """Refuse lengths that are a thousand times what they should be, or a thousandth of it."""
    if measured > MILLIMETRES * nominal > 0:
        raise ShapeError(
            f"Expected {what} in metres, got numbers {measured / nominal:.3g} times as large as those of the nominal "
            "robot. These seem to be millimetres: divide by 1000."
        )
    if nominal > MILLIMETRES * measured > STILL * nominal:
        raise ShapeError(
            f"Expected {what} and the robot in metres, got numbers {measured / nominal:.3g} times as large as those of "
            "the nominal robot. Its description, or the first guess of a fixed point, seems to be in millimetres."
        )


def _size(points: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=-1)))) if len(points) else 0.0


def _moved(arm: Arm, pose: np.ndarray) -> Arm:
    start = np.array(arm.start)
    start[0] = se3.project(pose @ start[0])[0]
    return replace(arm, start=start)


def _from_positions(arm: Arm, nominal: np.ndarray, measured: np.ndarray, whole: bool) -> Arm:
    if len(nominal) < 3 or not whole:
        return arm
    check_scale(_size(nominal), _size(measured), "positions")
    if np.sqrt(np.mean(np.sum((measured - nominal) ** 2, axis=1))) < FAR:
        return arm
    return _moved(arm, kabsch(nominal, measured))


def _from_poses(arm: Arm, T: np.ndarray, kind: Kind) -> Arm:
    rows = np.flatnonzero(kind.visible)
    nominal, measured = T[rows], kind.values[rows]
    if len(rows) < 3:
        return arm
    positions = kind.kept.min() < 3
    if positions:
        check_scale(_size(nominal[:, :3, 3]), _size(measured[:, :3, 3]), "positions of poses")
    turn = so3.angle(nominal[:, :3, :3], measured[:, :3, :3])
    away = np.linalg.norm(nominal[:, :3, 3] - measured[:, :3, 3], axis=1) * positions
    if np.sqrt(np.mean(turn**2)) < FAR and np.sqrt(np.mean(away**2)) < FAR:
        return arm
    RX, tX, RY, tY = hand_eye(nominal, measured)
    moved = _moved(arm, se3.from_rp(RY, tY if positions else arm.start[0, :3, 3] - RY @ arm.start[0, :3, 3]))
    start = np.array(moved.start)
    start[-1] = se3.project(start[-1] @ se3.from_rp(RX, tX if positions else np.zeros(3)))[0]
    return replace(moved, start=start)


def hand_eye(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return X and Y of ``B_i = Y A_i X``: rotations from the mean of ``R_A (x) R_B``, translations linear."""
    RA, RB = A[:, :3, :3], B[:, :3, :3]
    K = np.einsum("iab,icd->acbd", RA, RB).reshape(9, 9) / len(A)
    U, _, V = np.linalg.svd(K)
    RY, RX = U[:, 0].reshape(3, 3), V[0].reshape(3, 3)
    RY, RX = (so3.project(R * np.sign(np.linalg.det(R)))[0] for R in (RY.T, RX))
    rows = np.concatenate([RY @ RA, np.broadcast_to(np.eye(3), RA.shape)], axis=2).reshape(-1, 6)
    known = (B[:, :3, 3] - A[:, :3, 3] @ RY.T).ravel()
    x = np.linalg.lstsq(rows, known, rcond=None)[0]
    return RX, x[:3], RY, x[3:]


def _points(arm: Arm, T: np.ndarray, kind: Kind | None) -> np.ndarray:
    """Return where the tool points (K, 3) are when poses say where the tool is."""
    if kind is None or kind.values.shape[1] == 1:
        return np.zeros((0, 3))
    return np.stack([_inside(T, kind.values[:, k], kind.visible[:, k]) for k in range(kind.values.shape[1])])


def _inside(T: np.ndarray, p: np.ndarray, seen: np.ndarray) -> np.ndarray:
    rows = np.flatnonzero(seen)
    if not len(rows):
        return np.zeros(3)
    return np.mean(np.einsum("iba,ib->ia", T[rows, :3, :3], p[rows] - T[rows, :3, 3]), axis=0)


def _from_points(arm: Arm, T: np.ndarray, kind: Kind) -> tuple[Arm, np.ndarray]:
    """Solve ``R_i s_k + t_i = R' p_ik + t'`` for all s_k, R' and t', then move the base by the inverse."""
    K, blocks, known = kind.values.shape[1], [], []
    at_nominal = np.stack([_inside(T, kind.values[:, k], kind.visible[:, k]) for k in range(K)])
    if np.sqrt(np.mean([_misfit(T, kind, k, at_nominal[k]) for k in range(K)])) < FAR**2 or len(kind.kept) < 3:
        return arm, at_nominal
    for k in range(K):
        rows = np.flatnonzero(kind.visible[:, k])
        block = np.zeros((len(rows), 3, 3 * K + 12))
        block[:, :, 3 * k : 3 * k + 3] = T[rows, :3, :3]
        for a in range(3):
            block[:, a, 3 * K + 3 * a : 3 * K + 3 * a + 3] = -kind.values[rows, k]
            block[:, a, 3 * K + 9 + a] = -1.0
        blocks.append(block.reshape(-1, 3 * K + 12))
        known.append(-T[rows, :3, 3].ravel())
    x = np.linalg.lstsq(np.concatenate(blocks), np.concatenate(known), rcond=None)[0]
    R = so3.project(x[3 * K : 3 * K + 9].reshape(3, 3))[0]
    points, wide = x[: 3 * K].reshape(K, 3), kind.values[kind.visible]
    check_scale(_size(T[:, :3, 3]) + _size(points), _size(wide), "positions")
    at = [T[:, :3, :3] @ s + T[:, :3, 3] - p @ R.T for s, p in zip(points, np.moveaxis(kind.values, 1, 0))]
    t = np.mean(np.concatenate([a[seen] for a, seen in zip(at, kind.visible.T)]), axis=0)
    return _moved(arm, se3.inv(se3.from_rp(R, t))), points


def _misfit(T: np.ndarray, kind: Kind, k: int, point: np.ndarray) -> float:
    rows = np.flatnonzero(kind.visible[:, k])
    away = kind.values[rows, k] - T[rows, :3, 3] - T[rows, :3, :3] @ point
    return float(np.mean(np.sum(away**2, axis=1))) if len(rows) else 0.0
