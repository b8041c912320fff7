"""Build robots from constant links, Denavit-Hartenberg rows or products of exponentials."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import members, numbers
from armlab.errors import RobotError, ShapeError
from armlab.lie import se3
from armlab.robots.robot import Mesh, Robot, arm_length, check_joint_count

GRAVITY = (0.0, 0.0, -9.80665)
"""Standard gravity on an upright arm [m/s^2]."""

RAMP_TIME = 0.1
"""Time [s] in which a joint reaches its speed limit at the default acceleration limit."""

LIKE_DEGREES = (8.0 * np.pi, 500.0)
"""Revolute limits in this range [rad] are probably degrees: few axes exceed four revolutions; ABB axes allow 96."""
SCREW_TOLERANCE = 1e-9
"""Tolerance on the length and pitch of a zero-pitch unit screw."""


class Details(TypedDict, total=False):
    """Optional arguments of the builders (see `Robot`), with their defaults.

    Attributes
    ----------
    q_min, q_max, qd_max, tau_max : infinite.
    qdd_max : acceleration that reaches `qd_max` in `RAMP_TIME`.
    q_home : zero, or the limit closest to zero.
    joint_names : joint_1, joint_2 ...
    T_base_mount, T_flange_tool, coupling : identity.
    gravity : `GRAVITY`.
    abb_axes : 1, 2 ... n.
    side, source, meshes : empty.
    inertias, drives : unknown.
    """

    q_min: ArrayLike
    q_max: ArrayLike
    qd_max: ArrayLike
    qdd_max: ArrayLike
    q_home: ArrayLike
    joint_names: Sequence[str]
    T_base_mount: ArrayLike
    T_flange_tool: ArrayLike
    gravity: ArrayLike
    coupling: ArrayLike
    abb_axes: Sequence[int]
    side: Literal["left", "right", ""]
    source: str
    tau_max: ArrayLike
    inertias: ArrayLike | None
    meshes: Sequence[Sequence[Mesh]]
    drives: Mapping[str, ArrayLike]


def from_links(name: str, links: ArrayLike, prismatic: ArrayLike | None = None, **details: Unpack[Details]) -> Robot:
    """Return the robot with revolute or prismatic joints along z between constant poses.

    ``T_mount_flange = L_0 Z_1(q_1) L_1 ... Z_n(q_n) L_n``. A warning reports revolute limits that look like degrees.

    Parameters
    ----------
    name : name of the robot.
    links : (n+1, 4, 4) poses L.
    prismatic : (n,) bool; default: all revolute.
    **details : limits, mount, tool and more; see `Details`.

    Raises
    ------
    RobotError : if the numbers are inconsistent or a detail has an unknown name.
    """
    for unknown in details.keys() - Details.__annotations__.keys():
        raise RobotError(
            f"Expected the details of robot {name!r} to be among {', '.join(Details.__annotations__)}, got {unknown!r}."
        )

    def given(field: str, default: ArrayLike) -> np.ndarray:
        return numbers(details.get(field, default), f"{field} of robot {name!r}")

    def listed(field: str, default: Sequence[Any]) -> tuple[Any, ...]:
        return members(details.get(field, default), f"{field} of robot {name!r}")

    links = numbers(links, f"links of robot {name!r}")
    n = max(len(links) - 1, 0) if links.ndim else 0
    check_joint_count(name, n)
    unlimited = np.full(n, np.inf)
    q_min, q_max, qd_max = given("q_min", -unlimited), given("q_max", unlimited), given("qd_max", unlimited)
    slides = np.zeros(n) if prismatic is None else numbers(prismatic, f"prismatic of robot {name!r}")
    if slides.shape != (n,):
        raise RobotError(
            f"Expected `prismatic` of robot {name!r} ({n} joints) to have shape ({n},), got {slides.shape}."
        )
    inertias = details.get("inertias")
    home = np.clip(0.0, q_min, q_max) if q_min.shape == q_max.shape == (n,) else np.zeros(n)
    robot = Robot(
        name=name, links=links, prismatic=slides, q_min=q_min, q_max=q_max, qd_max=qd_max,
        qdd_max=given("qdd_max", qd_max / RAMP_TIME), q_home=given("q_home", home),
        joint_names=listed("joint_names", [f"joint_{i + 1}" for i in range(n)]),
        T_base_mount=given("T_base_mount", np.eye(4)), T_flange_tool=given("T_flange_tool", np.eye(4)),
        gravity=given("gravity", GRAVITY), coupling=given("coupling", np.eye(n)),
        abb_axes=listed("abb_axes", range(1, n + 1)), side=details.get("side", ""), source=details.get("source", ""),
        tau_max=given("tau_max", unlimited), inertias=None if inertias is None else given("inertias", ()),
        meshes=listed("meshes", ()), drives=tuple(details.get("drives", {}).items()),  # type: ignore[arg-type]
    )  # fmt: skip
    _doubt_limits(robot)
    return robot


def from_dh(
    name: str,
    alpha: ArrayLike,
    a: ArrayLike,
    d: ArrayLike,
    offset: ArrayLike = 0.0,
    *,
    prismatic: ArrayLike | None = None,
    modified: bool = False,
    **details: Unpack[Details],
) -> Robot:
    """Return the robot described by a Denavit-Hartenberg table.

    Standard: ``A_j = Rz(theta_j) Tz(d_j) Tx(a_j) Rx(alpha_j)``.
    Modified: ``A_j = Rx(alpha_j) Tx(a_j) Rz(theta_j) Tz(d_j)``, with alpha and a as printed in row j (alpha_{j-1} and
    a_{j-1} in Craig's notation). ``theta_j = offset_j + q_j``; the position of a prismatic joint is added to d_j
    instead. Warnings report angles of more than one revolution and revolute limits that look like degrees.

    Parameters
    ----------
    name : name of the robot.
    alpha, a, d, offset : (n,) columns of the table [rad, m, m, rad]; a scalar applies to all rows.
    prismatic : (n,) bool; default: all revolute.
    modified : whether the table follows the modified convention.
    **details : limits, mount, tool and more; see `Details`.

    Raises
    ------
    RobotError : if the columns have different lengths, contain NaN, or the numbers are inconsistent.
    """
    if not isinstance(modified, bool | np.bool_):  # the string "standard" is truthy
        raise RobotError(f"Expected `modified` of robot {name!r} to be True or False, got {modified!r}.")
    alpha, a, d, offset = _columns(name, alpha=alpha, a=a, d=d, offset=offset)
    for key, angles in (("alpha", alpha), ("offset", offset)):
        if np.abs(angles).max(initial=0.0) > 2.0 * np.pi:
            got = f"{key} of {np.abs(angles).max():.4g} rad in the DH table of {name!r}"
            _doubt(f"Expected angles of at most one revolution, got {got}")
    along_x = _screw_x(alpha, a)
    links = np.tile(np.eye(4), (len(a) + 1, 1, 1))
    if modified:
        links[:-1] = along_x @ _screw_z(offset, d)
    else:  # a joint commutes with its own Rz(offset) Tz(d): place the rotation before it, the translation after it
        links[:-1] = _screw_z(offset, np.zeros_like(d))
        links[1:] = _screw_z(np.zeros_like(d), d) @ along_x @ links[[*range(1, len(a)), -1]]
    return from_links(name, links, prismatic, **details)


_NEAR = 0.06  # inverse condition number at which the search for a home posture stops
_STEPS = (0.25, 0.5, 0.75, 1.0, 1.25)  # successive search radii around mid-range, relative to `room`
_TRIES = 64


def dexterous_home(robot: Robot) -> np.ndarray:
    """Return a non-singular posture (n,) near mid-range, if the search finds one.

    The search compares random postures near mid-range by the conditioning of their Jacobian, with lengths divided by
    the reach. Unlimited joints start at 0.
    """
    limited = np.isfinite(robot.q_min) & np.isfinite(robot.q_max)
    low, high = np.where(limited, robot.q_min, 0.0), np.where(limited, robot.q_max, 0.0)
    half = np.where(limited, 0.5 * (high - low), np.pi)
    room = np.where(robot.prismatic, np.where(limited, 0.5 * half, 0.0), np.minimum(1.0, 0.5 * half))
    middle = np.where(limited, low + 0.5 * (high - low), np.clip(0.0, robot.q_min + 0.1, robot.q_max - 0.1))
    scale = np.array([1.0 / arm_length(robot)] * 3 + [1.0] * 3)[:, None]
    size = np.where(robot.prismatic, arm_length(robot), 1.0)

    def conditioning(q: np.ndarray) -> np.ndarray:
        values = np.linalg.svd(robot.chain.jacobian(q) * scale * size, compute_uv=False)
        return values[..., -1] / values[..., 0]

    best, value = middle, float(conditioning(middle))
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (_TRIES, robot.n))
    for step in _STEPS:
        if value >= _NEAR:
            break
        tried = middle + step * room * draws
        found = conditioning(tried)
        if found.max() > value + 1e-6:
            best, value = tried[int(found.argmax())], float(found.max())
    return np.round(best, 3) if value > float(conditioning(middle)) else middle


def _columns(name: str, **columns: ArrayLike) -> tuple[np.ndarray, ...]:
    arrays = {
        key: np.atleast_1d(numbers(column, f"{key} in the DH table of {name!r}")) for key, column in columns.items()
    }
    for key, array in arrays.items():
        if array.ndim > 1:
            raise RobotError(
                f"Expected {key} in the DH table of {name!r} to be one column (n,), got shape {array.shape}."
            )
        if not np.isfinite(array).all():
            i = int(np.argmin(np.isfinite(array)))
            raise RobotError(f"Expected finite {key} in the DH table of {name!r}, got {array[i]} at joint {i + 1}.")
    try:
        return np.broadcast_arrays(*arrays.values())
    except ValueError:
        sizes = ", ".join(f"{key} {array.size}" for key, array in arrays.items())
        raise RobotError(f"Expected DH columns of equal length for robot {name!r}, got {sizes}.") from None


def _doubt_limits(robot: Robot) -> None:
    ends = np.abs(np.stack([robot.q_min, robot.q_max]))
    peak = np.where(np.isfinite(ends), ends, 0.0).max(axis=0)
    far = np.flatnonzero(~robot.prismatic & (peak > LIKE_DEGREES[0]) & (peak <= LIKE_DEGREES[1]))
    if len(far):
        words = [f"{robot.joint_names[i]} ({robot.q_min[i]:.4g} to {robot.q_max[i]:.4g} rad)" for i in far]
        _doubt(f"Expected revolute limits of robot {robot.name!r} within four revolutions, got {', '.join(words)}")


def _doubt(what: str) -> None:
    warnings.warn(
        f"{what}. If these are degrees, convert them: numpy.deg2rad in Python, names with _deg in a robot file.",
        UserWarning,
        stacklevel=4,
    )


def _screw_z(angle: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return Rz(angle) Tz(shift) (n, 4, 4)."""
    T = np.tile(np.eye(4), (len(angle), 1, 1))
    c, s = np.cos(angle), np.sin(angle)
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, 2, 3] = shift
    return T


