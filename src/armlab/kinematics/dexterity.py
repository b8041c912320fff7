"""Dexterity of a posture: singular values, manipulability, ellipsoids and self-motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only, numbers
from armlab.errors import RobotError, ShapeError, SingularPoseError, UnknownName
from armlab.kinematics.forward import forward, jacobian
from armlab.lie import so3
from armlab.robots import Robot

Part = Literal["pose", "position", "rotation"]

_ROWS = {"pose": slice(0, 6), "position": slice(0, 3), "rotation": slice(3, 6)}

Task = Literal["pose", "position", "axis"]

# number of constrained twist rows in tool axes; the last row is the rotation about the tool's z axis
_TASK_ROWS = {"pose": 6, "position": 3, "axis": 5}
_STEP = 0.02  # largest integration step [rad]
_SHORTEST = 1e-7  # smallest integration step [rad]
_EXACT = 1e-12  # residual of the correction [m, rad], and rounding margin at the limits
_DRIFT = 1e-4  # largest correction, relative to the step length
_MOST = 10**6  # largest number of points
_FARTHEST = 1e3  # largest length [rad or m]; beyond it, a closed self-motion only repeats
_SINGULAR = 1e-9  # relative to the largest singular value


@dataclass(frozen=True, eq=False, repr=False)
class Ellipsoid(Shown):
    """Ellipsoid centred at the tool point, or a batch of ellipsoids; arrays are read-only.

    Attributes
    ----------
    axes : (..., 3, 3) directions of the semi-axes as columns, in base axes, right-handed; signs are arbitrary.
    lengths : (..., 3) lengths of the semi-axes. Velocity ellipsoid: m/s or rad/s per unit of joint speed, longest
        first. Force: N or N m per unit of joint torque, shortest first; infinite in directions that load only the
        structure.
    """

    axes: np.ndarray
    lengths: np.ndarray

    def __post_init__(self) -> None:
        make_read_only(self, "axes", "lengths")


def singular_values(robot: Robot, q: ArrayLike, part: Part = "pose") -> np.ndarray:
    """Return the singular values (..., min(m, n)) of the Jacobian, or of its rows for one part of the twist.

    ``J = U diag(s) V^T`` with descending s; J has m = 6 rows for the pose, and 3 rows for position or rotation only.
    ``s[..., -1]`` is the smallest tool speed per unit of joint speed over all directions. The smallest singular value
    equals the distance to the nearest singular Jacobian and is 0 in a singular posture. ``s[..., 0] / s[..., -1]`` is
    the condition number.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    part : "pose" for all six rows (mixes metres and radians), "position" [m/rad] or "rotation".

    Raises
    ------
    UnknownName : if `part` is unknown.
    ShapeError : if the last axis of `q` does not have length n.
    RobotError : if `robot` is not a `Robot`.
    """
    return _svd(_rows(robot, q, part))[1]


def manipulability(robot: Robot, q: ArrayLike, part: Part = "pose") -> np.ndarray:
    """Return Yoshikawa's manipulability (...), the volume of the twists produced by the unit ball of joint velocities.

    ``w = sqrt(det(J J^T))``, the product of the singular values, is 0 in singular postures. If the arm has fewer joints
    n than the part has rows, this determinant is 0 in every posture. The result is then ``w = sqrt(det(J^T J))``, the
    volume within the n directions in which the joints can move the tool. The manipulability is computed by an
    orthogonal factorisation of J, and is therefore accurate to the rounding error of J near singular postures.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    part : "pose" (mixes metres and radians: compare postures of one robot only), "position" or "rotation".

    Raises
    ------
    UnknownName, ShapeError, RobotError : as in `singular_values`.

    References
    ----------
    Yoshikawa, Manipulability of robotic mechanisms, Int. J. Robotics Research 4(2), 1985, eq. 8.
    """
    J = _rows(robot, q, part)
    tall = J if J.shape[-2] >= J.shape[-1] else np.swapaxes(J, -1, -2)
    R = np.linalg.qr(tall, mode="r")
    return np.abs(np.diagonal(R, axis1=-2, axis2=-1)).prod(axis=-1)


def manipulability_gradient(robot: Robot, q: ArrayLike, part: Part = "pose") -> np.ndarray:
    """Return the derivative (..., n) of `manipulability` w with respect to the joints [unit of w per rad or m].

    ``dw/dq_k = sum over i of (u_i^T dJ/dq_k v_i) * product of the other singular values``, without division by small
    singular values. In a singular posture, where w has a kink, the result is a one-sided derivative.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    part : "pose", "position" or "rotation", as in `manipulability`.

    Raises
    ------
    UnknownName, ShapeError, RobotError : as in `singular_values`.
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
    """Return the velocity or force ellipsoid of the tool, in base axes.

    ``{J qd : |qd| <= 1}`` (velocity) or ``{f : |J^T f| <= 1}`` (force), with the three rows of J for the selected part.
    The two ellipsoids share their axes and have reciprocal lengths, so the force is low in directions of high speed.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    part : "position" for the velocity of the tool point or the force on it, "rotation" for angular velocity or moment.
    kind : "velocity" or "force".

    Raises
    ------
    UnknownName : if `part` or `kind` is unknown.
    ShapeError, RobotError : the causes listed for `singular_values`.
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
    J[~np.isfinite(q).all(axis=-1)] = np.nan  # also in rows that do not depend on the missing joint
    return J[..., _ROWS[part], :]


def _svd(J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return U, s and V^T with square U and V; samples with NaN, which LAPACK rejects, give NaN."""
    known = np.asarray(np.isfinite(J).all(axis=(-2, -1)))
    U, s, Vt = np.linalg.svd(np.where(known[..., None, None], J, 0.0))
    U[~known], s[~known], Vt[~known] = np.nan, np.nan, np.nan
    return U, s, Vt


