"""Robots from Denavit-Hartenberg rows or from screws (product of exponentials)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import RobotError
from armlab.robots.robot import Robot

__all__ = ["Details", "from_dh"]

GRAVITY = (0.0, 0.0, -9.80665)
RAMP_TIME = 0.1  # s: acceleration limit when none is given = speed limit reached in this time


class Details(TypedDict, total=False):
    """What a builder may be told beside the geometry; see `Robot`. What is left out gets its default.

    Attributes
    ----------
    q_min, q_max, qd_max : without limit. qdd_max : `qd_max` reached in 0.1 s.
    q_home : zero, moved inside the limits. joint_names : joint_1, joint_2 ...
    T_base_mount, T_flange_tool : identity. gravity : (0, 0, -9.80665) m/s^2. coupling : identity.
    abb_axes : 1, 2 ... n. side, source : empty.
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


def from_links(name: str, links: ArrayLike, prismatic: ArrayLike | None = None, **details: Unpack[Details]) -> Robot:
    """Return the robot whose joints turn about (slide along) z between constant poses.

    ``T_mount_flange = L_0 Z_1(q_1) L_1 ... Z_n(q_n) L_n``.

    Parameters
    ----------
    name : name of the robot.
    links : (n+1, 4, 4) the poses L.
    prismatic : (n,) bool, default all revolute.
    **details : limits, mount, tool and more, see `Details`.

    Raises
    ------
    RobotError : when the numbers contradict each other.
    """
    links = np.asarray(links, dtype=np.float64)
    n = len(links) - 1
    q_min = np.asarray(details.get("q_min", np.full(n, -np.inf)), dtype=np.float64)
    q_max = np.asarray(details.get("q_max", np.full(n, np.inf)), dtype=np.float64)
    qd_max = np.asarray(details.get("qd_max", np.full(n, np.inf)), dtype=np.float64)
    return Robot(
        name=name,
        links=links,
        prismatic=np.zeros(n, dtype=bool) if prismatic is None else np.asarray(prismatic),
        q_min=q_min,
        q_max=q_max,
        qd_max=qd_max,
        qdd_max=np.asarray(details.get("qdd_max", qd_max / RAMP_TIME), dtype=np.float64),
        q_home=np.asarray(details.get("q_home", np.clip(0.0, q_min, q_max)), dtype=np.float64),
        joint_names=tuple(details.get("joint_names", [f"joint_{i + 1}" for i in range(n)])),
        T_base_mount=np.asarray(details.get("T_base_mount", np.eye(4))),
        T_flange_tool=np.asarray(details.get("T_flange_tool", np.eye(4))),
        gravity=np.asarray(details.get("gravity", GRAVITY), dtype=np.float64),
        coupling=np.asarray(details.get("coupling", np.eye(n)), dtype=np.float64),
        abb_axes=tuple(details.get("abb_axes", range(1, n + 1))),
        side=details.get("side", ""),
        source=details.get("source", ""),
    )


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

    Standard: ``A_j = Rz(theta_j) Tz(d_j) Tx(a_j) Rx(alpha_j)``;
    modified: ``A_j = Rx(alpha_j) Tx(a_j) Rz(theta_j) Tz(d_j)``, alpha and a being those of row j as printed
    (often written alpha_{j-1}, a_{j-1}). Revolute: ``theta_j = q_j + offset_j``;
    prismatic: ``theta_j = offset_j`` and q_j adds to d_j.

    Parameters
    ----------
    name : name of the robot.
    alpha, a, d, offset : (n,) rows of the table [rad, m, m, rad].
    prismatic : (n,) bool, default all revolute.
    modified : True for Craig's convention.
    **details : limits, mount, tool and more, see `Details`.

    Raises
    ------
    RobotError : when rows are missing or numbers contradict each other.
    """
    alpha, a, d, offset = _columns(name, alpha=alpha, a=a, d=d, offset=offset)
    along_x, along_z = _screw_x(alpha, a), _screw_z(offset, d)
    links = np.tile(np.eye(4), (len(a) + 1, 1, 1))
    if modified:
        links[:-1] = along_x @ along_z
    else:  # a joint commutes with its own Tz(d), so the angle goes before it and the rest after it
        turn = _screw_z(offset, np.zeros_like(d))
        links[:-1] = turn
        links[1:] = _screw_z(np.zeros_like(d), d) @ along_x
        links[1:-1] = links[1:-1] @ turn[1:]
    return from_links(name, links, prismatic, **details)


def _columns(name: str, **columns: ArrayLike) -> list[np.ndarray]:
    """Return the columns as float vectors of one length; a scalar stands for all rows."""
    arrays = {key: np.asarray(column, dtype=np.float64) for key, column in columns.items()}
    try:
        return list(np.broadcast_arrays(*(np.atleast_1d(array) for array in arrays.values())))
    except ValueError:
        sizes = ", ".join(f"{key} {array.size}" for key, array in arrays.items())
        raise RobotError(f"Expected DH columns of one length for robot {name!r}, got {sizes}.") from None


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
