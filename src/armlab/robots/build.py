"""Robots from constant links or from Denavit-Hartenberg rows."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import members, numbers
from armlab.errors import RobotError
from armlab.robots._consistency import check_joint_count
from armlab.robots.mesh import Mesh
from armlab.robots.robot import Robot

__all__ = ["GRAVITY", "RAMP_TIME", "Details", "from_dh", "from_links"]

GRAVITY = (0.0, 0.0, -9.80665)
"""Standard gravity on an upright arm [m/s^2]."""

RAMP_TIME = 0.1
"""Where no acceleration limit is given, the speed limit is reached in this time [s]."""

LIKE_DEGREES = (8.0 * np.pi, 500.0)
"""Limits between these [rad] are degrees, as a rule: few axes turn four times, and those of ABB that do 96 times."""


class Details(TypedDict, total=False):
    """What a builder may be told beside the geometry (see `Robot`), and what holds when it is not told.

    Attributes
    ----------
    q_min, q_max, qd_max : infinite. qdd_max : `qd_max` reached in `RAMP_TIME`.
    q_home : zero, moved inside the limits. joint_names : joint_1, joint_2 ...
    T_base_mount, T_flange_tool, coupling : identity. gravity : `GRAVITY`.
    abb_axes : 1, 2 ... n. side, source : empty. tau_max : infinite. inertias : None. meshes : none.
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


