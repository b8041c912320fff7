"""The map between ABB's axes and units on the wire and kinematic joints in SI: one permutation, one scale vector."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import numpy as np

from armlab.errors import RobotError
from armlab.wire.egm.types import Arm, Drop

__all__ = ["RADIAN", "AxisMap", "Refused"]

RADIAN = pi / 180.0
_MILLIMETRE = 1e-3
_HEAD = 6  # EgmJoints holds at most six values; further axes of the robot travel as external joints


class Refused(Exception):
    """Inside the codec: a message cannot be used. The codec turns it into the `Drop` it carries."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.drop = Drop(reason, detail)


class AxisMap:
    """Permutation and units of one robot: with w = joints ++ externalJoints, q[i] = scale[i] * w[abb_axes[i] - 1].

    A rotary joint is in degrees on the wire. A linear joint among the first six arrives as metres times 180/pi
    (abb_libegm pull request 142), so its factor is the rotary one; beyond the sixth it is in millimetres.

    Parameters
    ----------
    arm : number of joints, which are prismatic, and ABB's axis number of each in kinematic order.

    Raises
    ------
    RobotError : when `abb_axes` is not a permutation of 1..n.
    """

    def __init__(self, arm: Arm) -> None:
        axes = tuple(int(axis) for axis in arm.abb_axes)
        if sorted(axes) != list(range(1, arm.n + 1)):
            raise RobotError(f"Expected abb_axes to hold each of 1 to {arm.n} once, got {axes}.")
        self.n = arm.n
        self.head = min(arm.n, _HEAD)
        self.tail = arm.n - self.head
        self.order = tuple(axis - 1 for axis in axes)
        self.inverse = tuple(self.order.index(k) for k in range(arm.n))
        linear_tail = np.asarray(arm.prismatic, dtype=bool) & (np.array(self.order) >= self.head)
        self.scale = np.where(linear_tail, _MILLIMETRE, RADIAN)
        self.linear_head = tuple(i for i in range(arm.n) if arm.prismatic[i] and self.order[i] < self.head)

    def joints(self, joints: Sequence[float], external: Sequence[float], scale: np.ndarray) -> np.ndarray:
        """Return (n,) kinematic joints from the two wire arrays.

        Parameters
        ----------
        joints, external : EgmJoints of one message; further external axes may follow the robot's own.
        scale : (n,) factors to SI.

        Raises
        ------
        Refused : no joints, or their number is not that of this robot.
        """
        if not joints:
            raise Refused("no joints", "the array of joints is absent or empty")
        if len(joints) != self.head or len(external) < self.tail:
            raise Refused(
                "joint count",
                f"expected {self.head} joints and at least {self.tail} external, got {len(joints)} and {len(external)}",
            )
        wire = [*joints, *external]
        return np.array([wire[k] for k in self.order]) * scale

    def array(self, values: Sequence[float], kinematic: bool) -> np.ndarray | None:
        """Return (n,) values of one extension array in kinematic order, None when it is absent.

        Parameters
        ----------
        values : as received. kinematic : True when the sender uses kinematic order, False for ABB's.

        Raises
        ------
        Refused : the number of values is not that of the joints.
        """
        if not values:
            return None
        if len(values) != self.n:
            raise Refused("joint count", f"expected {self.n} values in each array of the extension, got {len(values)}")
        return np.array(values if kinematic else [values[k] for k in self.order])

    def wire(self, q: np.ndarray, scale: np.ndarray) -> list[float]:
        """Return the n wire values in ABB's order, in wire units: the first `head` are joints, the rest external."""
        values = (q / scale).tolist()
        return [values[k] for k in self.inverse]
