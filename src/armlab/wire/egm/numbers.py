"""From the numbers of an EgmRobot to a `Packet`: order, units, and what is absent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite, nan
from struct import Struct
from typing import NamedTuple, TypeVar

import numpy as np

from armlab.wire.egm.axes import AxisMap, Refused
from armlab.wire.egm.pose import pose_values
from armlab.wire.egm.types import Packet

__all__ = ["INTEGERS", "Numbers", "Shape"]

T = TypeVar("T", int, float)

INTEGERS = (
    "header.seqno",
    "header.tm",
    "feedBack.time.sec",
    "feedBack.time.usec",
    "researchState.tNs",
    "researchState.queueDepth",
)
"""The integers of an EgmRobot that change from packet to packet, in the order of `Shape.packet`."""

_POSE = ("pos.x", "pos.y", "pos.z", "orient.u0", "orient.u1", "orient.u2", "orient.u3")
_UINT32, _UINT64 = 2**32 - 1, 2**64 - 1
_MAX_SECONDS = 9_000_000_000  # a later clock does not fit int64 nanoseconds: it counts as absent
_EMPTY = np.zeros(0)
_EMPTY.flags.writeable = False


class Numbers(NamedTuple):
    """The doubles of an EgmRobot by field, as on the wire; or, in their place, their offsets in the datagram.

    Attributes
    ----------
    joints, external : of the feedback. planned, planned_external : of the controller's reference.
    velocities, torques : of the extension. torque_reference : torqueRef. force : measuredForce. data : RAPIDfromRobot.
    utilization : one or none. pose : x, y, z, u0 to u3, or nothing.
    """

    joints: Sequence[float]
    external: Sequence[float]
    planned: Sequence[float]
    planned_external: Sequence[float]
    velocities: Sequence[float]
    torques: Sequence[float]
    torque_reference: Sequence[float]
    force: Sequence[float]
    data: Sequence[float]
    utilization: Sequence[float]
    pose: Sequence[float]

    @classmethod
    def of_offsets(cls, doubles: Mapping[str, Sequence[int]]) -> Numbers:
        """Return the offsets by field.

        Parameters
        ----------
        doubles : offsets by name, see `layout.Places`.
        """
        names = (
            "feedBack.joints.joints",
            "feedBack.externalJoints.joints",
            "planned.joints.joints",
            "planned.externalJoints.joints",
            "researchState.jointVel",
            "researchState.torqueMeas",
            "torqueRef.joints",
            "measuredForce.force",
            "rapidFromRobot.dnum",
        )
        pose = [doubles.get(f"feedBack.cartesian.{name}", ())[-1:] for name in _POSE]
        return cls(
            *(tuple(doubles.get(name, ())) for name in names),
            utilization=doubles.get("utilizationRate", ())[-1:],
            pose=[offset[0] for offset in pose] if all(pose) else (),
        )


class Shape:
    """What packets that look alike have in common, and how their numbers become a `Packet`.

    Parameters
    ----------
    axes : order and units. numbers : of the packet that shows the shape. is_kinematic : order of the extension.
    has_tm, has_research : fields present. states : motors, mci, rapid.
    converged, robotware, rapid_digital : see `Packet`.

    Raises
    ------
    Refused : wrong number of joints.
    """

    def __init__(
        self,
        axes: AxisMap,
        numbers: Numbers,
        is_kinematic: bool,
        *,
        has_tm: bool,
        has_research: bool,
        states: tuple[int, int, int],
        converged: bool,
        robotware: str,
        rapid_digital: bool,
    ) -> None:
        self._axes, self._is_kinematic = axes, is_kinematic
        axes.joints(numbers.joints, numbers.external)
        n, external, data = axes.n, len(numbers.external) - axes.tail, len(numbers.data)
        self._has_tm, self._has_research = has_tm, has_research
        self._has_qd = axes.array(numbers.velocities, is_kinematic) is not None
        has_torque = axes.array(numbers.torques, is_kinematic) is not None
        has_reference = len(numbers.torque_reference) == axes.head > 0
        self._tau_source = "measured" if has_torque else "reference" if has_reference else "none"
        self._states, self._converged, self._robotware = states, converged, robotware
        self._rapid_digital = rapid_digital
        self._n, self._moving = n, (2 if self._has_qd else 1) * n
        self._ends = 4 * n, 4 * n + 6, 4 * n + 6 + external, 4 * n + 6 + external + data
        one, in_radians = np.ones(n), robotware == "6.06"
        scale = one if in_radians else axes.scale
        beyond = np.ones(external) if in_radians else axes.external_scale(external)
        self._scale = np.concatenate((scale, axes.scale, scale, one, np.ones(6), beyond, np.ones(data + 16)))
        present = np.array(self.arranged(Numbers(*((1.0,) * len(values) for values in numbers)), nan))
        self._scale[:-16] *= present[:-8]  # what is absent is 0 among the numbers, and becomes NaN
        self._has_utilization = bool(numbers.utilization)
        # One array per packet, cut into all its vectors: five times cheaper than one array for each.
        self._pack = Struct(f"={len(self._scale)}d").pack

    def arranged(self, numbers: Numbers, absent: T) -> list[T]:
        """Return numbers in the order q, qd, q_planned, tau, force, external axes, data, utilization, pose.

        Parameters
        ----------
        numbers : values or offsets of a packet of this shape. absent : stands for what is missing.
        """
        axes, missing = self._axes, (absent,) * self._n
        try:
            planned = axes.joints(numbers.planned, numbers.planned_external)
        except Refused:
            planned = missing
        tau: Sequence[float] = missing
        if self._tau_source == "measured":
            tau = axes.array(numbers.torques, self._is_kinematic) or missing
        elif self._tau_source == "reference":  # ABB's message holds six values: the seventh axis has none
            tau = axes.kinematic((*numbers.torque_reference, *[absent] * axes.tail))
        return [
            *axes.joints(numbers.joints, numbers.external),
            *(axes.array(numbers.velocities, self._is_kinematic) or missing),
            *planned,
            *tau,
            *(numbers.force if len(numbers.force) == 6 else [absent] * 6),
            *numbers.external[axes.tail :],
            *numbers.data,
            *(numbers.utilization or (absent,)),
            *(numbers.pose or [absent] * 7),
        ]  # pyright: ignore[reportReturnType] - offsets when absent is an offset

    def packet(self, numbers: Sequence[float], integers: Sequence[int]) -> Packet | None:
        """Return the packet, None when a joint, a velocity or an external axis is not finite.

        Parameters
        ----------
        numbers : in the order of `arranged`, 0 for what is absent. integers : values of `INTEGERS`.
        """
        n, (tau, force, external, data) = self._n, self._ends
        values = np.frombuffer(self._pack(*numbers[:-8], *pose_values(numbers[-7:])))
        if isfinite(sum(numbers)):
            values = values * self._scale
        elif isfinite(sum(numbers[: self._moving]) + sum(numbers[force:external])):
            with np.errstate(invalid="ignore"):  # a signalling NaN from the wire would warn
                values = values * self._scale
        else:
            return None
        seqno, tm, seconds, microseconds, mono, queue = integers
        values.setflags(write=False)
        motors, mci, rapid = self._states
        return Packet(  # in the order of its fields: keywords would cost another half microsecond
            seqno & _UINT32,
            tm & _UINT32 if self._has_tm else None,
            _nanoseconds(seconds & _UINT64, microseconds & _UINT64),
            values[:n],
            values[2 * n : 3 * n],
            values[force:external] if external > force else _EMPTY,
            values[n : 2 * n] if self._has_qd else None,
            values[3 * n : tau] if self._tau_source != "none" else None,
            self._tau_source,
            values[-16:].reshape(4, 4),
            values[tau:force],
            motors,
            mci,
            rapid,
            self._converged,
            numbers[-8] if self._has_utilization else nan,
            self._robotware,
            values[external:data] if data > external else _EMPTY,
            self._rapid_digital,
            mono & _UINT64,
            queue & _UINT32 if self._has_research else -1,
        )


def _nanoseconds(seconds: int, microseconds: int) -> int:
    return seconds * 10**9 + microseconds * 1000 if seconds < _MAX_SECONDS and microseconds < 10**9 else 0
