"""Joint trajectories (points at given times) and their controller, with tolerances as in ros2_control."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import make_read_only, numbers, positive
from armlab.errors import ShapeError, UnknownName
from armlab.motion import arguments
from armlab.motion.control import JointLimits
from armlab.motion.profiles import pieces
from armlab.robots import Robot
from armlab.state import Command, State

Ending = Literal["", "arrived", "refused", "path", "goal", "interrupted"]

MAX_GAP = 0.1  # longest time between two packets [s]
GOAL_TIME = 2.0
"""Default time allowed after the last point to reach the goal [s]."""

_SENT = 1e-6  # largest distance between the last reference and the goal [rad or m]
_REST = 1e-3  # largest speed at the last point [rad/s or m/s]
_PARTS = 16  # subdivisions of a segment at which limits are checked
_SPARE = 1.0 + 1e-3  # accepted speed relative to the speed limit


@dataclass(frozen=True, eq=False, repr=False)
class Tolerance(Shown):
    """Largest accepted differences between reference and measurement.

    Attributes
    ----------
    position : position tolerance, a number or (n,) [rad or m]; infinity disables the check.
    velocity : velocity tolerance, a number or (n,) [rad/s or m/s]; infinity disables the check.
    """

    position: ArrayLike = np.inf
    velocity: ArrayLike = np.inf

    def spread(self, n: int) -> np.ndarray:
        """Return the position and velocity tolerances (2, n)."""
        both = ((self.position, "position tolerance"), (self.velocity, "velocity tolerance"))
        return np.stack([arguments.joint_limit(value, what, n) for value, what in both])


GOAL_TOLERANCE = Tolerance(0.01, 0.02)
"""Default goal tolerance."""


@dataclass(frozen=True, eq=False, repr=False)
class JointTrajectory(Shown):
    """Points of a joint motion at given times, as in a ``trajectory_msgs/JointTrajectory``.

    Between points, the motion is a polynomial: linear for positions only, cubic with velocities, quintic with
    velocities and accelerations. If the first point is after time 0, the motion begins at the current position.

    Attributes
    ----------
    t : (N,) increasing times since the start, from 0 [s].
    q : (N, n) positions [rad or m].
    qd : (N, n) velocities [rad/s or m/s], zero at the last point; default: linear interpolation.
    qdd : (N, n) accelerations [rad/s^2 or m/s^2]; default: linear or cubic interpolation.
    joints : names of the columns, in any order; default: the joint order of the robot.

    Raises
    ------
    ShapeError : no points, wrong shapes, missing values, non-increasing times, accelerations without velocities,
        non-zero velocity at the last point, or repeated joint names.
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray | None = None
    qdd: np.ndarray | None = None
    joints: Sequence[str] = ()

    if TYPE_CHECKING:  # accepted types; the fields are arrays

        def __init__(
            self,
            t: ArrayLike,
            q: ArrayLike,
            qd: ArrayLike | None = None,
            qdd: ArrayLike | None = None,
            joints: Sequence[str] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        t, q = (np.array(numbers(getattr(self, name), name, ShapeError)) for name in ("t", "q"))
        if q.ndim != 2 or not q.size or t.shape != q.shape[:1]:
            raise ShapeError(f"Expected points with times (N,) and positions (N, n), got {t.shape} and {q.shape}.")
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "q", q)
        names = [name for name in ("q", "qd", "qdd") if getattr(self, name) is not None]
        for name in names:
            values = np.array(numbers(getattr(self, name), name, ShapeError))
            if values.shape != q.shape:
                raise ShapeError(f"Expected {name} of shape {q.shape}, like q, got {values.shape}.")
            missing = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(missing):
                raise ShapeError(f"Expected finite {name}, got {values[missing[0]].tolist()} at point {missing[0]}.")
            object.__setattr__(self, name, values)
        self._check_times()
        if self.qd is None and self.qdd is not None:
            raise ShapeError("Expected velocities together with accelerations, got only accelerations. Pass both.")
        if self.qd is not None and np.abs(self.qd[-1]).max() > _REST:
            raise ShapeError(
                f"Expected zero velocities at the last point, got velocities {self.qd[-1].tolist()}. Add a final point."
            )
        joints = tuple(self.joints)
        if joints and (len(joints) != q.shape[1] or len(set(joints)) < len(joints)):
            raise ShapeError(f"Expected {q.shape[1]} different joint names, one per column, got {', '.join(joints)}.")
        object.__setattr__(self, "joints", joints)
        make_read_only(self, "t", *names)

    def _check_times(self) -> None:
        steps = np.diff(self.t)
        if not np.isfinite(self.t).all() or self.t[0] < 0.0 or not (steps > 0.0).all():
            k = int(np.argmin(steps > 0.0)) + 1 if len(steps) and self.t[0] >= 0.0 else 0
            raise ShapeError(
                f"Expected finite, increasing times from 0 s, got {self.t[k]:g} s at point {k}"
                f"{f' after {self.t[k - 1]:g} s' if k else ''}. Sort the points and drop repeated points."
            )

    @property
    def duration(self) -> float:
        """Time of the last point [s]."""
        return float(self.t[-1])

    def ordered(self, joints: Sequence[str]) -> JointTrajectory:
        """Return the same motion with its columns in the order of the robot's joints.

        Parameters
        ----------
        joints : names in the robot's joint order, for example `Robot.ros_joint_names`.

        Raises
        ------
        UnknownName : the joint names of the trajectory differ from `joints`.
        ShapeError : the trajectory has no joint names, and its number of columns differs from the number of joints.
        """
        if not self.joints:
            if self.q.shape[1] != len(joints):
                raise ShapeError(f"Expected {len(joints)} joints ({', '.join(joints)}), got {self.q.shape[1]} columns.")
            return replace(self, joints=tuple(joints))
        for name in self.joints:
            if name not in joints:
                raise UnknownName.among("joint", name, joints)
        missing = [name for name in joints if name not in self.joints]
        if missing:
            raise UnknownName(
                f"Expected all joints of the arm, got no column for {', '.join(missing)}. Add these columns."
            )
        at = [self.joints.index(name) for name in joints]
        q, qd, qdd = (None if one is None else one[:, at] for one in (self.q, self.qd, self.qdd))
        return replace(self, q=q, qd=qd, qdd=qdd, joints=tuple(joints))

    def check(self, limits: JointLimits) -> None:
        """Raise an error if the motion exceeds position or speed limits, including between points.

        Accelerations are not checked, because the robot's limits are applied to every reference.

        Parameters
        ----------
        limits : a Robot or bridge.Limits.

        Raises
        ------
        ShapeError : a position or speed is outside the limits; the message states the joint and the time.
        """
        if len(self.t) == 1:
            places, speeds, times = self.q[None], None, self.t[None]
        else:
            h = np.diff(self.t)[:, None]
            parts = np.linspace(0.0, 1.0, _PARTS + 1)[:, None, None]
            ends = [(values[:-1], values[1:]) for values in (self.q, self.qd, self.qdd) if values is not None]
            places, speeds, _ = _evaluate(pieces(h, *ends), parts * h)
            times = self.t[:-1] + parts[:, :, 0] * h[:, 0]
        self._refuse(~((places >= limits.q_min) & (places <= limits.q_max)), places, times, "positions from {} to {}",
                     limits.q_min, limits.q_max)  # fmt: skip
        if speeds is not None:
            self._refuse(~(np.abs(speeds) <= limits.qd_max * _SPARE), speeds, times, "speeds up to {}", limits.qd_max)

    def _refuse(self, wrong: np.ndarray, values: np.ndarray, times: np.ndarray, what: str, *limits: np.ndarray) -> None:
        if wrong.any():
            part, piece, i = (int(k) for k in np.argwhere(wrong)[0])
            joint = self.joints[i] if self.joints else f"joint {i + 1}"
            raise ShapeError(
                f"Expected {what.format(*(f'{limit[i]:.4g}' for limit in limits))} for {joint}, got "
                f"{values[part, piece, i]:.4g} after {times[part, piece]:.3f} s. Use a slower or shorter motion."
            )

    def controller(
        self,
        robot: Robot,
        *,
        limits: JointLimits | None = None,
        path_tolerance: Tolerance | None = None,
        goal_tolerance: Tolerance | None = None,
        goal_time: float = GOAL_TIME,
        begin: float = 0.0,
    ) -> TrajectoryController:
        """Return a controller ``State -> Command`` that runs the trajectory once, then ends the run.

        Parameters
        ----------
        robot : the arm; columns are sorted by `Robot.ros_joint_names`.
        limits : Robot or bridge.Limits that the motion must satisfy; default: from the robot.
        path_tolerance : tolerance during the motion; default: only the following-error limit of the link applies.
        goal_tolerance : tolerance at the end; default: 0.01 rad or m, and 0.02 rad/s or m/s.
        goal_time : time allowed after the last point to reach the goal tolerance [s].
        begin : trajectory time at which to begin [s]; earlier points are skipped, and a negative time adds a wait.

        Raises
        ------
        UnknownName, ShapeError : the joints differ from the joints of the robot, or the motion is outside the limits.
        """
        trajectory = self.ordered(robot.ros_joint_names)
        trajectory.check(robot if limits is None else limits)
        goal = GOAL_TOLERANCE if goal_tolerance is None else goal_tolerance
        path = Tolerance() if path_tolerance is None else path_tolerance
        return TrajectoryController(trajectory, robot if limits is None else limits, path, goal, goal_time, begin)