@dataclass(frozen=True, eq=False, repr=False)
class SelfMotion(Shown):
    """Sampled self-motion; arrays are read-only.

    Attributes
    ----------
    q : (N, n) joint positions; the first is the start.
    s : (N,) arc length [rad; m for prismatic joints].
    position_error : (N,) displacement of the tool point from the start [m]; at most 1e-9.
    rotation_error : (N,) rotation of the tool from the start [rad]; at most 1e-9. For the task "axis", rotation of the
        z axis only; for "position", 0.
    end : reason why the motion ended: "length" (full length reached), "limit of joint k", "optimum" or "singular".
    """

    q: np.ndarray
    s: np.ndarray
    position_error: np.ndarray
    rotation_error: np.ndarray
    end: str

    def __post_init__(self) -> None:
        make_read_only(self, "q", "s", "position_error", "rotation_error")


def self_motion(
    robot: Robot,
    q: ArrayLike,
    *,
    direction: Literal[1, -1] | ArrayLike | Callable[[np.ndarray], ArrayLike] = 1,
    length: float = 1.0,
    points: int = 51,
    task: Task = "pose",
) -> SelfMotion:
    """Follow the self-motion from a posture: ``J(q) dq/ds = 0``, ``|dq/ds| = 1``.

    Each point is found by RK4 steps along the null space, followed by Newton corrections ``dq = J^+ e`` back to the
    pose. Every point preserves the pose to 1e-9 (typically 1e-12) and is within the joint limits. If the motion reaches
    a limit, it ends with a point on that limit.

    Parameters
    ----------
    robot : an arm with more joints than the task needs.
    q : (n,) start posture, inside the limits [rad or m].
    direction : 1 or -1 for a one-dimensional self-motion: 1 moves the fastest joint in its positive direction.
        Alternatively, (n,) joint velocities, which are projected onto the null space. Alternatively, a function of the
        joint positions that returns the gradient (n,) of an objective, for example the manipulability; the motion then
        climbs to the optimum.
    length : maximum arc length in joint space [rad; m for prismatic joints]; up to 1000.
    points : number of evenly spaced points over the whole length, including both ends, 2 to 1 000 000.
    task : constraint: "pose", "position" of the tool point, or "axis": position and direction of the tool's z axis.

    Raises
    ------
    RobotError : if the robot has no redundant joint for the task, or is not a `Robot`.
    SingularPoseError : if `q` is singular, if `direction` is a sign but the self-motion has several dimensions, or if
        `direction` has no null-space component.
    ShapeError : if `q` is not (n,), finite and inside the limits, or if an argument is invalid.
    UnknownName : if `task` is unknown.
    """
    curve = _Curve(robot, _checked(robot, q, length, points, task), task)
    here, tangent = curve.begin(direction)
    rows, walked, end = [here], [0.0], "length"
    for goal in np.linspace(0.0, length, points)[1:]:
        s = walked[-1]
        while end == "length" and s < goal:
            before = s
            here, tangent, moved, end = curve.step(here, tangent, min(goal - s, _STEP))
            s = goal if moved == goal - before else s + moved
        if s > walked[-1]:
            rows.append(here)
            walked.append(s)
    rows = np.clip(rows, robot.q_min, robot.q_max)
    errors = np.array([curve.error(row)[0] for row in rows])
    position_error, rotation_error = (np.linalg.norm(half, axis=1) for half in (errors[:, :3], errors[:, 3:]))
    return SelfMotion(rows, np.array(walked), position_error, rotation_error, end)


