"""How well a posture can move and push: singular values, manipulability and its gradient, ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import make_read_only
from armlab.errors import UnknownName
from armlab.kinematics.forward import jacobian
from armlab.robots import Robot

__all__ = ["Ellipsoid", "ellipsoid", "manipulability", "manipulability_gradient", "singular_values"]

Part = Literal["pose", "position", "rotation"]

_ROWS = {"pose": slice(0, 6), "position": slice(0, 3), "rotation": slice(3, 6)}


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An ellipsoid about the tool point, or a batch of them; arrays are read-only.

    Attributes
    ----------
    axes : (..., 3, 3) directions of the semi-axes as columns, right-handed, base axes; signs are arbitrary.
    lengths : (..., 3) lengths of the semi-axes. Velocity: m/s or rad/s per unit of joint speed, longest first. Force: N
        or N m per unit of joint torque, shortest first, infinite where the joints carry any load.
    """

    axes: np.ndarray
    lengths: np.ndarray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        make_read_only(self, "axes", "lengths")


def singular_values(robot: Robot, q: ArrayLike, part: Part = "pose") -> np.ndarray:
    """Return the singular values of the Jacobian, or of its rows for one part of the twist.

    ``J = U diag(s) V^T``. ``s[..., -1]`` is the smallest tool speed per unit of joint speed that a direction of the
    task can have: the distance to the nearest singular Jacobian, 0 in a singular posture. ``s[..., 0] / s[..., -1]`` is
    the condition number.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    part : "pose" for all six rows (its values mix metres and radians), "position" [m/rad] or "rotation".

    Returns
    -------
    s : (..., min(m, n)) in descending order, with m = 6 rows for the pose and 3 for a part of it.

    Raises
    ------
    UnknownName
        When there is no such part.
    ShapeError
        When the last axis of `q` is not n long.
    RobotError
        When something else comes in place of a robot, such as its name.
    """
    return _svd(_rows(robot, q, part))[1]


def manipulability(robot: Robot, q: ArrayLike, part: Part = "pose") -> np.ndarray:
    """Return Yoshikawa's manipulability, the volume that the unit ball of joint velocities makes of the twists.

    ``w = sqrt(det(J J^T))``, the product of the singular values. Where the arm has fewer joints n than the part has
    rows, that determinant is 0 in every posture; then ``w = sqrt(det(J^T J))``, the same product of the n singular
    values: the volume within the n directions that the joints can move. It comes from an orthogonal factorisation of J,
    not from J J^T, so that near a singular posture it is right to a rounding of J instead of its square root.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    part : "pose" (mixes metres and radians: compare postures of one robot only), "position" or "rotation".

    Returns
    -------
    w : (...), at least 0, and 0 in singular postures.

    Raises
    ------
    UnknownName
        When there is no such part.
    ShapeError
        When the last axis of `q` is not n long.
    RobotError
        When something else comes in place of a robot, such as its name.

    References
    ----------
    Yoshikawa, Manipulability of robotic mechanisms, Int. J. Robotics Research 4(2), 1985, eq. 8.
    """
    J = _rows(robot, q, part)
    tall = J if J.shape[-2] >= J.shape[-1] else np.swapaxes(J, -1, -2)
    R = np.linalg.qr(tall, mode="r")
    return np.abs(np.diagonal(R, axis1=-2, axis2=-1)).prod(axis=-1)


def manipulability_gradient(robot: Robot, q: ArrayLike, part: Part = "pose") -> np.ndarray:
    """Return the derivative of `manipulability` by the joint positions.

    ``dw/dq_k = sum over i of (u_i^T dJ/dq_k v_i) * product of the other singular values``, which needs no division by
    a small one. In a singular posture, where w has a kink, it is one of the one-sided slopes.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    part : "pose", "position" or "rotation", as in `manipulability`.

    Returns
    -------
    gradient : (..., n) [unit of w per rad or m].

    Raises
    ------
    UnknownName
        When there is no such part.
    ShapeError
        When the last axis of `q` is not n long.
    RobotError
        When something else comes in place of a robot, such as its name.
    """
    U, s, Vt = _svd(_rows(robot, q, part))
    positions = np.asarray(q, dtype=np.float64)[..., None, :]
    each_joint = np.broadcast_to(np.eye(robot.n), (*positions.shape[:-2], robot.n, robot.n))
    dJ = robot.chain.jacobian_derivative(np.broadcast_to(positions, each_joint.shape), each_joint)[..., _ROWS[part], :]
    slopes = np.einsum("...ai,...kab,...ib->...ki", U[..., : s.shape[-1]], dJ, Vt[..., : s.shape[-1], :])
    others = np.stack([np.delete(s, i, axis=-1).prod(axis=-1) for i in range(s.shape[-1])], axis=-1)
    return (slopes @ others[..., None])[..., 0]


def ellipsoid(
    robot: Robot,
    q: ArrayLike,
    part: Literal["position", "rotation"] = "position",
    kind: Literal["velocity", "force"] = "velocity",
) -> Ellipsoid:
    """Return the ellipsoid of the tool's velocities, or of the forces that it can press with.

    ``{J qd : |qd| <= 1}`` (velocity) or ``{f : |J^T f| <= 1}`` (force), with the three rows of J for the part. Both
    have the same axes, and the lengths are reciprocal: where the tool moves fast it presses weakly.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    part : "position" for the velocity of the tool point or the force on it, "rotation" for angular velocity or moment.
    kind : "velocity" or "force".

    Returns
    -------
    Ellipsoid
        Its axes (..., 3, 3) in base axes and their lengths (..., 3).

    Raises
    ------
    UnknownName
        When there is no such part or kind.
    ShapeError
        When the last axis of `q` is not n long.
    RobotError
        When something else comes in place of a robot, such as its name.
    """
    if not isinstance(part, str) or part not in ("position", "rotation"):
        raise UnknownName.among("part of a twist with an ellipsoid", part, ("position", "rotation"))
    if not isinstance(kind, str) or kind not in ("velocity", "force"):
        raise UnknownName.among("kind of ellipsoid", kind, ("velocity", "force"))
    axes, s, _ = _svd(_rows(robot, q, part))
    axes[..., 2] = np.cross(axes[..., 0], axes[..., 1])
    lengths = np.zeros(axes.shape[:-1])
    lengths[..., : s.shape[-1]] = s
    if kind == "force":
        with np.errstate(divide="ignore"):
            lengths = 1.0 / lengths
    return Ellipsoid(axes, lengths)


def _rows(robot: Robot, q: ArrayLike, part: Part) -> np.ndarray:
    if not isinstance(part, str) or part not in _ROWS:
        raise UnknownName.among("part of a twist", part, _ROWS)
    J = jacobian(robot, q)
    J[~np.isfinite(q).all(axis=-1)] = np.nan  # also the rows that do not depend on the joint that is missing
    return J[..., _ROWS[part], :]


def _svd(J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """U, s and V^T, square U and V; NaN in those samples of a batch that hold NaN, which LAPACK would refuse."""
    known = np.asarray(np.isfinite(J).all(axis=(-2, -1)))
    U, s, Vt = np.linalg.svd(np.where(known[..., None, None], J, 0.0))
    U[~known], s[~known], Vt[~known] = np.nan, np.nan, np.nan
    return U, s, Vt
