"""`Robot`: immutable, validated description of one serial arm, with meshes by reference."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from operator import index
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from armlab._display import Shown, html_table
from armlab._numbers import frozen, members, numbers
from armlab.errors import RobotError
from armlab.lie import se3, so3
from armlab.robots import inertia

if TYPE_CHECKING:
    from armlab.kernels import Chain, InverseSolver, RigidBody

_YUMI_AXES = (1, 2, 7, 3, 4, 5, 6)
_PARALLEL = 0.03  # angle [rad] below which axes are drawn as parallel
MOST_JOINTS = 32  # capacity of the compiled kernels
MOMENT_TOLERANCE = 1e-6  # negative moments below this fraction of the largest principal moment are rounding
SMALLEST_RADIUS = 1e-6  # radius of gyration [m] below which negative moments are rounding
DRIVES = ("friction", "damping", "rotor", "ripple", "noise")
"""Drive parameters of a description: Coulomb friction [N m], viscous friction [N m s/rad], rotor inertia [kg m^2],
amplitude of the torque ripple and standard deviation of the torque signal [N m]. All parameters refer to the joint
side; prismatic joints have the corresponding linear units."""


@dataclass(frozen=True, eq=False)
class Robot:
    """Serial arm as a product of exponentials about local z axes.

    ``T_base_tool(q) = E_0 Z_1(q_1) E_1 Z_2(q_2) ... Z_n(q_n) E_n`` with ``Z(q) = Rz(q)`` for a revolute joint and
    ``Tz(q)`` for a prismatic joint; ``E_0 ... E_n`` are `frames`. *Link frame* i is ``E_0 Z_1 ... E_{i-1} Z_i``: its z
    axis is joint axis i. Arrays are read-only; robots are equal if all their fields are equal.

    Attributes
    ----------
    name : name of the robot.
    links : (n+1, 4, 4) constant poses: mount to first joint, joint to next joint, last joint to flange.
    prismatic : (n,) bool, True for prismatic joints.
    q_min, q_max : (n,) position limits [rad or m]; infinite where unlimited.
    qd_max, qdd_max : (n,) speed and acceleration limits.
    q_home : (n,) default start posture, inside the limits.
    joint_names : n names, base to tool.
    T_base_mount : (4, 4) pose of the arm's mount in the frame ``base``.
    T_flange_tool : (4, 4) pose of the tool in the flange frame.
    gravity : (3,) acceleration of gravity [m/s^2], base axes.
    coupling : (n, n) gear matrix G: ``q = G q_motor``, ``tau = G^-T tau_motor``.
    abb_axes : ABB's axis number of each joint, in kinematic order.
    side : "left", "right" or "".
    source : origin of the numbers.
    tau_max : (n,) torque or force limits [N m or N]; infinite where unlimited.
    inertias : (n, 10) inertial parameters of each link in its frame (see `robots.inertia`); None: unknown.
    meshes : n + 1 tuples of `Mesh`, for the mount and links 1 ... n, each in the frame of its body; empty without
        meshes.
    drives : drive parameters for simulation, as pairs of a name in `DRIVES` and n numbers; 0 means unknown.

    Raises
    ------
    RobotError : if fields are inconsistent; the message states the field, the joint and the value.
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
    drives: tuple[tuple[str, tuple[float, ...]], ...] = ()

    def __post_init__(self) -> None:
        """Make every array a read-only float64 copy (prismatic: bool) and check the description."""
        for field in fields(self):
            what, value = f"{field.name} of robot {self.name!r}", getattr(self, field.name)
            if str(field.type).startswith("np.ndarray"):
                if field.name != "inertias" or value is not None:
                    value = frozen(_with_digits(field.name, numbers(value, what)), what)
            elif str(field.type).startswith("tuple"):
                value = members(value, what)
            object.__setattr__(self, field.name, value)
        object.__setattr__(self, "prismatic", _flags(self.prismatic, self.name))
        object.__setattr__(self, "abb_axes", _axis_numbers(self.abb_axes, self.name))
        meshes = tuple(members(link, f"meshes of one link of robot {self.name!r}") for link in self.meshes)
        object.__setattr__(self, "meshes", meshes if any(meshes) else ())
        object.__setattr__(self, "drives", _drives(self.drives, self.name, self.n))
        _check_shapes(self)
        _check_poses(self)
        _check_limits(self)
        _check_names(self)
        _check_bodies(self)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.prismatic)

    @property
    def ros_joint_names(self) -> tuple[str, ...]:
        """Joint names in ROS messages, recordings and URDF: `joint_names`, or abb_robot_driver's names for a YuMi.

        abb_robot_driver numbers joints from base to tool: ABB's axis 7 of a left arm is ``yumi_robl_joint_3``.
        """
        if self.abb_axes == _YUMI_AXES and self.side:
            return tuple(f"yumi_rob{self.side[0]}_joint_{k}" for k in range(1, self.n + 1))
        return self.joint_names

    @cached_property
    def frames(self) -> np.ndarray:
        """Constant poses ``E_0 ... E_n`` (n+1, 4, 4), including mount and tool."""
        frames = self.links.copy()
        frames[0] = self.T_base_mount @ frames[0]
        frames[-1] = frames[-1] @ self.T_flange_tool
        frames += 0.0
        frames.flags.writeable = False
        return frames

    @cached_property
    def chain(self) -> Chain:
        """Compiled kinematics."""
        from armlab.kernels import Chain

        return Chain(self.frames, self.prismatic)

    @cached_property
    def rigid_body(self) -> RigidBody:
        """Compiled dynamics, used by `armlab.dynamics`.

        Raises
        ------
        RobotError : if the description has no masses.
        """
        from armlab.kernels import RigidBody

        if self.inertias is None:
            raise RobotError(
                f"Expected masses and inertias of robot {self.name!r}, got none. Add <inertial> to each link in the "
                "URDF, or mass, centre and inertia in the TOML file, or identify a model (fit_dynamics)."
            )
        return RigidBody(self.chain, self.gravity, self.inertias)

    @cached_property
    def inverse_solver(self) -> InverseSolver:
        """Compiled inverse kinematics, used by `kinematics.inverse`."""
        from armlab.kernels import InverseSolver

        return InverseSolver(self.chain, self.q_min, self.q_max, self.q_home)

    @cached_property
    def screws(self) -> np.ndarray:
        """Joint screws ``[v; w]`` (n, 6) at q = 0, in base axes about the base origin."""
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
        """Pose (4, 4) of the tool in the base at q = 0."""
        T = np.linalg.multi_dot(self.frames)
        T.flags.writeable = False
        return T

    @cached_property
    def hash(self) -> str:
        """SHA-256 (hex) of the numbers in the description, without names and sources.

        Numbers are rounded to 12 decimals, so the hash is the same on machines whose sine functions round differently.
        Torque limits and inertias are included if present; meshes are never included.
        """
        import hashlib  # a lazy import, because OpenSSL costs 2 ms

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
        """Return the robot with a different tool: ``T_base_tool = T_base_flange @ T_flange_tool``.

        The tool has no mass; to include its weight, add a body to the last link (see `robots.inertia`).

        Parameters
        ----------
        T_flange_tool : (4, 4) pose of the tool point in the flange.
        """
        return replace(self, T_flange_tool=T_flange_tool)

    def with_base(self, T_base_mount: np.ndarray) -> Robot:
        """Return the robot with a different mount. The mount's meshes move with it; gravity in base axes is unchanged.

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

    def _repr_html_(self) -> str:
        numbers = zip(self.q_min, self.q_max, self.qd_max, self.tau_max, self.q_home, strict=True)
        rows = [
            (str(i + 1), name, "prismatic" if self.prismatic[i] else "revolute", *(f"{x:.4g}" for x in row))
            for i, (name, row) in enumerate(zip(self.joint_names, numbers, strict=True))
        ]
        head = ("joint", "name", "kind", "from [rad, m]", "to", "speed [1/s]", "torque [N m, N]", "home")
        return html_table(repr(self), head, rows, self.source.splitlines()[:3])

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the fields; caches are rebuilt."""
        return Robot, tuple(getattr(self, field.name) for field in fields(self))


