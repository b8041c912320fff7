"""Positions of the numbers in an EgmRobot: learnt from one message, used for the next ones of the same shape.

The packets of a session differ in their numbers only. One comparison under a mask says whether all tags, lengths and
states of a datagram are those of the packet that was learnt from; its numbers are then read (`kernels.EgmReader`) at a
fifth of the time that a parser and its objects take. Replies are written (`kernels.EgmWriter`) in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan
from typing import Any, NamedTuple, TypeVar

import numpy as np

from armlab import kernels
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import AxisMap, Refused
from armlab.wire.egm.pose_force import is_layout_of_rw7
from armlab.wire.egm.types import Packet

_LONGEST = 2048  # bytes that are looked through; RobotWare 7 with everything that it can send has 1110
_VARINT, _EIGHT_BYTES, _BYTES, _FOUR_BYTES = 0, 1, 2, 5
_STATES = {
    "header.mtype",
    "motorState.state",
    "mciState.state",
    "mciConvergenceMet",
    "rapidExecState.state",
    "rapidFromRobot.digVal",
    "researchState.order",
}  # integers that belong to the shape: when one changes the layout is learnt anew


class Places:
    """What `find_places` found in a message.

    `mask`: 1 for each bit that belongs to the shape; `doubles`: offsets of the values of each field, by its name with
    dots; `integers`: (start, stop) of each varint.
    """

    def __init__(self, size: int) -> None:
        self.mask = bytearray(b"\xff" * size)
        self.doubles: dict[str, list[int]] = {}
        self.integers: dict[str, tuple[int, int]] = {}

    def walk(self, data: bytes, at: int, stop: int, message: Any, prefix: str) -> None:
        """Look through one message, given by its descriptor, and those inside it."""
        while at < stop:
            tag, at = _varint(data, at)
            field = message.fields_by_number.get(tag >> 3)
            at = self._field(data, at, tag & 7, field, prefix + field.name if field else "")
        if at != stop:
            raise ValueError

    def _field(self, data: bytes, at: int, kind: int, field: Any, name: str) -> int:
        """Note the field whose tag ends at `at`, and return where it ends."""
        if kind == _VARINT:
            end = _varint(data, at)[1]
            if name not in _STATES:
                self.mask[at:end] = b"\x80" * (end - at)  # whether another byte follows is part of the shape
            self.integers[name] = at, end
            return end
        if kind not in (_EIGHT_BYTES, _BYTES, _FOUR_BYTES):
            raise ValueError
        length, at = _varint(data, at) if kind == _BYTES else ({_EIGHT_BYTES: 8, _FOUR_BYTES: 4}[kind], at)
        end = at + length
        if end > len(data):  # of what a parser has not looked into: nothing of that size is allocated
            raise ValueError
        is_double = field is not None and field.type == field.TYPE_DOUBLE
        if kind == _BYTES and name == "measuredForce":
            is_rw7 = is_layout_of_rw7(data[at:end])
            self.walk(data, at, end, (pb.EgmForceRw7 if is_rw7 else pb.EgmForceRw6).DESCRIPTOR, name + ".")
        elif kind == _BYTES and field is not None and field.message_type is not None:
            self.walk(data, at, end, field.message_type, name + ".")
        else:
            self.mask[at:end] = bytes(length)
            if is_double and kind in (_EIGHT_BYTES, _BYTES):
                self.doubles.setdefault(name, []).extend(range(at, end, 8))
        return end


def find_places(data: bytes, descriptor: Any = pb.EgmRobot.DESCRIPTOR) -> Places | None:
    """Return where the numbers of a message lie, None for what is too long or not laid out as usual.

    `descriptor`: of the message, by default an EgmRobot.
    """
    if len(data) > _LONGEST:
        return None
    places = Places(len(data))
    try:
        places.walk(data, 0, len(data), descriptor, "")
    except (ValueError, IndexError):
        return None
    return places


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the integer at an offset and where it ends."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


T = TypeVar("T", int, float)

INTEGERS = (
    "header.seqno",
    "header.tm",
    "feedBack.time.sec",
    "feedBack.time.usec",
    "researchState.tNs",
    "researchState.queueDepth",
)
"""The integers of an EgmRobot that change from packet to packet, in the order of `kernels.EgmReader`."""

_POSE = ("pos.x", "pos.y", "pos.z", "orient.u0", "orient.u1", "orient.u2", "orient.u3")
_SCALARS = ("seqno", "tm_ms", "robot_ns", "utilization", "robot_mono_ns", "queue_depth")
_EMPTY = np.zeros(0)
_EMPTY.flags.writeable = False
_FIXED = Packet(
    seqno=0, tm_ms=None, robot_ns=0, q=_EMPTY, q_planned=_EMPTY, q_ext=_EMPTY, qd=None, tau=None, tau_source="none",
    T_frame_tool=_EMPTY, wrench_raw=_EMPTY, motors=0, mci=0, rapid=0, converged=False, utilization=nan, robotware="",
    rapid_data=_EMPTY, rapid_digital=False, robot_mono_ns=0, queue_depth=-1,
)  # fmt: skip
"""A packet in which nothing was sent."""


class Numbers(NamedTuple):
    """The doubles of an EgmRobot by field, as on the wire; or, in their place, their offsets in the datagram.

    `joints`, `external`: of the feedback; `planned`, `planned_external`: of the controller's reference; `velocities`,
    `torques`: of the extension; `torque_reference`: torqueRef; `force`: measuredForce; `data`: RAPIDfromRobot;
    `utilization`: one or none; `pose`: x, y, z, u0 to u3, or nothing.
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
        """Return the offsets by field."""
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
            pose=[offset[0] if offset else -1 for offset in pose],
        )