class _Curve:
    def __init__(self, robot: Robot, start: np.ndarray, task: Task) -> None:
        self.robot, self.start, self.size = robot, start, _TASK_ROWS[task]
        self.T_base_goal = forward(robot, start)
        self.climbs: Callable[[np.ndarray], ArrayLike] | None = None
        anywhere = np.random.default_rng(0).uniform(-np.pi, np.pi, (16, robot.n))
        s = np.linalg.svd(jacobian(robot, anywhere)[:, : self.size], compute_uv=False)
        self.rank = int((s > _SINGULAR * s[:, :1]).sum(axis=1).max())
        if self.rank == robot.n:
            raise RobotError(
                f"Expected a robot with a redundant joint for the task {task!r}, got {robot.name!r}, which needs all "
                f"its {robot.n} joints for this task. Use an arm with more joints or a less restrictive task "
                '("axis", "position").'
            )

    def begin(self, direction: int | ArrayLike | Callable[[np.ndarray], ArrayLike]) -> tuple[np.ndarray, np.ndarray]:
        q, dimension = self.start, self.robot.n - self.rank
        s, Vt = np.linalg.svd(self.error(q)[1])[1:]
        if self.rank and s[self.rank - 1] <= _SINGULAR * s[0]:
            raise SingularPoseError(
                f"Expected a regular start posture, got the singular posture {q.tolist()}, where the self-motion "
                "has no unique tangent. Start close to this posture."
            )
        if callable(direction):
            self.climbs = direction
            wanted = self.gradient(q)
        elif isinstance(direction, (int, np.integer)) and direction in (1, -1):
            if dimension > 1:
                raise SingularPoseError(
                    f"Expected a direction within the {dimension} dimensions of this self-motion, got only the sign "
                    f"{direction}. Pass joint velocities (n,), or a function that returns the gradient of an objective."
                )
            wanted = direction * np.sign(Vt[-1, np.argmax(np.abs(Vt[-1]))]) * Vt[-1]
        else:
            wanted = _vector(self.robot, direction, "direction (other than 1, -1 or a function)")
        along = self.projected(q, wanted)
        if np.linalg.norm(along) <= 1e-9 * np.linalg.norm(wanted):
            raise SingularPoseError(
                "Expected a direction with a component along the self-motion, got a direction that would only move "
                "the tool, or an objective at its optimum. Pass a different direction."
            )
        return q, along / np.linalg.norm(along)

    def step(self, q: np.ndarray, tangent: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray, float, str]:
        """Return the next point of the self-motion, its tangent, the distance moved, and "length" or the reason for the
        end."""
        if self.climbs:
            uphill = self.projected(q, self.gradient(q))
            tangent = uphill / max(float(np.linalg.norm(uphill)), 1e-300)
        while (there := self.ahead(q, tangent, h)) is None:
            h /= 2
            if h < _SHORTEST:
                return q, tangent, 0.0, "singular"
        beyond = self.beyond(*there)
        if not beyond:
            return *there, h, "length"
        low, high, best = 0.0, h, (q, tangent)
        while high - low > 1e-12:  # bisect to the last valid point
            middle = (low + high) / 2
            there = self.ahead(q, tangent, middle)
            if there is None or self.beyond(*there):
                high, beyond = middle, self.beyond(*there) if there else beyond
            else:
                low, best = middle, there
        end = "length" if beyond == "optimum" and low > _SHORTEST else beyond
        return *best, low, end

    def ahead(self, q: np.ndarray, tangent: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the point at arc length h and its tangent, or None if the step is too large for the curvature."""
        k1 = tangent
        k2 = self.tangent(q + h / 2 * k1, tangent)
        k3 = self.tangent(q + h / 2 * k2, tangent)
        k4 = self.tangent(q + h * k3, tangent)
        predicted = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        there = predicted.copy()
        for _ in range(6):
            e, J = self.error(there)
            if np.linalg.norm(e) <= _EXACT:
                break
            U, s, Vt = np.linalg.svd(J)
            r = self.rank
            there = there + Vt[:r].T @ (U[:, :r].T @ e[: self.size] / s[:r])
        else:
            return None
        if np.linalg.norm(there - predicted) > _DRIFT * h:
            return None
        return there, self.tangent(there, k4)

    def beyond(self, q: np.ndarray, tangent: np.ndarray) -> str:
        """Return the reason why this point is invalid, "limit of joint k" or "optimum", or an empty string."""
        over = np.maximum(self.robot.q_min - q, q - self.robot.q_max)
        if over.max() > _EXACT:
            return f"limit of joint {int(np.argmax(over)) + 1}"
        return "optimum" if self.climbs and self.gradient(q) @ tangent < 0 else ""

    def tangent(self, q: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return the null-space unit vector closest to `near`."""
        along = self.projected(q, near)
        return along / max(float(np.linalg.norm(along)), 1e-300)

    def projected(self, q: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Return the null-space component of `vector`."""
        basis = np.linalg.svd(self.error(q)[1])[2][self.rank :]
        return basis.T @ (basis @ vector)

    def gradient(self, q: np.ndarray) -> np.ndarray:
        return _vector(self.robot, self.climbs(q) if self.climbs else None, "the gradient that direction(q) returns")

    def error(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose error as a twist (6,) in tool axes, with 0 in directions free in the task, and J (m, n)."""
        T_base_tool = forward(self.robot, q)
        R_transposed = T_base_tool[:3, :3].T
        turn = R_transposed @ self.T_base_goal[:3, :3]
        e = np.zeros(6)
        e[:3] = R_transposed @ (self.T_base_goal[:3, 3] - T_base_tool[:3, 3])
        if self.size == _TASK_ROWS["pose"]:
            e[3:] = so3.log(turn)
        elif self.size == _TASK_ROWS["axis"]:
            e[3:5] = -turn[1, 2], turn[0, 2]  # z x z_goal, small
        return e, jacobian(self.robot, q, frame="tool")[: self.size]


def _vector(robot: Robot, value: Any, name: str) -> np.ndarray:
    vector = numbers(value, name, ShapeError)
    if vector.shape != (robot.n,) or not np.isfinite(vector).all():
        raise ShapeError(
            f"Expected {name} to be ({robot.n},) finite numbers, got shape {vector.shape}: {vector.tolist()}."
        )
    return vector


def _checked(robot: Robot, q: ArrayLike, length: float, points: int, task: str) -> np.ndarray:
    if not isinstance(task, str) or task not in _TASK_ROWS:
        raise UnknownName.among("task", task, _TASK_ROWS)
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    start = _vector(robot, q, "q").copy()
    outside = (start < robot.q_min) | (start > robot.q_max)
    if outside.any():
        k = int(np.argmax(outside))
        raise ShapeError(
            f"Expected q inside the limits of {robot.name!r}, got {start[k]:.6g} for joint {k + 1} "
            f"({robot.joint_names[k]}), with limits {robot.q_min[k]:.6g} to {robot.q_max[k]:.6g}. Start inside the "
            "limits."
        )
    lengths, counts = (int, float, np.integer, np.floating), (int, np.integer)
    if not (
        isinstance(length, lengths) and 0 < length <= _FARTHEST and isinstance(points, counts) and 2 <= points <= _MOST
    ):
        raise ShapeError(
            f"Expected a length above 0 and up to {_FARTHEST:g}, and from 2 to {_MOST} points, got {length!r} "
            f"and {points!r}."
        )
    return start