def _with_digits(field: str, value: np.ndarray) -> np.ndarray:
    """Orthonormalise the rounded rotations of a pose field."""
    poses = ("links", "T_base_mount", "T_flange_tool", "T_link_mesh")
    return se3.orthonormalise(value) if field in poses and value.shape[-2:] == (4, 4) else value


def _flags(value: np.ndarray, name: str) -> np.ndarray:
    if not np.isin(value, (0.0, 1.0)).all():
        raise RobotError(f"Expected Booleans in prismatic of robot {name!r}, got {value.tolist()}.")
    flags = value.astype(bool)
    flags.flags.writeable = False
    return flags


def _drives(pairs: tuple[Any, ...], name: str, n: int) -> tuple[tuple[str, tuple[float, ...]], ...]:
    found = {}
    for key, values in pairs:
        if key not in DRIVES:
            raise RobotError(
                f"Expected the drive parameters of robot {name!r} to be among {', '.join(DRIVES)}, got {key!r}."
            )
        array = frozen(values, f"{key} of the drives of robot {name!r}")
        if array.shape != (n,) or not np.all((array >= 0) & np.isfinite(array)):
            raise RobotError(
                f"Expected {n} finite, non-negative numbers as {key} of the drives of robot {name!r}, "
                f"got {array.tolist()}."
            )
        found[key] = tuple(array.tolist())
    return tuple((key, found[key]) for key in DRIVES if key in found and any(found[key]))