def _screw_x(angle: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return Rx(angle) Tx(shift) (n, 4, 4)."""
    T = np.tile(np.eye(4), (len(angle), 1, 1))
    c, s = np.cos(angle), np.sin(angle)
    T[:, 1, 1], T[:, 1, 2], T[:, 2, 1], T[:, 2, 2] = c, -s, s, c
    T[:, 0, 3] = shift
    return T


class LocalPoe(NamedTuple):
    """Local product of exponentials: ``T_base_tool = A_1 exp(xi_1 q_1) ... A_n exp(xi_n q_n) A_tool``.

    Attributes
    ----------
    poses : (n+1, 4, 4) ``A_1 ... A_n, A_tool``; mount and tool included.
    screws : (n, 6) xi [v; w], each in the frame of its A.
    """

    poses: np.ndarray
    screws: np.ndarray


def from_poe(name: str, screws: ArrayLike, T_home: ArrayLike, **details: Unpack[Details]) -> Robot:
    """Return the robot with ``T_mount_flange(q) = exp(xi_1 q_1) ... exp(xi_n q_n) T_home``.

    Parameters
    ----------
    name : name of the robot.
    screws : (n, 6) xi [v; w] in the frame of the mount; w = 0 for a prismatic joint.
    T_home : (4, 4) pose of the flange in the mount frame at q = 0.
    **details : limits, mount, tool and more; see `Details`.

    Raises
    ------
    RobotError : if a screw does not have a unit axis and zero pitch, or the numbers are inconsistent.
    """
    T_home = numbers(T_home, f"T_home of robot {name!r}")
    if T_home.shape != (4, 4) or not se3.is_pose(T_home):
        raise RobotError(f"Expected T_home of robot {name!r} to be a pose (4, 4), got {T_home.tolist()}.")
    screws = numbers(screws, f"screws of robot {name!r}")
    poses = np.tile(np.eye(4), (len(screws) + 1 if screws.ndim else 1, 1, 1))
    poses[-1] = se3.orthonormalise(T_home)
    return from_local_poe(name, poses, screws, **details)


def from_local_poe(name: str, poses: ArrayLike, screws: ArrayLike, **details: Unpack[Details]) -> Robot:
    """Return the robot with ``T_mount_flange = A_1 exp(xi_1 q_1) ... A_n exp(xi_n q_n) A_flange``.

    Parameters
    ----------
    name : name of the robot.
    poses : (n+1, 4, 4) ``A_1 ... A_n, A_flange``.
    screws : (n, 6) xi [v; w], each in the frame of its A; w = 0 for a prismatic joint.
    **details : limits, mount, tool and more; see `Details`.

    Raises
    ------
    RobotError : if a screw does not have a unit axis and zero pitch, or the numbers are inconsistent.
    """
    poses, screws = numbers(poses, f"poses of robot {name!r}"), numbers(screws, f"screws of robot {name!r}")
    if screws.ndim != 2 or screws.shape[1] != 6 or poses.shape != (len(screws) + 1, 4, 4):
        raise RobotError(
            f"Expected screws of shape (n, 6) and poses of shape (n+1, 4, 4) for robot {name!r}, "
            f"got {screws.shape} and {poses.shape}."
        )
    _check_screws(name, screws)
    v, w = screws[:, :3], screws[:, 3:]
    axes = np.where(w.any(axis=1, keepdims=True), w, v)
    # exp(xi q) = C Z(q) C⁻¹, with C at the point of the axis nearest to the origin, or at 0 for a prismatic joint
    frames = se3.from_rp(frames_along(axes), np.cross(w, v))
    links = poses.copy()
    links[:-1] = links[:-1] @ frames
    links[1:] = se3.inv(frames) @ links[1:]
    return from_links(name, links, ~screws[:, 3:].any(axis=1), **details)


def to_local_poe(robot: Robot) -> LocalPoe:
    """Return the robot as a local product of exponentials, including mount and tool.

    A_j is the pose of the frame of joint j + 1 in the preceding frame, so ``xi_j = Ad(E_j⁻¹) e``, where e is the z axis
    of joint j.

    Parameters
    ----------
    robot : any robot.

    Raises
    ------
    RobotError : if `robot` is not a `Robot`.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    poses = np.concatenate([[robot.frames[0] @ robot.frames[1]], robot.frames[2:], [np.eye(4)]])
    z_axes = np.zeros((robot.n, 6))
    z_axes[np.arange(robot.n), np.where(robot.prismatic, 2, 5)] = 1.0
    screws = se3.adjoint_inv(robot.frames[1:]) @ z_axes[..., None]
    return LocalPoe(poses, screws[..., 0])


def normalise_screw(screw: ArrayLike, keep_pitch: bool = False) -> np.ndarray:
    """Return the screw (..., 6) with a unit axis and, by default, zero pitch: abs(w) = 1, v ⟂ w.

    A screw with w = 0 is a translation with abs(v) = 1.

    Parameters
    ----------
    screw : (..., 6) [v; w].
    keep_pitch : whether to keep the part of v along w.

    Raises
    ------
    ShapeError : if a screw is zero or not finite.
    """
    screw = numbers(screw, "screw", ShapeError)
    if screw.shape[-1:] != (6,):
        raise ShapeError(f"Expected screws of shape (..., 6), got {screw.shape}.")
    turns = screw[..., 3:].any(axis=-1, keepdims=True)
    length = np.linalg.norm(np.where(turns, screw[..., 3:], screw[..., :3]), axis=-1, keepdims=True)
    if not (np.isfinite(screw).all() and (length > 0).all()):
        raise ShapeError("Expected finite screws [v; w] of nonzero length, got a screw that is zero or not finite.")
    v, w = np.split(screw / length, 2, axis=-1)
    if not keep_pitch:
        v = v - (v * w).sum(axis=-1, keepdims=True) * w
    return np.concatenate([v, w], axis=-1)


def _check_screws(name: str, screws: np.ndarray) -> None:
    v, w = screws[:, :3], screws[:, 3:]
    turns = w.any(axis=1, keepdims=True)
    length = np.linalg.norm(np.where(turns, w, v), axis=1)
    pitch = (v * w).sum(axis=1)
    for i in range(len(screws)):
        if not (abs(length[i] - 1) <= SCREW_TOLERANCE and abs(pitch[i]) <= SCREW_TOLERANCE):
            raise RobotError(
                f"Expected a unit axis without pitch (within {SCREW_TOLERANCE:g}) for joint {i + 1} of robot {name!r}, "
                f"got length {length[i]:.9g} and pitch {pitch[i]:.3g} m/rad. Use robots.normalise_screw."
            )


def frames_along(z: np.ndarray) -> np.ndarray:
    """Return rotations whose third column is along z (n, 3); exact for coordinate axes, the identity for (0, 0, 1)."""
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x = np.eye(3)[np.argmin(np.abs(z), axis=1)]
    x = x - (x * z).sum(axis=1, keepdims=True) * z
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
