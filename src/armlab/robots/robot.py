"""`Robot`: the frozen description of one serial arm."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from armlab.errors import RobotError
from armlab.lie import se3

if TYPE_CHECKING:
    from armlab.kernels import Chain

__all__ = ["POSE_TOLERANCE", "Robot"]

POSE_TOLERANCE = 1e-9
"""Largest entry of |RᵀR - I| in a robot's poses: an error that kinematics carries to the tool undetected."""


@dataclass(frozen=True, eq=False)
class Robot:
    """One serial arm as a product of exponentials about local z axes.

    ``T_base_tool(q) = E_0 Z_1(q_1) E_1 Z_2(q_2) ... Z_n(q_n) E_n`` with ``Z(q) = Rz(q)`` for a revolute joint and
    ``Tz(q)`` for a prismatic one; ``E_0 ... E_n`` are `frames`. *Link frame* i is ``E_0 Z_1 ... E_{i-1} Z_i``: its
    z axis is joint axis i. Arrays are read-only; robots are equal when all their fields are.

    Attributes
    ----------
    name : name of the robot.
    links : (n+1, 4, 4) constant poses, mount to first joint, joint to joint, last joint to flange.
    prismatic : (n,) bool, True where a joint slides.
    q_min, q_max : (n,) position limits [rad or m]; infinite where there is none.
    qd_max, qdd_max : (n,) limits of speed and acceleration.
    q_home : (n,) a posture inside the limits to start from.
    joint_names : n names, base to tool.
    T_base_mount : (4, 4) where the arm is mounted in the frame ``base``.
    T_flange_tool : (4, 4) the tool.
    gravity : (3,) acceleration of gravity [m/s^2], base axes.
    coupling : (n, n) gears G: ``q = G q_motor``, ``tau = G^-T tau_motor``.
    abb_axes : ABB's axis number of each joint, in kinematic order.
    side : "left", "right" or "".
    source : where the numbers come from.

    Raises
    ------
    RobotError : when the fields contradict each other; names the field, the joint and the value.
    """

    name: str
    links: np.ndarray
    prismatic: np.ndarray
    q_min: np.ndarray
    q_max: np.ndarray
    qd_max: np.ndarray
    qdd_max: np.ndarray
    q_home: np.ndarray
    joint_names: tuple[str, ...]
    T_base_mount: np.ndarray
    T_flange_tool: np.ndarray
    gravity: np.ndarray
    coupling: np.ndarray
    abb_axes: tuple[int, ...]
    side: Literal["left", "right", ""]
    source: str

    def __post_init__(self) -> None:
        """Make every array a read-only float64 copy (prismatic: bool) and check the description."""
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type == "np.ndarray":
                # + 0.0 turns -0.0 into 0.0: equal robots have equal bytes
                value = np.array(value, dtype=bool) if field.name == "prismatic" else np.array(value, np.float64) + 0.0
                value.flags.writeable = False
            elif str(field.type).startswith("tuple"):
                value = tuple(value)
            object.__setattr__(self, field.name, value)
        _check_shapes(self)
        _check_poses(self)
        _check_limits(self)
        _check_names(self)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.prismatic)

    @cached_property
    def frames(self) -> np.ndarray:
        """(n+1, 4, 4) ``E_0 ... E_n``, mount and tool included."""
        frames = self.links.copy()
        frames[0] = self.T_base_mount @ frames[0]
        frames[-1] = frames[-1] @ self.T_flange_tool
        frames += 0.0
        frames.flags.writeable = False
        return frames

    @cached_property
    def chain(self) -> Chain:
        """The compiled kinematics and dynamics of this robot."""
        from armlab.kernels import Chain

        return Chain(self.frames, self.prismatic)

    @cached_property
    def screws(self) -> np.ndarray:
        """(n, 6) joint screws ``[v; w]`` at q = 0, base axes, about the base origin."""
        T = np.eye(4)
        screws = np.zeros((self.n, 6))
        for screw, frame, slides in zip(screws, self.frames, self.prismatic):
            T = T @ frame
            axis = T[:3, 2]
            if slides:
                screw[:3] = axis
            else:
                screw[:] = *np.cross(T[:3, 3], axis), *axis
        screws.flags.writeable = False
        return screws

    @cached_property
    def T_home(self) -> np.ndarray:
        """(4, 4) pose of the tool in the base at q = 0."""
        T = np.linalg.multi_dot(self.frames)
        T.flags.writeable = False
        return T

    @cached_property
    def hash(self) -> str:
        """SHA-256 (hex) over the numbers of the description; names and sources do not count.

        Numbers are rounded to 12 decimals, so that machines whose sine differs in the last digit agree.
        """
        digest = hashlib.sha256()
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "abb_axes":
                value = np.array(value)
            if isinstance(value, np.ndarray):
                digest.update(f"{field.name}{value.shape}".encode())
                rounded = np.round(value.astype(np.float64), 12) + 0.0  # -0.0 becomes 0.0
                digest.update(rounded.astype("<f8").tobytes())
        return digest.hexdigest()

    def with_tool(self, T_flange_tool: np.ndarray) -> Robot:
        """Return the robot with another tool in place of its own: ``T_base_tool = T_base_flange @ T_flange_tool``.

        Parameters
        ----------
        T_flange_tool : (4, 4) pose of the tool point in the flange.
        """
        return replace(self, T_flange_tool=T_flange_tool)

    def with_base(self, T_base_mount: np.ndarray) -> Robot:
        """Return the robot mounted elsewhere; gravity stays as it is in base axes.

        Parameters
        ----------
        T_base_mount : (4, 4) pose of the arm's mount (its DH frame 0) in the base.
        """
        return replace(self, T_base_mount=T_base_mount)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Robot):
            return NotImplemented
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)

    def __hash__(self) -> int:
        return hash(self.hash)

    def __repr__(self) -> str:
        return f"Robot({self.name!r}, {self.n} joints)"

    def __reduce__(self) -> tuple:
        """Pickle the fields only: caches are rebuilt, arrays are read-only again."""
        return Robot, tuple(getattr(self, field.name) for field in fields(self))


def _check_shapes(robot: Robot) -> None:
    """Every array has the shape that n joints need and no NaN."""
    n = robot.prismatic.size
    if robot.prismatic.ndim != 1 or n == 0:
        raise RobotError(f"Expected at least one joint for robot {robot.name!r}, got shape {robot.prismatic.shape}.")
    vectors = dict.fromkeys(("q_min", "q_max", "qd_max", "qdd_max", "q_home"), (n,))
    matrices = {"links": (n + 1, 4, 4), "T_base_mount": (4, 4), "T_flange_tool": (4, 4), "coupling": (n, n)}
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


def _check_poses(robot: Robot) -> None:
    """Links, mount and tool are poses; G can be inverted; gravity is finite."""
    poses = {f"links[{i}]": link for i, link in enumerate(robot.links)}
    poses |= {"T_base_mount": robot.T_base_mount, "T_flange_tool": robot.T_flange_tool}
    for field, pose in poses.items():
        if not se3.is_pose(pose, POSE_TOLERANCE):
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
    """One name and one ABB axis per joint, none twice."""
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


def _joint(robot: Robot, i: int) -> str:
    """Return ``joint 3 (axis_7)`` for index 2."""
    name = f" ({robot.joint_names[i]})" if i < len(robot.joint_names) else ""
    return f"joint {i + 1}{name}"
