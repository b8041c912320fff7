"""`Linkage`: robots on which ABB's angle of an axis is not the angle of a joint, because a motor moves two joints.

On an IRB 2400 a parallel rod turns the upper arm, and ABB counts axis 3 from the foot: axis 3 = q_2 + q_3. EGM speaks
of axes, armlab of joints: ``q = C q_axis``, ``qd = C qd_axis``, ``tau = C^-T tau_axis``. C is the coupling of the
robot's description without its gear ratios, which are ABB's own business: EGM is behind the gears.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from armlab.errors import RobotError
from armlab.wire.egm.types import Arm

__all__ = ["Linkage"]

Message = TypeVar("Message", bound=Any)

_MOTIONS = ("q", "qd", "q_planned", "q_reference", "qd_reference")
_TORQUES = ("tau", "tau_total", "tau_gravity", "tau_reference")


class Linkage:
    """Between ABB's axes and joints, both in kinematic order.

    Parameters
    ----------
    coupling : (n, n) C. `Linkage.of` makes it of a robot.
    """

    def __init__(self, coupling: np.ndarray) -> None:
        inverse = np.linalg.inv(coupling)
        self._to_joints, self._to_axes = coupling, inverse
        self._torque_to_joints, self._torque_to_axes = inverse.T, coupling.T

    @classmethod
    def of(cls, arm: Arm) -> Linkage | None:
        """Return the linkage of a robot, None where every axis is a joint.

        Parameters
        ----------
        arm : its coupling.

        Raises
        ------
        RobotError : a coupling from which axes cannot be told: a motor that does not move its own joint, or none.
        """
        coupling = np.asarray(arm.coupling, dtype=np.float64)
        gears = np.diag(coupling)
        if not np.any(coupling - np.diag(gears)):
            return None
        if not np.all(gears) or abs(np.linalg.det(coupling / gears)) < 1e-9:
            raise RobotError(
                f"Expected a coupling that can be inverted, each motor with its own joint, got {coupling}."
            )
        return cls(coupling / gears)

    def joints(self, axes: np.ndarray) -> np.ndarray:
        """Return positions or velocities (n,) of the joints. `axes` (n,) : those of the axes."""
        return _times(self._to_joints, axes)

    def axes(self, joints: np.ndarray) -> np.ndarray:
        """Return positions or velocities (n,) of the axes. `joints` (n,) : those of the joints."""
        return _times(self._to_axes, joints)

    def heard(self, message: Message) -> Message:
        """Return a message from the wire with its axes made joints.

        Parameters
        ----------
        message : a `Packet`, `SensorMessage` or `Details`; what it does not have is left out.
        """
        return _changed(message, self._to_joints, self._torque_to_joints)

    def said(self, message: Message) -> Message:
        """Return a message for the wire with its joints made axes.

        Parameters
        ----------
        message : a `Reference` or `RobotMessage`.
        """
        return _changed(message, self._to_axes, self._torque_to_axes)


def _changed(message: Message, motion: np.ndarray, torque: np.ndarray) -> Message:
    fields = [(name, motion) for name in _MOTIONS] + [(name, torque) for name in _TORQUES]
    values = {name: (matrix, getattr(message, name, None)) for name, matrix in fields}
    return message._replace(**{name: _times(matrix, old) for name, (matrix, old) in values.items() if old is not None})


def _times(matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the product; NaN in one value spoils only what depends on it."""
    with np.errstate(invalid="ignore", over="ignore"):
        product = np.where(matrix, matrix * values, 0.0).sum(axis=1)
    product.flags.writeable = False
    return product