class Shape:
    """What packets that look alike have in common, and how their numbers become a `Packet`.

    `reader`: makes packets of numbers in the order of `arranged`; see `kernels.EgmReader`.
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
        self._axes, self._is_kinematic, self._has_pose = axes, is_kinematic, bool(numbers.pose)
        axes.joints(numbers.joints, numbers.external)
        n, external, data = axes.n, len(numbers.external) - axes.tail, len(numbers.data)
        has_qd = axes.array(numbers.velocities, is_kinematic) is not None
        has_torque = axes.array(numbers.torques, is_kinematic) is not None
        has_reference = len(numbers.torque_reference) == axes.head > 0
        self._tau_source = "measured" if has_torque else "reference" if has_reference else "none"
        self._n = n
        one, in_radians = np.ones(n), robotware == "6.06"
        scale = one if in_radians else axes.scale
        beyond = np.ones(external) if in_radians else axes.external_scale(external)
        scales = np.concatenate((scale, axes.scale, scale, one, np.ones(6), beyond, np.ones(data + 16)))
        present = np.array(self.arranged(Numbers(*((1.0,) * len(values) for values in numbers)), nan))
        scales[:-16] *= present[:-8]  # what is absent is 0 among the numbers, and becomes NaN
        motors, mci, rapid = states
        fixed = _FIXED._replace(
            tau_source=self._tau_source, motors=motors, mci=mci, rapid=rapid, converged=converged,
            robotware=robotware, rapid_digital=rapid_digital,
        )  # fmt: skip
        force, beyond_force = 4 * n, 4 * n + 6 + external
        arrays = {"q": (0, n), "q_planned": (2 * n, 3 * n), "wrench_raw": (force, force + 6)}
        arrays |= {"qd": (n, 2 * n)} if has_qd else {}
        arrays |= {"tau": (3 * n, force)} if self._tau_source != "none" else {}
        arrays |= {"q_ext": (force + 6, beyond_force)} if external else {}
        arrays |= {"rapid_data": (beyond_force, beyond_force + data)} if data else {}
        absent = () if has_tm else ("tm_ms",)
        absent += () if numbers.utilization else ("utilization",)
        absent += () if has_research else ("queue_depth",)
        self.reader = kernels.EgmReader(
            Packet,
            tuple(fixed),
            [(Packet._fields.index(name), *span) for name, span in arrays.items()],
            Packet._fields.index("T_frame_tool"),
            [-1 if name in absent else Packet._fields.index(name) for name in _SCALARS],
            scales,
            [(0, 2 * n if has_qd else n), (force + 6, beyond_force)],
        )

    def arranged(self, numbers: Numbers, absent: T) -> list[T]:
        """Return numbers in the order q, qd, q_planned, tau, force, external axes, data, utilization, pose."""
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
            *(numbers.pose if self._has_pose else [absent] * 7),
        ]  # pyright: ignore[reportReturnType] - offsets when absent is an offset