def from_links(name: str, links: ArrayLike, prismatic: ArrayLike | None = None, **details: Unpack[Details]) -> Robot:
    """Return the robot whose joints turn about, or slide along, z between constant poses.

    ``T_mount_flange = L_0 Z_1(q_1) L_1 ... Z_n(q_n) L_n``. Limits of a revolute joint that look like degrees are warned
    of.

    Parameters
    ----------
    name : name of the robot.
    links : (n+1, 4, 4) the poses L.
    prismatic : (n,) bool, default all revolute.
    **details : limits, mount, tool and more, see `Details`.

    Raises
    ------
    RobotError : when the numbers contradict each other or a detail has an unknown name.
    """
    for unknown in details.keys() - Details.__annotations__.keys():
        raise RobotError(
            f"Expected details of robot {name!r} among {', '.join(Details.__annotations__)}, got {unknown!r}."
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
        raise RobotError(f"Expected prismatic of robot {name!r} ({n} joints) to have shape ({n},), got {slides.shape}.")
    inertias = details.get("inertias")
    home = np.clip(0.0, q_min, q_max) if q_min.shape == q_max.shape == (n,) else np.zeros(n)
    robot = Robot(
        name=name,
        links=links,
        prismatic=slides,
        q_min=q_min,
        q_max=q_max,
        qd_max=qd_max,
        qdd_max=given("qdd_max", qd_max / RAMP_TIME),
        q_home=given("q_home", home),
        joint_names=listed("joint_names", [f"joint_{i + 1}" for i in range(n)]),
        T_base_mount=given("T_base_mount", np.eye(4)),
        T_flange_tool=given("T_flange_tool", np.eye(4)),
        gravity=given("gravity", GRAVITY),
        coupling=given("coupling", np.eye(n)),
        abb_axes=listed("abb_axes", range(1, n + 1)),
        side=details.get("side", ""),
        source=details.get("source", ""),
        tau_max=given("tau_max", unlimited),
        inertias=None if inertias is None else given("inertias", ()),
        meshes=listed("meshes", ()),
    )
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
    """Return the robot of a Denavit-Hartenberg table.

    Standard: ``A_j = Rz(theta_j) Tz(d_j) Tx(a_j) Rx(alpha_j)``.
    Modified: ``A_j = Rx(alpha_j) Tx(a_j) Rz(theta_j) Tz(d_j)``; alpha and a are those printed in row j
    (called alpha_{j-1} and a_{j-1} by Craig). ``theta_j = offset_j + q_j``; the position of a prismatic joint adds to
    d_j instead. Angles of more than a turn, and limits of a revolute joint that look like degrees, are warned of.

    Parameters
    ----------
    name : name of the robot.
    alpha, a, d, offset : (n,) columns of the table [rad, m, m, rad]; a number stands for all rows.
    prismatic : (n,) bool, default all revolute.
    modified : True for the modified convention.
    **details : limits, mount, tool and more, see `Details`.

    Raises
    ------
    RobotError : when the columns have different lengths, hold NaN, or the numbers contradict each other.
    """
    if not isinstance(modified, bool | np.bool_):  # "standard" would count as True
        raise RobotError(f"Expected modified of robot {name!r} to be True or False, got {modified!r}.")
    alpha, a, d, offset = _columns(name, alpha=alpha, a=a, d=d, offset=offset)
    for key, angles in (("alpha", alpha), ("offset", offset)):
        if np.abs(angles).max(initial=0.0) > 2.0 * np.pi:
            got = f"{key} of {np.abs(angles).max():.4g} rad in the DH table of {name!r}"
            _doubt(f"Expected angles of at most one turn, got {got}")
    along_x = _screw_x(alpha, a)
    links = np.tile(np.eye(4), (len(a) + 1, 1, 1))
    if modified:
        links[:-1] = along_x @ _screw_z(offset, d)
    else:  # a joint commutes with its own Rz(offset) Tz(d): the turn goes before it, the shift after it
        links[:-1] = _screw_z(offset, np.zeros_like(d))
        links[1:] = _screw_z(np.zeros_like(d), d) @ along_x @ links[[*range(1, len(a)), -1]]
    return from_links(name, links, prismatic, **details)


def _columns(name: str, **columns: ArrayLike) -> tuple[np.ndarray, ...]:
    """Return the columns as vectors of one length."""
    arrays = {
        key: np.atleast_1d(numbers(column, f"{key} in the DH table of {name!r}")) for key, column in columns.items()
    }
    for key, array in arrays.items():
        if array.ndim > 1:
            raise RobotError(f"Expected {key} in the DH table of {name!r} as one column (n,), got shape {array.shape}.")
        if not np.isfinite(array).all():
            i = int(np.argmin(np.isfinite(array)))
            raise RobotError(f"Expected finite {key} in the DH table of {name!r}, got {array[i]} at joint {i + 1}.")
    try:
        return np.broadcast_arrays(*arrays.values())
    except ValueError:
        sizes = ", ".join(f"{key} {array.size}" for key, array in arrays.items())
        raise RobotError(f"Expected DH columns of one length for robot {name!r}, got {sizes}.") from None


def _doubt_limits(robot: Robot) -> None:
    """Warn of limits that look like degrees."""
    ends = np.abs(np.stack([robot.q_min, robot.q_max]))
    peak = np.where(np.isfinite(ends), ends, 0.0).max(axis=0)
    far = np.flatnonzero(~robot.prismatic & (peak > LIKE_DEGREES[0]) & (peak <= LIKE_DEGREES[1]))
    if len(far):
        words = [f"{robot.joint_names[i]} ({robot.q_min[i]:.4g} to {robot.q_max[i]:.4g} rad)" for i in far]
        _doubt(f"Expected limits of revolute joints of robot {robot.name!r} within four turns, got {', '.join(words)}")


def _doubt(what: str) -> None:
    warnings.warn(
        f"{what}. If these are degrees, convert them: numpy.deg2rad in Python, names with _deg in a robot file.",
        UserWarning,
        stacklevel=4,
    )


def _screw_z(angle: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Rz(angle) Tz(shift), (n, 4, 4)."""
    T = np.tile(np.eye(4), (len(angle), 1, 1))
    c, s = np.cos(angle), np.sin(angle)
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
    T[:, 2, 3] = shift
    return T


def _screw_x(angle: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Rx(angle) Tx(shift), (n, 4, 4)."""
    T = np.tile(np.eye(4), (len(angle), 1, 1))
    c, s = np.cos(angle), np.sin(angle)
    T[:, 1, 1], T[:, 1, 2], T[:, 2, 1], T[:, 2, 2] = c, -s, s, c
    T[:, 0, 3] = shift
    return T
