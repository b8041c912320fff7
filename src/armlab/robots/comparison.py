"""Differences between two robot descriptions as text, and the error for a file of a different robot."""

from __future__ import annotations

import numpy as np

from armlab.errors import ModelMismatchError, RobotError
from armlab.lie import so3
from armlab.robots.robot import Robot

_EQUAL = 1e-9  # m, rad: smaller differences are rounding, which `Robot.hash` also ignores
_NAMED = 6  # largest number of differences listed in an error
_LIMITS = {  # field -> description, unit for revolute joints, unit for prismatic joints
    "q_min": ("lower position limit", "rad", "m"),
    "q_max": ("upper position limit", "rad", "m"),
    "qd_max": ("speed limit", "rad/s", "m/s"),
    "qdd_max": ("acceleration limit", "rad/s^2", "m/s^2"),
    "tau_max": ("torque limit", "N m", "N"),
    "q_home": ("home", "rad", "m"),
}
_PLAIN = {"gravity": "gravity [m/s^2]", "coupling": "gears", "abb_axes": "ABB's axis numbers", "inertias": "inertias"}


def differences(robot: Robot, other: Robot) -> tuple[str, ...]:
    """Return the differences between two robots, one phrase each: geometry first, names last.

    Parameters
    ----------
    robot : robot whose values come first in each phrase.
    other : robot whose values follow "not".

    Raises
    ------
    RobotError : if an argument is not a `Robot`.
    """
    for one in (robot, other):
        if not isinstance(one, Robot):
            raise RobotError.no_robot(one)
    if robot.n != other.n:
        return (f"{robot.n} joints, not {other.n}",)
    found = [_pose("tool", robot.T_flange_tool, other.T_flange_tool)]
    found += [_pose("mount", robot.T_base_mount, other.T_base_mount)]
    found += [_link(i, robot, other) for i in range(robot.n + 1)]
    kinds = np.flatnonzero(robot.prismatic != other.prismatic)
    found += [f"joint {i + 1}: {_kind(robot, int(i))}, not {_kind(other, int(i))}" for i in kinds]
    found += [_by_joint(name, robot, other) for name in _LIMITS]
    for name, words in _PLAIN.items():
        a, b = getattr(robot, name), getattr(other, name)
        if (a is None) != (b is None):
            found.append(f"{words}: " + ("missing, not present" if a is None else "present, not missing"))
        elif a is not None and not np.allclose(a, b, rtol=0.0, atol=_EQUAL):
            short = np.size(a) <= robot.n and name != "inertias"
            found.append(f"{words}: {_numbers(a)}, not {_numbers(b)}" if short else f"other {words}")
    names = [i for i in range(robot.n) if robot.joint_names[i] != other.joint_names[i]]
    found += [f"joint {i + 1}: named {robot.joint_names[i]!r}, not {other.joint_names[i]!r}" for i in names]
    if robot.name != other.name:
        found.append(f"named {robot.name!r}, not {other.name!r}")
    return tuple(words for words in found if words)


def check_same(robot: Robot, what: str, name: str, digest: str, other: Robot | None, advice: str) -> None:
    """Raise `ModelMismatchError` unless the file described by `what` belongs to `robot`.

    `name`, `digest` and `other` are the name, hash and (if stored) description of the robot in the file. `advice` is
    appended to the error message.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    if robot.hash == digest:
        return
    told = () if other is None else differences(robot, other)
    more = f"; and {len(told) - _NAMED} more" if len(told) > _NAMED else ""
    words = f", which differs: {'; '.join(told[:_NAMED])}{more}" if told else ""
    raise ModelMismatchError(
        f"Expected the robot of {what}, {name!r} ({digest[:12]}), got {robot.name!r} ({robot.hash[:12]}){words}. "
        f"{advice}"
    )


def _pose(what: str, A: np.ndarray, B: np.ndarray) -> str:
    """Describe the offset between two poses; empty if they are equal."""
    moved = float(np.linalg.norm(A[:3, 3] - B[:3, 3]))
    turned = float(np.linalg.norm(so3.log(so3.project(A[:3, :3].T @ B[:3, :3])[0])))
    parts = [f"moved by {moved:.4g} m"] if moved > _EQUAL else []
    parts += [f"rotated by {np.degrees(turned):.4g} deg"] if turned > 1e-7 else []
    return f"{what} {' and '.join(parts)}" if parts else ""


def _link(i: int, robot: Robot, other: Robot) -> str:
    """Describe the difference between two links: the lengths if they differ, otherwise the poses."""
    ends = ("mount", *(f"joint {k + 1}" for k in range(robot.n)), "flange")
    a, b = robot.links[i], other.links[i]
    lengths = [float(np.linalg.norm(T[:3, 3])) for T in (a, b)]
    what = f"link from {ends[i]} to {ends[i + 1]}"
    if abs(lengths[0] - lengths[1]) > _EQUAL:
        return f"{what} {lengths[0]:.4g} m long, not {lengths[1]:.4g} m"
    return _pose(what, a, b)


def _kind(robot: Robot, i: int) -> str:
    return "prismatic" if robot.prismatic[i] else "revolute"


def _by_joint(name: str, robot: Robot, other: Robot) -> str:
    """Describe a difference in a limit: the values of the first joint, and the number of other joints that differ."""
    words, turning, sliding = _LIMITS[name]
    a, b = getattr(robot, name), getattr(other, name)
    differ = np.flatnonzero(~np.isclose(a, b, rtol=0.0, atol=_EQUAL))
    if not len(differ):
        return ""
    i = int(differ[0])
    unit = sliding if robot.prismatic[i] else turning
    rest = f" (and {len(differ) - 1} other joints differ)" if len(differ) > 1 else ""
    return f"{words} of joint {i + 1} {a[i]:.5g} {unit}, not {b[i]:.5g} {unit}{rest}"


def _numbers(values: np.ndarray | tuple[int, ...]) -> str:
    return " ".join(f"{value:.4g}" for value in np.ravel(values))
