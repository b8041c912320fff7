"""`Robot`: the frozen description of one serial arm."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from operator import index
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from armlab._numbers import frozen, members
from armlab.errors import RobotError
from armlab.robots._consistency import POSE_TOLERANCE, check_robot
from armlab.robots.mesh import Mesh

if TYPE_CHECKING:
    from armlab.kernels import Chain, InverseSolver

__all__ = ["POSE_TOLERANCE", "Robot"]

_YUMI_AXES = (1, 2, 7, 3, 4, 5, 6)


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
    tau_max : (n,) limits of torque or force [N m or N]; infinite where there is none.
    inertias : (n, 10) of each link in its link frame, about its origin (see `robots.inertia`), or None when unknown.
    meshes : n + 1 tuples of `Mesh`: those of the mount, in the frame of the mount, then of link 1 ... n, each in its
        link frame; or empty.

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
    tau_max: np.ndarray
    inertias: np.ndarray | None
    meshes: tuple[tuple[Mesh, ...], ...]

    def __post_init__(self) -> None:
        """Make every array a read-only float64 copy (prismatic: bool) and check the description."""
        for field in fields(self):
            what, value = f"{field.name} of robot {self.name!r}", getattr(self, field.name)
            if str(field.type).startswith("np.ndarray"):
                value = None if field.name == "inertias" and value is None else frozen(value, what)
            elif str(field.type).startswith("tuple"):
                value = members(value, what)
            object.__setattr__(self, field.name, value)
        object.__setattr__(self, "prismatic", _flags(self.prismatic, self.name))
        object.__setattr__(self, "abb_axes", _axis_numbers(self.abb_axes, self.name))
        meshes = tuple(members(link, f"meshes of one link of robot {self.name!r}") for link in self.meshes)
        object.__setattr__(self, "meshes", meshes if any(meshes) else ())
        check_robot(self)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.prismatic)

    @property
    def ros_joint_names(self) -> tuple[str, ...]:
        """n names in ROS messages, recordings and URDF: `joint_names`, but for a YuMi those of abb_robot_driver.

        abb_robot_driver counts from base to tool: ABB's axis 7 of a left arm is ``yumi_robl_joint_3``.
        """
        if self.abb_axes == _YUMI_AXES and self.side:
            return tuple(f"yumi_rob{self.side[0]}_joint_{k}" for k in range(1, self.n + 1))
        return self.joint_names

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
    def inverse_solver(self) -> InverseSolver:
        """The compiled inverse kinematics of this robot, within its limits; `kinematics.inverse` calls it."""
        from armlab.kernels import InverseSolver

        return InverseSolver(self.chain, self.q_min, self.q_max, self.q_home)

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

        Numbers are rounded to 12 decimals, so that machines whose sine differs in the last digit agree. Torque limits
        and inertias count where there are any, meshes never.
        """
        import hashlib  # OpenSSL costs 2 ms

        digest = hashlib.sha256()
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "abb_axes":
                value = np.array(value)
            silent = field.name == "tau_max" and np.isinf(value).all()
            if isinstance(value, np.ndarray) and not silent:
                digest.update(f"{field.name}{value.shape}".encode())
                rounded = np.round(value.astype(np.float64), 12) + 0.0  # -0.0 becomes 0.0
                digest.update(rounded.astype("<f8").tobytes())
        return digest.hexdigest()

    def with_tool(self, T_flange_tool: np.ndarray) -> Robot:
        """Return the robot with another tool in place of its own: ``T_base_tool = T_base_flange @ T_flange_tool``.

        The tool has no mass: what it weighs is added to the last link, see `robots.inertia`.

        Parameters
        ----------
        T_flange_tool : (4, 4) pose of the tool point in the flange.
        """
        return replace(self, T_flange_tool=T_flange_tool)

    def with_base(self, T_base_mount: np.ndarray) -> Robot:
        """Return the robot mounted elsewhere; gravity stays as it is in base axes, meshes of the mount move with it.

        Parameters
        ----------
        T_base_mount : (4, 4) pose of the arm's mount (its DH frame 0) in the base.
        """
        return replace(self, T_base_mount=T_base_mount)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Robot):
            return NotImplemented
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a is b or a == b for a, b in pairs)

    def __hash__(self) -> int:
        return hash(self.hash)

    def __repr__(self) -> str:
        return f"Robot({self.name!r}, {self.n} joints)"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the fields only: caches are rebuilt, arrays are read-only again."""
        return Robot, tuple(getattr(self, field.name) for field in fields(self))


def _flags(value: np.ndarray, name: str) -> np.ndarray:
    if not np.isin(value, (0.0, 1.0)).all():
        raise RobotError(f"Expected prismatic of robot {name!r} as True and False, got {value.tolist()}.")
    flags = value.astype(bool)
    flags.flags.writeable = False
    return flags


def _axis_numbers(value: tuple[Any, ...], name: str) -> tuple[int, ...]:
    """Return plain integers: those of NumPy would not be written as TOML."""
    try:
        return tuple(map(index, value))
    except TypeError:
        raise RobotError(f"Expected abb_axes of robot {name!r} as whole numbers, got {list(value)}.") from None