def _axis_numbers(value: tuple[Any, ...], name: str) -> tuple[int, ...]:
    """Return plain integers, because the TOML writer does not accept NumPy integers."""
    try:
        return tuple(map(index, value))
    except TypeError:
        raise RobotError(f"Expected `abb_axes` of robot {name!r} to be integers, got {list(value)}.") from None


@dataclass(frozen=True, eq=False, repr=False)
class Mesh(Shown):
    """Reference to a mesh of a link; its file is never read. Meshes are equal if all their fields are equal.

    Attributes
    ----------
    kind : "visual" or "collision".
    file : reference as written in the description: a path, or an address such as ``package://maker/link_1.stl``.
    T_link_mesh : (4, 4) pose of the mesh in its link frame, read-only.
    scale : (3,) factors from file units to metres, read-only.

    Raises
    ------
    RobotError : if the kind is unknown, the file name is empty, the pose is invalid, or a factor is 0 or not finite.
    """

    kind: Literal["visual", "collision"]
    file: str
    T_link_mesh: np.ndarray
    scale: np.ndarray

    def __post_init__(self) -> None:
        """Make the arrays read-only float64 copies and check the fields."""
        for name in ("T_link_mesh", "scale"):
            what = f"{name} of mesh {self.file!r}"
            object.__setattr__(self, name, frozen(_with_digits(name, numbers(getattr(self, name), what)), what))
        if not isinstance(self.file, str) or not self.file:
            raise RobotError(f"Expected the file name of a mesh, got {self.file!r}.")
        if not isinstance(self.kind, str) or self.kind not in ("visual", "collision"):
            raise RobotError(f'Expected "visual" or "collision" as the kind of mesh {self.file!r}, got {self.kind!r}.')
        if self.T_link_mesh.shape != (4, 4) or not se3.is_pose(self.T_link_mesh):
            raise RobotError(f"Expected a pose (4, 4) for mesh {self.file!r}, got {self.T_link_mesh.tolist()}.")
        if self.scale.shape != (3,) or not (np.isfinite(self.scale).all() and self.scale.all()):
            raise RobotError(
                f"Expected 3 finite, non-zero scale factors for mesh {self.file!r}, got {self.scale.tolist()}."
            )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Mesh):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle through the constructor, which makes the arrays read-only again."""
        return Mesh, (self.kind, self.file, self.T_link_mesh, self.scale)

    def _key(self) -> tuple[Any, ...]:
        return self.kind, self.file, self.T_link_mesh.tobytes(), self.scale.tobytes()


def arm_length(robot: Robot) -> float:
    """Return the length of the outstretched arm from mount to tool [m], or 1 if this length is zero."""
    steps = np.linalg.norm(np.concatenate([robot.links, robot.T_flange_tool[None]])[:, :3, 3], axis=1)
    strokes = np.nan_to_num(np.maximum(-robot.q_min, robot.q_max), posinf=0.0)[robot.prismatic]
    return float(steps.sum() + strokes.sum()) or 1.0


def bends(a: np.ndarray, along_a: np.ndarray, b: np.ndarray, along_b: np.ndarray) -> list[np.ndarray]:
    """Return the ends of the common normal of two axes, each given by a point and a unit vector, for drawing a link."""
    across = b - a
    cosine = along_a @ along_b
    sine2 = 1 - cosine**2
    if sine2 < _PARALLEL**2:
        return [a + (across @ along_a) * along_a]
    s = (across @ along_a - cosine * (across @ along_b)) / sine2
    t = (cosine * (across @ along_a) - across @ along_b) / sine2
    return [a + s * along_a, b + t * along_b]


def _check_shapes(robot: Robot) -> None:
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
    if n > MOST_JOINTS:
        raise RobotError(f"Expected at most {MOST_JOINTS} joints for robot {name!r}, got {n}.")


def _check_poses(robot: Robot) -> None:
    poses = {f"links[{i}]": link for i, link in enumerate(robot.links)}
    poses |= {"T_base_mount": robot.T_base_mount, "T_flange_tool": robot.T_flange_tool}
    good = se3.is_pose(np.stack(list(poses.values())))
    for (field, pose), fits in zip(poses.items(), good):
        if not fits:
            rows = "; ".join(" ".join(f"{x:.9g}" for x in row) for row in pose)
            raise RobotError(
                f"Expected {field} of robot {robot.name!r} to be a pose whose rotation is orthonormal within "
                f"{so3.ROTATION_TOLERANCE:g}, got [{rows}]. If the matrix is nearly a rotation, project the pose first "
                "(lie.se3.project)."
            )
    if not np.isfinite(robot.gravity).all():
        raise RobotError(f"Expected finite gravity for robot {robot.name!r}, got {robot.gravity}.")
    if not np.isfinite(robot.coupling).all() or np.linalg.matrix_rank(robot.coupling) < robot.n:
        raise RobotError(f"Expected a full-rank coupling for robot {robot.name!r}, got a rank below {robot.n}.")


def _check_limits(robot: Robot) -> None:
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
    for field, words in (("name", [robot.name]), ("source", [robot.source]), ("joint_names", robot.joint_names)):
        for word in words:
            if not isinstance(word, str):
                raise RobotError(f"Expected text in {field} of robot {robot.name!r}, got {word!r}.")
            if field != "source" and not word.strip():
                raise RobotError(f"Expected a name in {field} of robot {robot.name!r}, got {word!r}. Enter a name.")
    for field in ("joint_names", "abb_axes"):
        value = getattr(robot, field)
        if len(value) != robot.n or len(set(value)) != robot.n:
            raise RobotError(f"Expected {robot.n} different {field} for robot {robot.name!r}, got {list(value)}.")
    if sorted(robot.abb_axes) != list(range(1, robot.n + 1)):
        raise RobotError(
            f"Expected `abb_axes` of robot {robot.name!r} to contain 1 to {robot.n} exactly once each, got "
            f"{list(robot.abb_axes)}."
        )
    if robot.side not in ("left", "right", ""):
        raise RobotError(f'Expected side of robot {robot.name!r} to be "left", "right" or "", got {robot.side!r}.')


def _check_bodies(robot: Robot) -> None:
    """Check that inertias are physically consistent, and that meshes belong to the mount or to a link."""
    if len(robot.meshes) not in (0, robot.n + 1):
        raise RobotError(
            f"Expected meshes of the mount and {robot.n} links in robot {robot.name!r}, got {len(robot.meshes)} tuples."
        )
    for mesh in (mesh for meshes in robot.meshes for mesh in meshes):
        if not isinstance(mesh, Mesh):
            raise RobotError(f"Expected a robots.Mesh in the meshes of robot {robot.name!r}, got {mesh!r}.")
    for i, pi in enumerate([] if robot.inertias is None else robot.inertias):
        fault = body_fault(pi)
        if fault:
            raise RobotError(f"Expected a consistent inertia of link {i + 1} of robot {robot.name!r}, got {fault}.")


def body_fault(pi: np.ndarray) -> str:
    """Describe why inertial parameters (10,) are unphysical, or return ""; the triangle inequality is not checked."""
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
