"""The bridge's side of EGM: decode EgmRobot, encode EgmSensor.

The only place, with its neighbours in this package, where degrees, millimetres and milliseconds exist.
`decode` never raises, whatever the bytes; what is wrong comes back as a `Drop`.
"""

from __future__ import annotations

from math import isfinite, nan
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import RADIAN, AxisMap, Refused
from armlab.wire.egm.force import decode_force
from armlab.wire.egm.pose import matrix_from_pose
from armlab.wire.egm.types import Arm, Drop, Packet, Reference

__all__ = ["EgmCodec"]

_DATA, _CORRECTION = 2, 3
_KINEMATIC = 1
_UINT32, _UINT64 = 2**32 - 1, 2**64 - 1
_MAX_SECONDS = 9_000_000_000  # a later clock does not fit int64 nanoseconds: it counts as absent
_EMPTY = np.zeros(0)
_EMPTY.flags.writeable = False


class EgmCodec:
    """EgmRobot to `Packet` and `Reference` to EgmSensor, for one arm.

    The RobotWare flavour is decided on the first packet of a session and kept until `reset`.

    Parameters
    ----------
    arm : the robot: number of joints, which are linear, ABB's axis numbers.
    extension : send the research extension (field 101). It is understood whenever it arrives.

    Attributes
    ----------
    capabilities : "position" and "velocity", unless a linear joint sits among ABB's first six axes: the unit of
        commands to it is not established. "measured_torque" with the extension.
    robotware : flavour of this session, "" before its first packet.
    """

    def __init__(self, arm: Arm, extension: bool = False) -> None:
        self._axes = AxisMap(arm)
        self._extension = extension
        self._unit_scale = np.ones(arm.n)
        self._absent = np.full(arm.n, nan)
        self._absent.flags.writeable = False
        self._sensor = pb.EgmSensor()
        self.robotware = ""
        moves = () if self._axes.linear_head else ("position", "velocity")
        self.capabilities = frozenset((*moves, *(("measured_torque",) if extension else ())))

    def reset(self) -> None:
        """Forget the flavour: a new session begins."""
        self.robotware = ""

    def decode(self, data: bytes) -> Packet | Drop:
        """Return the packet, or why it is dropped. Never raises.

        Parameters
        ----------
        data : one datagram.
        """
        try:
            packet = self._packet(pb.EgmRobot.FromString(data))
        except DecodeError:
            return Drop("unparsable", f"{len(data)} bytes are no protobuf message")
        except Refused as refused:
            return refused.drop
        self.robotware = packet.robotware
        return packet

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of an EgmSensor that holds a joint reference.

        Parameters
        ----------
        ref : finite values; the bridge has checked them.
        """
        axes, sensor = self._axes, self._sensor
        sensor.Clear()
        header = sensor.header
        header.seqno, header.tm, header.mtype = ref.seq & _UINT32, ref.tm_ms & _UINT32, _CORRECTION
        planned = axes.wire(ref.q, axes.scale)
        sensor.planned.joints.joints.extend(planned[: axes.head])
        if axes.tail:
            sensor.planned.externalJoints.joints.extend(planned[axes.head :])
        if ref.qd is not None:
            speed = axes.wire(ref.qd, axes.scale)
            sensor.speedRef.joints.joints.extend(speed[: axes.head])
            if axes.tail:
                sensor.speedRef.externalJoints.joints.extend(speed[axes.head :])
        if self._extension:
            research = sensor.researchRef
            research.order = _KINEMATIC
            research.echoSeqno, research.echoTNs = ref.robot_seq & _UINT32, ref.robot_mono_ns & _UINT64
            if ref.tau is not None:
                research.torqueFF.extend(ref.tau.tolist())
                research.validMask = 1
        return sensor.SerializeToString()

    def _packet(self, message: Any) -> Packet:
        header, feedback = message.header, message.feedBack
        if not header.HasField("seqno"):
            raise Refused("no header", "a message without a header that has a sequence number")
        if header.mtype != _DATA:
            raise Refused("wrong type", f"expected message type {_DATA} (data from the robot), got {header.mtype}")
        wrench, force_is_rw7 = decode_force(message.measuredForce)
        robotware = self.robotware or _flavour(message, force_is_rw7)
        in_radians = robotware == "6.06"
        scale = self._unit_scale if in_radians else self._axes.scale
        external = feedback.externalJoints.joints
        q = self._axes.joints(feedback.joints.joints, external, scale)
        q_ext = np.array(external[self._axes.tail :]) * (1.0 if in_radians else RADIAN) if external else _EMPTY
        T_frame_tool = matrix_from_pose(feedback.cartesian)
        qd, tau, tau_source = self._motion(message)
        for name, values in (("joints", q), ("externalJoints", q_ext), ("jointVel", qd)):
            if values is not None and not isfinite(sum(values.tolist())):
                raise Refused("not finite", f"{name} hold NaN or infinity")
        research = message.researchState
        return Packet(
            seqno=header.seqno,
            tm_ms=header.tm if header.HasField("tm") else None,
            robot_ns=_nanoseconds(feedback.time),
            q=q,
            q_planned=self._planned(message.planned, scale),
            q_ext=q_ext,
            qd=qd,
            tau=tau,
            tau_source=tau_source,
            T_frame_tool=T_frame_tool,
            wrench_raw=wrench,
            motors=message.motorState.state,
            mci=message.mciState.state,
            rapid=message.rapidExecState.state,
            converged=message.mciConvergenceMet,
            utilization=message.utilizationRate if message.HasField("utilizationRate") else nan,
            robotware=robotware,
            rapid_data=np.array(message.rapidFromRobot.dnum) if message.HasField("rapidFromRobot") else _EMPTY,
            rapid_digital=message.rapidFromRobot.digVal,
            robot_mono_ns=research.tNs,
            queue_depth=research.queueDepth if research.HasField("queueDepth") else -1,
        )

    def _planned(self, planned: Any, scale: np.ndarray) -> np.ndarray:
        try:
            return self._axes.joints(planned.joints.joints, planned.externalJoints.joints, scale)
        except Refused:
            return self._absent

    def _motion(self, message: Any) -> tuple[np.ndarray | None, np.ndarray | None, str]:
        """Return qd, tau and the source of tau: the extension, else torqueRef (axis 7 is not in it: NaN), else none."""
        qd = tau = None
        if message.HasField("researchState"):
            research = message.researchState
            kinematic = research.order == _KINEMATIC
            qd = self._axes.array(research.jointVel, kinematic)
            qd = None if qd is None else qd * self._axes.scale
            tau = self._axes.array(research.torqueMeas, kinematic)
        if tau is not None:
            return qd, tau, "measured"
        torque = message.torqueRef.joints
        if len(torque) == self._axes.head:
            return qd, self._axes.array([*torque, *[nan] * self._axes.tail], kinematic=False), "reference"
        return qd, None, "none"


def _nanoseconds(clock: Any) -> int:
    if clock.sec > _MAX_SECONDS or clock.usec > 10**9:
        return 0
    return clock.sec * 10**9 + clock.usec * 1000


def _flavour(message: Any, force_is_rw7: bool) -> str:
    """Return the RobotWare flavour by the fields present (as abb_libegm does it)."""
    feedback = message.feedBack
    newer = ("moveIndex", "collisionInfo", "rapidFromRobot", "torqueRef")
    if force_is_rw7 or feedback.HasField("timeStamp") or any(message.HasField(name) for name in newer):
        return "7"
    if message.HasField("utilizationRate"):
        return "6.10"
    return "6.07" if feedback.HasField("time") else "6.06"
