"""Robots as products of exponentials, with screws in the base or each in its own frame."""

from __future__ import annotations

from typing import NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import RobotError, ShapeError
from armlab.lie import se3
from armlab.robots._axes import frames_along
from armlab.robots.build import Details, from_links
from armlab.robots.robot import POSE_TOLERANCE, Robot

__all__ = ["SCREW_TOLERANCE", "LocalPoe", "from_local_poe", "from_poe", "normalise_screw", "to_local_poe"]

SCREW_TOLERANCE = 1e-9
"""How far a joint screw may be from a unit axis without pitch."""


class LocalPoe(NamedTuple):
    """Local product of exponentials: ``T_base_tool = A_1 exp(xi_1 q_1) ... A_n exp(xi_n q_n) A_tool``.

    Attributes
    ----------
    poses : (n+1, 4, 4) ``A_1 ... A_n, A_tool``; mount and tool included.
    screws : (n, 6) xi [v; w], each in the frame that its A leads to.
    """

    poses: np.ndarray
    screws: np.ndarray


def from_poe(name: str, screws: ArrayLike, T_home: ArrayLike, **details: Unpack[Details]) -> Robot:
    """Return the robot with ``T_mount_flange(q) = exp(xi_1 q_1) ... exp(xi_n q_n) T_home``.

    Parameters
    ----------
    name : name of the robot.
    screws : (n, 6) xi [v; w] in the frame of the mount; w = 0 makes a prismatic joint.
    T_home : (4, 4) the flange at q = 0.
    **details : limits, mount, tool and more, see `Details`.

    Raises
    ------
    RobotError : when a screw is not a unit axis without pitch, or the numbers contradict each other.
    """
    T_home = numbers(T_home, f"T_home of robot {name!r}")
    if T_home.shape != (4, 4) or not se3.is_pose(T_home, POSE_TOLERANCE):
        raise RobotError(f"Expected T_home of robot {name!r} to be a pose (4, 4), got {T_home.tolist()}.")
    screws = numbers(screws, f"screws of robot {name!r}")
    poses = np.tile(np.eye(4), (len(screws) + 1 if screws.ndim else 1, 1, 1))
    poses[-1] = T_home
    return from_local_poe(name, poses, screws, **details)


def from_local_poe(name: str, poses: ArrayLike, screws: ArrayLike, **details: Unpack[Details]) -> Robot:
    """Return the robot with ``T_mount_flange = A_1 exp(xi_1 q_1) ... A_n exp(xi_n q_n) A_flange``.

    Parameters
    ----------
    name : name of the robot.
    poses : (n+1, 4, 4) ``A_1 ... A_n, A_flange``.
    screws : (n, 6) xi [v; w], each in the frame that its A leads to; w = 0 makes a prismatic joint.
    **details : limits, mount, tool and more, see `Details`.

    Raises
    ------
    RobotError : when a screw is not a unit axis without pitch, or the numbers contradict each other.
    """
    poses, screws = numbers(poses, f"poses of robot {name!r}"), numbers(screws, f"screws of robot {name!r}")
    if screws.ndim != 2 or screws.shape[1] != 6 or poses.shape != (len(screws) + 1, 4, 4):
        raise RobotError(
            f"Expected screws of shape (n, 6) and poses of shape (n+1, 4, 4) for robot {name!r}, "
            f"got {screws.shape} and {poses.shape}."
        )
    _check_screws(name, screws)
    frames = _axis_frames(screws)  # exp(xi q) = C Z(q) C⁻¹
    links = poses.copy()
    links[:-1] = links[:-1] @ frames
    links[1:] = se3.inv(frames) @ links[1:]
    return from_links(name, links, ~screws[:, 3:].any(axis=1), **details)


def to_local_poe(robot: Robot) -> LocalPoe:
    """Return the robot as a local product of exponentials, mount and tool included.

    A_j leads to the frame where joint j + 1 begins, so ``xi_j = Ad(E_j⁻¹) e``, e being the z axis of joint j.

    Parameters
    ----------
    robot : any robot.

    Raises
    ------
    RobotError : when it is something else, such as a name.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    poses = np.concatenate([[robot.frames[0] @ robot.frames[1]], robot.frames[2:], [np.eye(4)]])
    z_axes = np.zeros((robot.n, 6))
    z_axes[np.arange(robot.n), np.where(robot.prismatic, 2, 5)] = 1.0
    screws = se3.adjoint_inv(robot.frames[1:]) @ z_axes[..., None]
    return LocalPoe(poses, screws[..., 0])


def normalise_screw(screw: ArrayLike, keep_pitch: bool = False) -> np.ndarray:
    """Return the screw with an axis of length 1 and, unless asked, without pitch: abs(w) = 1, v ⟂ w.

    A screw with w = 0 is a translation: abs(v) = 1.

    Parameters
    ----------
    screw : (..., 6) [v; w].
    keep_pitch : keep the part of v along w.

    Returns
    -------
    (..., 6), a new array.

    Raises
    ------
    ShapeError : when a screw is zero or not finite.
    """
    screw = numbers(screw, "screw", ShapeError)
    if screw.shape[-1:] != (6,):
        raise ShapeError(f"Expected screws of shape (..., 6), got {screw.shape}.")
    turns = screw[..., 3:].any(axis=-1, keepdims=True)
    length = np.linalg.norm(np.where(turns, screw[..., 3:], screw[..., :3]), axis=-1, keepdims=True)
    if not (np.isfinite(screw).all() and (length > 0).all()):
        raise ShapeError("Expected finite screws [v; w] other than zero, got one that is zero or not finite.")
    v, w = np.split(screw / length, 2, axis=-1)
    if not keep_pitch:
        v = v - (v * w).sum(axis=-1, keepdims=True) * w
    return np.concatenate([v, w], axis=-1)


def _check_screws(name: str, screws: np.ndarray) -> None:
    """Every screw is a unit axis without pitch."""
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


def _axis_frames(screws: np.ndarray) -> np.ndarray:
    """Return frames (n, 4, 4) whose z axis is the axis of the screw."""
    v, w = screws[:, :3], screws[:, 3:]
    origin = np.cross(w, v)  # the point of the axis nearest to the origin; 0 when it slides
    return se3.from_rp(frames_along(np.where(w.any(axis=1, keepdims=True), w, v)), origin)
