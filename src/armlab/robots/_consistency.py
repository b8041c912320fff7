"""Whether the fields of a `Robot` fit together: one sentence for each contradiction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from armlab.errors import RobotError
from armlab.lie import se3
from armlab.robots import inertia
from armlab.robots.mesh import Mesh

if TYPE_CHECKING:
    from armlab.robots.robot import Robot

__all__ = ["POSE_TOLERANCE", "body_fault", "check_joint_count", "check_robot"]

POSE_TOLERANCE = 1e-9
"""Largest entry of |RᵀR - I| in a robot's poses: an error that kinematics carries to the tool undetected."""

MOST_JOINTS = 32  # what the compiled kernels hold
MOMENT_TOLERANCE = 1e-6  # a principal moment this much below zero, relative to the largest, is rounding of the digits
SMALLEST_RADIUS = 1e-6  # m; nor is the moment of the whole mass at this radius


def check_robot(robot: Robot) -> None:
    """Raise `RobotError` for the first field that contradicts the others."""
    _check_shapes(robot)
    _check_poses(robot)
    _check_limits(robot)
    _check_names(robot)
    _check_bodies(robot)


def _check_shapes(robot: Robot) -> None:
    """Every array has the shape that n joints need and no NaN."""
    n = robot.prismatic.size
    if robot.prismatic.ndim != 1 or n == 0:
        raise RobotError(f"Expected at least one joint for robot {robot.name!r}, got shape {robot.prismatic.shape}.")
    check_joint_count(robot.name, n)
    vectors = dict.fromkeys(("q_min", "q_max", "qd_max", "qdd_max", "q_home", "tau_max"), (n,))
    matrices = {"links": (n + 1, 4, 4), "T_base_mount": (4, 4), "T_flange_tool": (4, 4), "coupling": (n, n)}
    if robot.inertias is not None:
        matrices["inertias"] = (n, 10)
    for field, shape in {**vectors, **matrices, "gravity": (3,)}.items():
        value = getattr(robot, field)
        if value.shape != shape:
            raise RobotError(
                f"Expected {field} of robot {robot.name!r} ({n} joints) to have shape {shape}, got {value.shape}."
            )
        if np.isnan(value).any():
            index = tuple(int(i) for i in np.argwhere(np.isnan(value))[0])
            where = _joint(robot, index[0]) if field in vectors else f"index {index}"
            raise RobotError(f"Expected numbers in {field} of robot {robot.name!r}, got NaN at {where}.")


def check_joint_count(name: str, n: int) -> None:
    """Raise `RobotError` for more joints than the kernels hold."""
    if n > MOST_JOINTS:
        raise RobotError(f"Expected at most {MOST_JOINTS} joints for robot {name!r}, got {n}.")


def _check_poses(robot: Robot) -> None:
    """Links, mount and tool are poses; G can be inverted; gravity is finite."""
    poses = {f"links[{i}]": link for i, link in enumerate(robot.links)}
    poses |= {"T_base_mount": robot.T_base_mount, "T_flange_tool": robot.T_flange_tool}
    good = se3.is_pose(np.stack(list(poses.values())), POSE_TOLERANCE)
    for (field, pose), fits in zip(poses.items(), good):
        if not fits:
            rows = "; ".join(" ".join(f"{x:.9g}" for x in row) for row in pose)
            raise RobotError(
                f"Expected {field} of robot {robot.name!r} to be a pose with a rotation orthonormal to "
                f"{POSE_TOLERANCE:g}, got [{rows}]. Project it first if it is nearly one (lie.se3.project)."
            )
    if not np.isfinite(robot.gravity).all():
        raise RobotError(f"Expected a finite gravity of robot {robot.name!r}, got {robot.gravity}.")
    if not np.isfinite(robot.coupling).all() or np.linalg.matrix_rank(robot.coupling) < robot.n:
        raise RobotError(f"Expected a coupling of robot {robot.name!r} that can be inverted, got rank below {robot.n}.")


