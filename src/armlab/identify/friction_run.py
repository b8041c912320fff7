"""Friction run: one joint at constant speeds, both ways, with holds between them and the middle speed again at the end.

At constant speed torque is gravity plus friction, and a slow joint passes every tooth of its gear: the curve of
friction over speed, torque ripple and, from the repetition, warm-up are read from such a log.
"""

from __future__ import annotations

import numpy as np

from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.identify.trajectory import Trajectory
from armlab.robots import Robot

__all__ = ["friction_run"]

SPEEDS = 10
SLOWEST, FASTEST = 0.005, 0.8  # rad/s or m/s, share of the limit
HOLD = 2.0  # s
PERIODS = 10  # of torque ripple at least, at each speed
STROKE, SLIDE = 0.3, 0.05  # rad, m at least, and where the gears are not known
STEEPEST = 1.875  # largest slope of the quintic step
SHORTEST = 0.1  # s, of a change of speed


def friction_run(robot: Robot, joint: int | str, at: np.ndarray | None = None) -> Trajectory:
    """Design a motion of one joint at ten constant speeds, both ways; the others stay.

    Speeds are spaced evenly in logarithm from 0.005 rad/s to 80 % of the limit. At each the joint runs at constant
    speed over ten ripple periods, ``2 pi / (2 gear)``, and at least 0.3 rad (50 mm); it stands for 2 s between runs.
    The fifth speed comes again at the end: if friction differs there, it has warmed up.

    Parameters
    ----------
    robot : limits and gears.
    joint : its name, or its number from 0.
    at : (n,) pose of the other joints, inside the limits; the robot's home when left out. The joint itself sways about
        the middle of its range.

    Returns
    -------
    Trajectory that starts and ends at rest; sample it, run it with its controller, or save its table.

    Raises
    ------
    UnknownName : no such joint. ShapeError : a pose outside the limits, a joint without speed limit, or a range too
        short for the run.

    References
    ----------
    Bagge Carlson, Robertsson and Johansson, IROS 2015, for friction over position and speed.
    """
    i = _number(robot, joint)
    pose = np.array(robot.q_home if at is None else at, dtype=float)
    if pose.shape != (robot.n,) or not np.all((pose >= robot.q_min) & (pose <= robot.q_max)):
        raise ShapeError(
            f"Expected a pose of shape ({robot.n},) inside the limits of {robot.name!r}, got {pose.tolist()}. "
            "Give one position per joint [rad]."
        )
    speeds, stroke = _speeds(robot, i)
    bounds = np.array([robot.q_min[i], robot.q_max[i]])
    middle = bounds.mean() if np.all(np.isfinite(bounds)) else pose[i]
    times, rows = _phases([*speeds, speeds[SPEEDS // 2 - 1]], stroke, float(robot.qdd_max[i]))
    v0, v1, q0 = rows

    def sample(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.clip(np.asarray(t, dtype=float), 0.0, times[-1])
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(q0) - 1)
        T = times[k + 1] - times[k]
        x = (t - times[k]) / T
        q, qd, qdd = (np.zeros((*t.shape, robot.n)) for _ in range(3))
        change = v1[k] - v0[k]
        q += pose
        q[..., i] = middle + q0[k] + T * (v0[k] * x + change * x**4 * (2.5 - 3 * x + x * x))
        qd[..., i] = v0[k] + change * x**3 * (10 - 15 * x + 6 * x * x)
        qdd[..., i] = change / T * 30 * x * x * (1 - x) ** 2
        return q, qd, qdd

    return Trajectory(float(times[-1]), sample)


def _number(robot: Robot, joint: int | str) -> int:
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    names = robot.joint_names
    if isinstance(joint, str):
        if joint not in names:
            raise UnknownName.among("joint", joint, names)
        return names.index(joint)
    if not isinstance(joint, int | np.integer) or isinstance(joint, bool) or not 0 <= joint < robot.n:
        raise UnknownName(f"Expected the number of a joint from 0 to {robot.n - 1}, got {joint!r}. Count from 0.")
    return int(joint)


def _speeds(robot: Robot, i: int) -> tuple[np.ndarray, float]:
    """Return the speeds (10,) and the way at constant speed."""
    name, top = robot.joint_names[i], FASTEST * robot.qd_max[i]
    if not SLOWEST < top < np.inf or not 0 < robot.qdd_max[i] < np.inf:
        raise ShapeError(
            f"Expected limits of speed and acceleration of {name}, got {robot.qd_max[i]:g} and {robot.qdd_max[i]:g}. "
            "Put them into the robot file."
        )
    gear = abs(1.0 / robot.coupling[i, i])
    least = SLIDE if robot.prismatic[i] else STROKE
    stroke = max(least, PERIODS * np.pi / gear) if gear > 1 else least
    room = 0.9 * float(robot.q_max[i] - robot.q_min[i])
    ways = top * max(SHORTEST, STEEPEST * top / robot.qdd_max[i])  # to reach the speed and to lose it
    if stroke + ways > room:
        top = min(top, _largest(room - stroke, float(robot.qdd_max[i])))
    if top <= 2 * SLOWEST:
        raise ShapeError(
            f"Expected room for a run of {stroke:.3g} rad (m) at constant speed, got {name} with "
            f"{room:.3g} rad (m) inside its limits. Use identify.excitation for such a joint."
        )
    return np.geomspace(SLOWEST, top, SPEEDS), stroke


def _largest(ways: float, acceleration: float) -> float:
    """Return the speed that is reached and lost within `ways`; 0 where there is no room."""
    return max(0.0, min(ways / SHORTEST, np.sqrt(max(ways, 0.0) * acceleration / STEEPEST)))


def _phases(speeds: list[float], stroke: float, acceleration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the borders in time (k + 1,) and rows (3, k): speeds at start and end, position at start, about 0."""
    parts: list[tuple[float, float, float]] = []
    for v in speeds:
        ramp = max(SHORTEST, STEEPEST * v / acceleration)
        for sign in (1.0, -1.0):
            w = sign * v
            parts += [(HOLD, 0.0, 0.0), (ramp, 0.0, w), (stroke / v, w, w), (ramp, w, 0.0)]
    parts.append((HOLD, 0.0, 0.0))
    length, v0, v1 = np.array(parts).T
    times = np.concatenate([[0.0], np.cumsum(length)])
    moved = np.concatenate([[0.0], np.cumsum(0.5 * (v0 + v1) * length)])
    return times, np.stack([v0, v1, moved[:-1] - 0.5 * moved.max()])
