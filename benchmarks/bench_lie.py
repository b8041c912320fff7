"""Rotations and poses: exponential, logarithm, quaternions and Euler angles, singly and a million per call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from blocks import Contender, Table, agree, loop, once, table
from pytransform3d import batch_rotations, rotations, trajectories, transformations
from scipy.spatial.transform import RigidTransform, Rotation

from armlab.lie import euler, quaternion, se3, so3

Function = Callable[[np.ndarray], Any]
SINGLE = 200
SAME = 1e-6  # accuracy of pytransform3d's logarithm of poses near a half turn


@dataclass(frozen=True)
class Job:
    """One function as implemented by all contenders; inputs and outputs are in armlab's order, [v; w] and wxyz."""

    name: str
    argument: np.ndarray
    ours: Callable[..., np.ndarray]
    scipy: Function
    single: Function
    batch: Function | None = None
    pinocchio: Function | None = None


def run(quick: bool) -> list[Table]:
    """Compare `lie` with SciPy, pytransform3d and (if it has the function) Pinocchio."""
    jobs = _jobs(100_000 if quick else 1_000_000)
    rounds = (20, 3) if quick else (50, 3)
    return [_one(job, rounds[0]) for job in jobs] + [_many(job, rounds[1]) for job in jobs]


def _jobs(count: int) -> list[Job]:
    rng = np.random.default_rng(4)
    w = rng.standard_normal((count, 3))
    w *= rng.uniform(0, 3, (count, 1)) / np.linalg.norm(w, axis=1, keepdims=True)
    xi = np.concatenate([rng.standard_normal((count, 3)), w], axis=1)
    R, T = so3.exp(w), se3.exp(xi)
    q = quaternion.from_matrix(R)
    xyzw, first = [1, 2, 3, 0], [3, 4, 5, 0, 1, 2]
    return [
        Job(
            "so3.exp",
            w,
            so3.exp,
            lambda w: Rotation.from_rotvec(w).as_matrix(),
            rotations.matrix_from_compact_axis_angle,
            batch_rotations.matrices_from_compact_axis_angles,
            pin.exp3,
        ),
        Job(
            "so3.log",
            R,
            so3.log,
            lambda R: Rotation.from_matrix(R).as_rotvec(),
            rotations.compact_axis_angle_from_matrix,
            lambda R: _compact(batch_rotations.axis_angles_from_matrices(R)),
            pin.log3,
        ),
        Job(
            "quaternion.to_matrix",
            q,
            quaternion.to_matrix,
            lambda q: Rotation.from_quat(q[..., xyzw]).as_matrix(),
            rotations.matrix_from_quaternion,
            batch_rotations.matrices_from_quaternions,
        ),
        Job(
            "quaternion.from_matrix",
            R,
            quaternion.from_matrix,
            lambda R: Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True),
            rotations.quaternion_from_matrix,
            batch_rotations.quaternions_from_matrices,
        ),
        Job(
            "euler.from_rpy",
            w,
            lambda w, out=None: euler.from_rpy(w, "zyx", out),
            lambda w: Rotation.from_euler("ZYX", w).as_matrix(),
            lambda w: rotations.matrix_from_euler(w, 2, 1, 0, False),
            lambda w: batch_rotations.active_matrices_from_intrinsic_euler_angles(2, 1, 0, w),
        ),
        Job(
            "euler.to_rpy",
            R,
            lambda R, out=None: euler.to_rpy(R, "zyx", out),
            lambda R: Rotation.from_matrix(R).as_euler("ZYX"),
            lambda R: rotations.euler_from_matrix(R, 2, 1, 0, False),
        ),
        Job(
            "se3.exp",
            xi,
            se3.exp,
            lambda xi: RigidTransform.from_exp_coords(xi[..., first]).as_matrix(),
            lambda xi: transformations.transform_from_exponential_coordinates(xi[first]),
            lambda xi: trajectories.transforms_from_exponential_coordinates(xi[:, first]),
            lambda xi: pin.exp6(xi).homogeneous,
        ),
        Job(
            "se3.log",
            T,
            se3.log,
            lambda T: RigidTransform.from_matrix(T).as_exp_coords()[..., first],
            lambda T: transformations.exponential_coordinates_from_transform(T)[first],
            lambda T: trajectories.exponential_coordinates_from_transforms(T)[:, first],
            lambda T: pin.log6(T).vector,
        ),
    ]


def _compact(axis_angle: np.ndarray) -> np.ndarray:
    return axis_angle[:, :3] * axis_angle[:, 3:]


def _one(job: Job, rounds: int) -> Table:
    items = [job.argument[k].copy() for k in range(SINGLE)]
    ways = [
        ("SciPy", job.scipy, "Rotation or RigidTransform of a single element"),
        ("pytransform3d", job.single, ""),
        *([("Pinocchio", job.pinocchio, "")] if job.pinocchio else []),
    ]
    worst = max(_agree(job, way, item) for _, way, _ in ways for item in items)
    contenders = [
        Contender(f"armlab {job.name}", loop(job.ours, items), "armlab"),
        *(Contender(name, loop(way, items), note=note) for name, way, note in ways),
        Contender("a Python function that returns an empty 4×4 array", loop(_empty, items), "limit"),
    ]
    return table(f"One {job.name}", f"With the default checks. All agree to {worst:.1g}.", "µs", contenders, rounds)


def _many(job: Job, rounds: int) -> Table:
    values = job.argument
    few = values[:2000]
    worst = max(_agree(job, way, few) for way in (job.scipy, job.batch) if way)
    out = np.ones_like(job.ours(values))
    contenders = [
        Contender(f"armlab {job.name}", once(partial(job.ours, values)), "armlab"),
        Contender("armlab with out=", once(partial(job.ours, values, out)), "armlab"),
        Contender("SciPy", once(partial(job.scipy, values))),
        *([Contender("pytransform3d", once(partial(job.batch, values)), note="for batches")] if job.batch else []),
        Contender("copying the same amount of data", once(partial(np.copyto, out, np.ones_like(out))), "limit"),
    ]
    text = f"{len(values):,} per call, with the default checks. All agree to {worst:.1g}."
    return table(f"{len(values):,} {job.name}", text, "ms", contenders, rounds)


def _agree(job: Job, way: Function, values: np.ndarray) -> float:
    got, ours = way(values), job.ours(values)
    if job.name == "quaternion.from_matrix":  # q and -q are the same rotation
        got = np.where((got * ours).sum(axis=-1, keepdims=True) < 0, -got, got)
    return agree(job.name, got, ours, SAME)


def _empty(_: np.ndarray) -> np.ndarray:
    return np.empty((4, 4))