def _check_limits(robot: Robot) -> None:
    """Limits are in order and the home posture is inside them."""
    rules = (
        (robot.q_min < robot.q_max, "q_min below q_max", ("q_min", "q_max")),
        (robot.qd_max > 0, "a positive speed limit", ("qd_max",)),
        (robot.qdd_max > 0, "a positive acceleration limit", ("qdd_max",)),
        (robot.tau_max > 0, "a positive torque limit", ("tau_max",)),
        (np.isfinite(robot.q_home), "a finite home position", ("q_home",)),
        (
            (robot.q_min <= robot.q_home) & (robot.q_home <= robot.q_max),
            "a home position inside the limits",
            ("q_home", "q_min", "q_max"),
        ),
    )
    for holds, rule, names in rules:
        if not holds.all():
            i = int(np.argmin(holds))
            got = ", ".join(f"{name} {getattr(robot, name)[i]:.6g}" for name in names)
            raise RobotError(f"Expected {rule} at {_joint(robot, i)} of robot {robot.name!r}, got {got}.")


def _check_names(robot: Robot) -> None:
    """Names are text and not empty; one name and one ABB axis per joint, none twice."""
    for field, words in (("name", [robot.name]), ("source", [robot.source]), ("joint_names", robot.joint_names)):
        for word in words:
            if not isinstance(word, str):
                raise RobotError(f"Expected text in {field} of robot {robot.name!r}, got {word!r}.")
            if field != "source" and not word.strip():
                raise RobotError(f"Expected a name in {field} of robot {robot.name!r}, got {word!r}. Give it one.")
    for field in ("joint_names", "abb_axes"):
        value = getattr(robot, field)
        if len(value) != robot.n or len(set(value)) != robot.n:
            raise RobotError(f"Expected {robot.n} different {field} of robot {robot.name!r}, got {list(value)}.")
    if sorted(robot.abb_axes) != list(range(1, robot.n + 1)):
        raise RobotError(
            f"Expected abb_axes of robot {robot.name!r} to hold 1 to {robot.n} once each, got {list(robot.abb_axes)}."
        )
    if robot.side not in ("left", "right", ""):
        raise RobotError(f'Expected side of robot {robot.name!r} to be "left", "right" or "", got {robot.side!r}.')


def _check_bodies(robot: Robot) -> None:
    """Inertias are those of bodies, meshes belong to the mount or to a link."""
    if len(robot.meshes) not in (0, robot.n + 1):
        raise RobotError(
            f"Expected meshes in robot {robot.name!r} of the mount and {robot.n} links, got {len(robot.meshes)} tuples."
        )
    for mesh in (mesh for meshes in robot.meshes for mesh in meshes):
        if not isinstance(mesh, Mesh):
            raise RobotError(f"Expected a robots.Mesh in meshes of robot {robot.name!r}, got {mesh!r}.")
    for i, pi in enumerate([] if robot.inertias is None else robot.inertias):
        fault = body_fault(pi)
        if fault:
            raise RobotError(f"Expected the inertia of a body for link {i + 1} of robot {robot.name!r}, got {fault}.")


def body_fault(pi: np.ndarray) -> str:
    """Return in words what makes inertial parameters (10,) those of no body at all, or nothing.

    With a mass above zero and no negative moment about the centre every mass matrix is positive. That the largest
    moment is at most the sum of the others is not asked: published descriptions break it, and nothing breaks by it.
    """
    if not np.isfinite(pi).all():
        return f"{pi.tolist()}, which is not finite"
    if pi[0] < 0:
        return f"a mass of {pi[0]:.6g} kg"
    if pi[0] == 0:
        return "moments without a mass" if pi.any() else ""
    moments = inertia.principal_moments(pi)
    rounding = MOMENT_TOLERANCE * moments[2] + 1e-12 * (pi[4] + pi[6] + pi[9]) + pi[0] * SMALLEST_RADIUS**2
    return f"principal moments {moments} kg m^2" if moments[0] < -rounding else ""


def _joint(robot: Robot, i: int) -> str:
    """Return ``joint 3 (axis_7)`` for index 2."""
    name = f" ({robot.joint_names[i]})" if i < len(robot.joint_names) else ""
    return f"joint {i + 1}{name}"
