"""The bridge's side of EGM: decode EgmRobot, encode EgmSensor and EgmSensorPathCorr.

The only place, with its neighbours in this package, where degrees, millimetres and milliseconds exist.
`decode` never raises, whatever the bytes; what is wrong comes back as a `Drop`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from armlab import kernels
from armlab.errors import ShapeError
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import AxisMap, Refused
from armlab.wire.egm.details import Details, read_details
from armlab.wire.egm.force import NO_WRENCH, decode_force
from armlab.wire.egm.layout import find_places
from armlab.wire.egm.linkage import Linkage
from armlab.wire.egm.numbers import INTEGERS, Numbers, Shape
from armlab.wire.egm.pose import read_pose
from armlab.wire.egm.replies import Replies, encode_path_correction, encode_pose
from armlab.wire.egm.types import Arm, Drop, Packet, Reference

__all__ = ["EgmCodec"]

_DATA = 2
_KINEMATIC = 1
_PATIENCE = 1000  # layouts per session: a robot whose packets never look alike is parsed from then on


class EgmCodec:
    """EgmRobot to `Packet` and `Reference` to EgmSensor, for one arm.

    The RobotWare flavour is decided on the first packet of a session and kept until `reset`. Packets are read where
    the numbers of the last ones like them lay (`layout`), and parsed when they look otherwise.

    Parameters
    ----------
    arm : the robot: number of joints, which are linear, ABB's axis numbers.
    extension : send the research extension (field 101). It is understood whenever it arrives.
    units : "deg" or "mm" on the wire, for each joint in kinematic order and then for each external axis; see `AxisMap`.

    Attributes
    ----------
    capabilities : "position" and "velocity", unless a linear joint sits among ABB's first six axes and `units` does not
        say how commands to it are measured; then "external_axes" and "rapid_data" too. "measured_torque" and "torque"
        with the extension.
    robotware : flavour of this session, "" before its first packet.
    """

    def __init__(self, arm: Arm, extension: bool = False, units: Sequence[str] = ()) -> None:
        self._axes, self._linkage = AxisMap(arm, units), Linkage.of(arm)
        self._replies = Replies(self._axes, extension)
        self._known: dict[int, kernels.EgmReader] = {}
        self._learnt = 0
        self.robotware = ""
        moves = ("position", "velocity", "external_axes", "rapid_data") if self._axes.can_move else ()
        research = ("measured_torque", "torque") if extension and moves else ("measured_torque",) if extension else ()
        self.capabilities: frozenset[str] = frozenset((*moves, *research))

    def reset(self) -> None:
        """Forget the flavour: a new session begins."""
        self.robotware = ""
        self._known.clear()
        self._learnt = 0

    def decode(self, data: bytes) -> Packet | Drop:
        """Return the packet, or why it is dropped. Never raises.

        Parameters
        ----------
        data : one datagram.
        """
        known = self._known.get(len(data))
        if known is not None:
            packet = known.read(data)
            if packet is not None:
                return packet if self._linkage is None else self._linkage.heard(packet)
        try:
            message = pb.EgmRobot.FromString(data)
            shape, numbers, integers = self._parsed(message)
        except DecodeError:
            return Drop("unparsable", f"{len(data)} bytes are no protobuf message")
        except Refused as refused:
            return refused.drop
        packet = shape.reader.packet(numbers, integers)
        if packet is None:
            return Drop("not finite", "a joint, a velocity or an external axis is no number, or beyond 1e9")
        self.robotware = packet.robotware
        self._learn(data, shape, packet)
        return packet if self._linkage is None else self._linkage.heard(packet)

    def details(self, data: bytes) -> Details | None:
        """Return what a datagram says beside its `Packet`, None for what is none of this robot. Never raises.

        Parameters
        ----------
        data : one datagram.
        """
        found = read_details(self._axes, data, self.robotware)
        return found if found is None or self._linkage is None else self._linkage.heard(found)

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of an EgmSensor that holds a joint reference.

        Parameters
        ----------
        ref : finite values; the bridge has checked them.
        """
        return self._replies.encode(ref if self._linkage is None else self._linkage.said(ref))

    def encode_pose(self, T_frame_tool: np.ndarray, twist: np.ndarray | None, seq: int, tm_ms: int) -> bytes:
        """Return the bytes of an EgmSensor that holds a pose, for `EGMRunPose`. Never with Euler angles.

        Parameters
        ----------
        T_frame_tool : (4, 4) in the frame that RAPID activated. twist : (6,) its speed [v; w], or None.
        seq, tm_ms : as in `Reference`.
        """
        return encode_pose(T_frame_tool, twist, seq, tm_ms)

    def encode_path_correction(self, yz: Sequence[float], age: float, seq: int, tm_ms: int) -> bytes:
        """Return the bytes of an EgmSensorPathCorr, for `EGMMoveL` and `EGMMoveC`; at most one per 24 ms acts.

        Parameters
        ----------
        yz : correction across the path in the sensor's tool frame [m]; along the path none acts.
        age : of the measurement [s]. seq, tm_ms : as in `Reference`.
        """
        return encode_path_correction(yz, age, seq, tm_ms)

    def _parsed(self, message: Any) -> tuple[Shape, Sequence[float], Sequence[int]]:
        """Return the shape of a message, and its numbers in the order of `Numbers.arranged`."""
        header, feedback, planned = message.header, message.feedBack, message.planned
        if not header.HasField("seqno"):
            raise Refused("no header", "a message without a header that has a sequence number")
        if header.mtype != _DATA:
            raise Refused("wrong type", f"expected message type {_DATA} (data from the robot), got {header.mtype}")
        force, force_is_rw7 = decode_force(message.measuredForce)
        research = message.researchState
        numbers = Numbers(
            tuple(feedback.joints.joints),
            tuple(feedback.externalJoints.joints),
            tuple(planned.joints.joints),
            tuple(planned.externalJoints.joints),
            tuple(research.jointVel),
            tuple(research.torqueMeas),
            tuple(message.torqueRef.joints),
            () if force is NO_WRENCH else force,
            tuple(message.rapidFromRobot.dnum),
            (message.utilizationRate,) if message.HasField("utilizationRate") else (),
            read_pose(feedback.cartesian) or (),
        )
        shape = Shape(
            self._axes,
            numbers,
            research.order == _KINEMATIC,
            has_tm=header.HasField("tm"),
            has_research=message.HasField("researchState"),
            states=(message.motorState.state, message.mciState.state, message.rapidExecState.state),
            converged=message.mciConvergenceMet,
            robotware=self.robotware or _flavour(message, force_is_rw7),
            rapid_digital=message.rapidFromRobot.digVal,
        )
        time = feedback.time
        integers = (header.seqno, header.tm, time.sec, time.usec, research.tNs, research.queueDepth)
        return shape, shape.arranged(numbers, 0.0), integers

    def _learn(self, data: bytes, shape: Shape, packet: Packet) -> None:
        """Keep the layout of a packet, if reading by it gives what parsing gave."""
        self._learnt += 1
        places = find_places(data) if self._learnt <= _PATIENCE else None
        if places is None:
            return
        reader, absent = shape.reader, (0, 0)
        spans = [places.integers.get(name, absent) for name in INTEGERS]
        try:
            offsets = shape.arranged(Numbers.of_offsets(places.doubles), -1)
            reader.learn(data, bytes(places.mask), offsets, spans)
        except (Refused, ShapeError):  # a field in a form that the parser does not take for it
            return
        if _same(reader.read(data), packet):
            self._known[len(data)] = reader


def _same(a: Any, b: Any) -> bool:
    """Return whether two packets are equal, NaN being equal to itself; False when the first is none."""
    return a is not None and all(
        np.array_equal(x, y, equal_nan=True) if isinstance(x, np.ndarray) else x == y or x != x
        for x, y in zip(a, b, strict=True)
    )


def _flavour(message: Any, force_is_rw7: bool) -> str:
    """Return the RobotWare flavour by the fields present (as abb_libegm does it)."""
    feedback = message.feedBack
    newer = ("moveIndex", "collisionInfo", "rapidFromRobot", "torqueRef")
    if force_is_rw7 or feedback.HasField("timeStamp") or any(message.HasField(name) for name in newer):
        return "7"
    if message.HasField("utilizationRate"):
        return "6.10"
    return "6.07" if feedback.HasField("time") else "6.06"
