"""Mapping between ABB's axes and kinematic joints: order, units and motor coupling.

On an IRB 2400, a parallel rod rotates the upper arm, and ABB measures axis 3 relative to the base: axis 3 = q_2 + q_3.
EGM transmits axes, whereas armlab uses joints: ``q = C q_axis``, ``qd = C qd_axis``, ``tau = C^-T tau_axis``. C is the
coupling in the robot's description without gear ratios, because EGM values are on the joint side of the gears.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import Any, TypeVar

import numpy as np

from armlab.errors import ConfigError, RobotError
from armlab.wire.egm.types import Drop, RobotAxes

RADIAN = pi / 180.0
_MILLIMETRE = 1e-3
_UNITS = {"deg": RADIAN, "mm": _MILLIMETRE}
_HEAD = 6  # EgmJoints contains at most six values; further axes of the robot are sent as external joints


class Refused(Exception):
    """Unusable message, which the codec returns as a `Drop`."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.drop: Drop = Drop(reason, detail)


class AxisMap:
    """Permutation and units of one robot; with w = joints ++ externalJoints, q[i] = scale[i] * w[abb_axes[i] - 1].

    Revolute joints and external axes are in degrees on the wire. A prismatic joint among the first six arrives as
    metres times 180/pi (abb_libegm pull request 142), so it has the factor of a revolute joint; a later prismatic joint
    arrives in millimetres. `units` ("deg" or "mm", for each joint in kinematic order and then for each external axis)
    replaces this rule. An arm without joints is an external unit, whose axes are all external joints.
    """

    order: tuple[int, ...]  # axis of each joint, from 0
    scale: np.ndarray  # (n,) SI per wire unit of the joints
    beyond: np.ndarray  # SI per wire unit of the first external axes

    def __init__(self, arm: RobotAxes, units: Sequence[str] = ()) -> None:
        axes = tuple(int(axis) for axis in arm.abb_axes)
        if sorted(axes) != list(range(1, arm.n + 1)):
            raise RobotError(f"Expected `abb_axes` to be a permutation of 1 to {arm.n}, got {axes}.")
        self.n: int = arm.n
        self.head: int = min(arm.n, _HEAD)  # number of joints among ABB's first six axes
        self.tail: int = arm.n - self.head
        self.order = order = tuple(axis - 1 for axis in axes)
        linear = np.asarray(arm.prismatic, dtype=bool)
        self.scale = np.where(linear & (np.array(order) >= self.head), _MILLIMETRE, RADIAN)
        self.can_move: bool = bool(units) or not np.any(linear & (np.array(order) < self.head))
        self.beyond = np.array([], dtype=np.float64)
        if units:
            if not set(units) <= _UNITS.keys() or len(units) < arm.n:
                raise ConfigError(f'Expected units of "deg" or "mm" for at least {arm.n} joints, got {tuple(units)}.')
            factors = np.array([_UNITS[unit] for unit in units])
            self.scale, self.beyond = factors[: arm.n], factors[arm.n :]
        self._inverse = tuple(order.index(k) for k in range(arm.n))

    def kinematic(self, values: Sequence[float]) -> tuple[float, ...]:
        """Reorder values from ABB's axis order to kinematic order."""
        return tuple(values[k] for k in self.order)

    def abb(self, values: Sequence[float]) -> tuple[float, ...]:
        """Reorder joint values from kinematic order to ABB's axis order."""
        return tuple(values[k] for k in self._inverse)

    def joints(self, joints: Sequence[float], external: Sequence[float]) -> tuple[float, ...]:
        """Return the n joints in kinematic order and wire units; more external axes may follow those of the robot."""
        if not joints and (self.head or not external):
            raise Refused("no joints", "the array of joints is absent or empty")
        if len(joints) != self.head or len(external) < self.tail:
            raise Refused(
                "joint count",
                f"expected {self.head} joints and at least {self.tail} external, got {len(joints)} and {len(external)}",
            )
        return self.kinematic((*joints, *external) if self.tail else joints)

    def external_scale(self, count: int) -> np.ndarray:
        """Return the factors (count,) from wire to SI units for the external axes that follow those of the robot."""
        known = self.beyond[:count]
        return np.concatenate((known, np.full(count - len(known), RADIAN)))

    def array(self, values: Sequence[float], is_kinematic: bool) -> tuple[float, ...] | None:
        """Return the n values of one extension array in kinematic order, or None if absent."""
        if not values:
            return None
        if len(values) != self.n:
            raise Refused("joint count", f"expected {self.n} values in each array of the extension, got {len(values)}")
        return tuple(values) if is_kinematic else self.kinematic(values)

    def wire(self, q: np.ndarray, scale: np.ndarray) -> tuple[float, ...]:
        """Return `q` (n,) in wire units and ABB's order: `head` joints, then external joints."""
        return self.abb((q / scale).tolist())


Message = TypeVar("Message", bound=Any)

_MOTIONS = ("q", "qd", "q_planned", "q_reference", "qd_reference")
_TORQUES = ("tau", "tau_total", "tau_gravity", "tau_reference")


class Linkage:
    """Conversion between ABB's axes and joints, both in kinematic order, with the coupling C (n, n)."""

    def __init__(self, coupling: np.ndarray) -> None:
        inverse = np.linalg.inv(coupling)
        self._to_joints, self._to_axes = coupling, inverse
        self._torque_to_joints, self._torque_to_axes = inverse.T, coupling.T

    @classmethod
    def of(cls, arm: RobotAxes) -> Linkage | None:
        """Return the linkage of a robot, or None if its axes equal its joints."""
        coupling = np.asarray(arm.coupling, dtype=np.float64)
        gears = np.diag(coupling)
        if not np.any(coupling - np.diag(gears)):
            return None
        if not np.all(gears) or abs(np.linalg.det(coupling / gears)) < 1e-9:
            raise RobotError(f"Expected an invertible coupling in which each motor has its own joint, got {coupling}.")
        return cls(coupling / gears)

    def joints(self, axes: np.ndarray) -> np.ndarray:
        """Return joint positions or velocities (n,) from `axes` (n,)."""
        return _times(self._to_joints, axes)

    def axes(self, joints: np.ndarray) -> np.ndarray:
        """Return axis positions or velocities (n,) from `joints` (n,)."""
        return _times(self._to_axes, joints)

    def from_axes(self, message: Message) -> Message:
        """Convert a received message from axes to joints."""
        return _changed(message, self._to_joints, self._torque_to_joints)

    def to_axes(self, message: Message) -> Message:
        """Convert an outgoing message from joints to axes."""
        return _changed(message, self._to_axes, self._torque_to_axes)


def _changed(message: Message, motion: np.ndarray, torque: np.ndarray) -> Message:
    fields = [(name, motion) for name in _MOTIONS] + [(name, torque) for name in _TORQUES]
    values = {name: (matrix, getattr(message, name, None)) for name, matrix in fields}
    return message._replace(**{name: _times(matrix, old) for name, (matrix, old) in values.items() if old is not None})


def _times(matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the matrix product, in which a NaN affects only the values that depend on it."""
    with np.errstate(invalid="ignore", over="ignore"):
        product = np.where(matrix, matrix * values, 0.0).sum(axis=1)
    product.flags.writeable = False
    return product