class TrajectoryController:
    """Controller that runs a `JointTrajectory` once; created by `JointTrajectory.controller`.

    The first point must be near the arm, or late enough to be reached within the speed limits. The motion ends and the
    arm comes to rest if the arm leaves the path tolerance, the packet stream is interrupted, or the robot begins a new
    session.

    Attributes
    ----------
    ending : "" during the motion, then "arrived", "refused" (at the start), "path" or "goal" (outside that tolerance),
        or "interrupted".
    reason : cause, if the motion ended before the arm arrived.
    t : trajectory time [s].
    """

    ending: Ending
    reason: str
    t: float

    def __init__(
        self,
        trajectory: JointTrajectory,
        limits: JointLimits,
        path: Tolerance,
        goal: Tolerance,
        goal_time: float,
        begin: float,
    ) -> None:
        n = trajectory.q.shape[1]
        self._trajectory, self._qd_max = trajectory, np.asarray(limits.qd_max)
        self._path, self._end = path.spread(n), goal.spread(n)
        self._goal_time = positive(goal_time, "goal time [s]")
        self.t = float(begin)
        self.ending, self.reason = "", ""
        self._k, self._piece, self._from, self._session = -1, np.zeros((6, n)), 0.0, -1

    @property
    def goal(self) -> np.ndarray:
        """Last position (n,)."""
        return self._trajectory.q[-1]

    @property
    def done(self) -> bool:
        """Whether the arm has arrived."""
        return self.ending == "arrived"

    def begin(self, state: State, near: ArrayLike = 0.05, is_moving: bool = False) -> str:
        """Start from a State; return the reason for a refusal, or "" if the trajectory is accepted.

        Parameters
        ----------
        state : state of the arm.
        near : largest allowed distance between the arm and a first point at time 0, a number or (n,) [rad or m].
        is_moving : whether the arm already follows references; the motion then continues from the last reference
            instead of starting at rest.
        """
        trajectory, self._session = self._trajectory, state.session
        if state.q.shape != self.goal.shape:
            return self._fail("refused", f"Expected an arm with {len(self.goal)} joints, got {len(state.q)}.")
        rest = np.zeros_like(state.q)
        q = state.q_sent if _is_known(state) else state.q
        qd = state.qd_sent if is_moving and state.qd_sent.shape == q.shape else rest
        self._k = int(np.searchsorted(trajectory.t, self.t - 1e-9))
        if self._k == len(trajectory.t):
            what = f"a trajectory of {trajectory.duration:.3f} s that is {self.t:.3f} s late"
            return self._fail("refused", f"Expected a trajectory that ends in the future, got {what}.")
        self._from = max(self.t, 0.0)
        h, off = trajectory.t[self._k] - self._from, np.abs(trajectory.q[self._k] - q)
        names = trajectory.joints
        if h < 1e-9:
            if not np.all(off <= near):
                i = int(np.argmax(off - near))
                return self._fail(
                    "refused",
                    f"Expected the first point to be near the arm, within {np.broadcast_to(near, off.shape)[i]:g}, got "
                    f"{names[i]} {off[i]:.4g} away. Begin at the position of the arm, or give the first point a later "
                    "time.",
                )
            self._enter(self._k)
            return ""
        here, points = (q, qd, rest), (trajectory.q, trajectory.qd, trajectory.qdd)
        self._piece = pieces(h, *[(a, b[self._k]) for a, b in zip(here, points) if b is not None])
        speed = np.abs(_evaluate(self._piece, np.linspace(0.0, h, 33)[:, None])[1]).max(axis=0)
        if not np.all(speed <= np.maximum(self._qd_max * _SPARE, np.abs(qd))):
            i = int(np.argmax(speed / self._qd_max))
            return self._fail(
                "refused",
                f"Expected speeds up to {self._qd_max[i]:.4g} for {names[i]}, got {speed[i]:.4g} to reach the first "
                f"point, which is {off[i]:.4g} away, in {h:.3f} s. Begin at the position of the arm, or give the "
                "first point a later time.",
            )
        return ""

    def __call__(self, state: State, dt: float | None = None) -> Command:
        """Return the command for one packet; the command stops the run when the motion has ended.

        `dt` is the time since the last packet [s]; default: the value in the State.
        """
        if self._session < 0:
            self.begin(state)
        elif not self.ending:
            self._advance(state, state.dt if dt is None else dt)
        if self.ending:
            return Command.stop()
        q, qd = self._reference(state)
        self._compare(state, q, qd)
        return Command.stop() if self.ending else Command(q, qd)

    def _advance(self, state: State, dt: float) -> None:
        if state.session != self._session:
            self._fail("interrupted", "The robot began a new session.")
        elif not 0.0 <= dt <= MAX_GAP:
            self._fail("interrupted", f"Expected packets at most {1e3 * MAX_GAP:.0f} ms apart, got {1e3 * dt:.1f} ms.")
        self.t += dt
        t = self._trajectory.t
        if self._k < len(t) and self.t >= t[self._k]:
            self._enter(int(np.searchsorted(t, self.t, side="right")) - 1)

    def _enter(self, k: int) -> None:
        """Enter the segment after point k; hold at the last point."""
        trajectory = self._trajectory
        self._from, self._k = float(trajectory.t[k]), k + 1
        if self._k == len(trajectory.t):
            self._piece = np.zeros_like(self._piece)
            self._piece[0] = trajectory.q[k]
            return
        points = (trajectory.q, trajectory.qd, trajectory.qdd)
        ends = [(values[k], values[k + 1]) for values in points if values is not None]
        self._piece = pieces(trajectory.t[k + 1] - trajectory.t[k], *ends)

    def _reference(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Return the position and velocity at the current time."""
        if self.t < 0.0:
            return self._piece[0], np.zeros_like(state.q)
        q, qd, _ = _evaluate(self._piece, self.t - self._from)
        return q, qd

    def _compare(self, state: State, q: np.ndarray, qd: np.ndarray) -> None:
        """End the motion if the arm is outside the path tolerance or has arrived at the goal."""
        is_over = self._k == len(self._trajectory.t) and self.t >= self._trajectory.t[-1]
        if not is_over:
            if (what := _outside(q - state.q, qd - state.qd, self._path, self._trajectory.joints)) != "":
                self._fail(
                    "path", f"Expected the arm to stay within the path tolerance, got {what} after {self.t:.3f} s."
                )
            return
        sent = np.abs(state.q_sent - q).max() if _is_known(state) else 0.0
        what = _outside(q - state.q, -state.qd, self._end, self._trajectory.joints)
        if what == "" and sent <= _SENT and not np.isnan(state.q).any():
            self.ending = "arrived"
        elif self.t > self._trajectory.t[-1] + self._goal_time:
            what = what or f"a reference {sent:.3g} away from the goal"
            self._fail(
                "goal", f"Expected the arm to be at the goal {self._goal_time:g} s after the last point, got {what}."
            )

    def _fail(self, ending: Ending, reason: str) -> str:
        self.ending, self.reason = ending, reason
        return reason


def _is_known(state: State) -> bool:
    """Return whether the State contains the last reference sent."""
    return len(state.q_sent) > 0 and not np.isnan(state.q_sent).any()


def _evaluate(c: np.ndarray, s: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the position, velocity and acceleration (..., n) of the polynomials with coefficients (6, ..., n) at a
    time s [s] after the start."""
    q = c[0] + s * (c[1] + s * (c[2] + s * (c[3] + s * (c[4] + s * c[5]))))
    qd = c[1] + s * (2 * c[2] + s * (3 * c[3] + s * (4 * c[4] + s * 5 * c[5])))
    return q, qd, 2 * c[2] + s * (6 * c[3] + s * (12 * c[4] + s * 20 * c[5]))


def _outside(q: np.ndarray, qd: np.ndarray, tolerance: np.ndarray, joints: Sequence[str]) -> str:
    """Return a description of the first position or velocity difference beyond its tolerance, or "" if there is none;
    NaN is ignored."""
    for values, most, what in ((q, tolerance[0], "position"), (qd, tolerance[1], "velocity")):
        over = np.abs(values) > most
        if over.any():
            i = int(np.argmax(over))
            return f"a {what} error of {abs(values[i]):.3g} at {joints[i]} (tolerance {most[i]:.3g})"
    return ""
