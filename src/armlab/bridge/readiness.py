"""Whether a robot would follow a reference, and whether its feedback can be true."""

from __future__ import annotations

import numpy as np

from armlab.bridge.linked import axes_of
from armlab.robots import Robot

__all__ = ["MCI_RUNNING", "implausible", "obstacle"]

MCI_RUNNING = 3
"""State of EGM while it guides."""

_MOTORS_ON = 1
_RAPID_MOVES = (0, 2)  # undefined (0) stays after a restart of the controller although RAPID runs
_PLAUSIBLE = 0.1  # rad or m beyond the limits of a joint


def obstacle(motors: int, rapid: int, mci: int) -> str:
    """Return why the robot would not follow a reference, "" when it would.

    Parameters
    ----------
    motors, rapid, mci : states of the newest packet.
    """
    if motors != _MOTORS_ON:
        return "the motors are off"
    if rapid not in _RAPID_MOVES:
        return "RAPID is stopped"
    return "" if mci == MCI_RUNNING else "guidance has not begun (EGMRunJoint)"


def implausible(q: np.ndarray, robot: Robot) -> str:
    """Return the sentence for feedback far outside the limits, "" when it can be true.

    Limits are those of ABB's axes, where these are not the joints.

    Parameters
    ----------
    q : (n,) feedback. robot : the arm.
    """
    q = axes_of(robot)(q)
    outside = np.maximum(robot.q_min - q, q - robot.q_max)
    i = int(np.argmax(outside))
    if outside[i] <= _PLAUSIBLE:
        return ""
    return (
        f"Expected joint {i + 1} ({robot.joint_names[i]}) of {robot.name} between {robot.q_min[i]:.3f} and "
        f"{robot.q_max[i]:.3f}, but the robot reports {q[i]:.3f}. Usual causes are another robot, another joint order "
        "and other units: check the robot's description and its RobotWare."
    )
