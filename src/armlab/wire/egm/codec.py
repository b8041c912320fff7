"""The bridge's side of EGM: decode EgmRobot, encode EgmSensor.

The only place, with its neighbours in this package, where degrees, millimetres and milliseconds exist.
`decode` never raises, whatever the bytes; what is wrong comes back as a `Drop`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, nan
from struct import Struct
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import RADIAN, AxisMap, Refused
from armlab.wire.egm.force import decode_force
from armlab.wire.egm.leaves import joint_reader, read_pose, read_state
from armlab.wire.egm.pose import NO_POSE, pose_values
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
        self._absent = (nan,) * arm.n
        self._read_joints, self._read_external = joint_reader(self._axes.head), joint_reader(self._axes.tail)
        self._read_array = Struct(f"<{arm.n}d")
        # One array per packet, cut into q, q_planned, qd, tau, pose and force: five times cheaper than six arrays.
        self._pack = Struct(f"={4 * arm.n + 22}d").pack
        scale, one, rest = self._axes.scale, np.ones(arm.n), np.ones(22)
        self._scale = np.concatenate((scale, scale, scale, one, rest))
        self._scale_of_radians = np.concatenate((one, one, scale, one, rest))
        self._with_speed = _Reply(self._axes, extension, speed=True)
        self._without_speed = _Reply(self._axes, extension, speed=False)
        self.robotware = ""
        moves = () if self._axes.has_linear_head else ("position", "velocity")
        self.capabilities: frozenset[str] = frozenset((*moves, *(("measured_torque",) if extension else ())))

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
            packet = self._packet(pb.ReadRobot.FromString(data), data)
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
        return self._without_speed.encode(ref) if ref.qd is None else self._with_speed.encode(ref)

    def _packet(self, message: Any, data: bytes) -> Packet:
        header, feedback = message.header, message.feedBack
        if not header.HasField("seqno"):
            raise Refused("no header", "a message without a header that has a sequence number")
        if header.mtype != _DATA:
            raise Refused("wrong type", f"expected message type {_DATA} (data from the robot), got {header.mtype}")
        force, force_is_rw7 = decode_force(message.measuredForce)
        robotware = self.robotware or _flavour(message, force_is_rw7)
        in_radians = robotware == "6.06"
        research = message.researchState if message.HasField("researchState") else None
        rapid = message.rapidFromRobot if message.HasField("rapidFromRobot") else None
        qd, tau, tau_source = self._motion(message, research, data)
        external = self._read_external(feedback.externalJoints)
        q = self._axes.joints(self._read_joints(feedback.joints), external)
        absent, n = self._absent, self._axes.n
        if not isfinite(sum(q) + (sum(qd) if qd else 0.0)):
            raise Refused("not finite", f"joints {q}, velocities {qd}")
        pose = read_pose(feedback.cartesian)
        matrix = NO_POSE if pose is None else pose_values(pose)
        numbers = self._pack(*q, *self._planned(message.planned), *(qd or absent), *(tau or absent), *matrix, *force)
        values = np.frombuffer(numbers) * (self._scale_of_radians if in_radians else self._scale)
        values.setflags(write=False)
        time = feedback.time
        return Packet(  # in the order of its fields: keywords would cost another half microsecond
            header.seqno,
            header.tm if header.HasField("tm") else None,
            _nanoseconds(time.sec, time.usec),
            values[:n],
            values[n : 2 * n],
            self._q_ext(external, in_radians) if len(external) > self._axes.tail else _EMPTY,
            values[2 * n : 3 * n] if qd else None,
            values[3 * n : 4 * n] if tau else None,
            tau_source,
            values[-22:-6].reshape(4, 4),
            values[-6:],
            read_state(message.motorState),
            read_state(message.mciState),
            read_state(message.rapidExecState),
            message.mciConvergenceMet,
            message.utilizationRate if message.HasField("utilizationRate") else nan,
            robotware,
            np.array(rapid.dnum[:]) if rapid else _EMPTY,
            rapid.digVal if rapid else False,
            research.tNs if research else 0,
            research.queueDepth if research else -1,
        )

    def _planned(self, planned: Any) -> tuple[float, ...]:
        try:
            return self._axes.joints(self._read_joints(planned.joints), self._read_external(planned.externalJoints))
        except Refused:
            return self._absent

    def _motion(
        self, message: Any, research: Any, data: bytes
    ) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None, str]:
        """Return qd, tau and the source of tau: the extension, else torqueRef, else none."""
        axes, qd = self._axes, None
        if research:
            velocities, torques = research.jointVel, research.torqueMeas
            if len(velocities) == len(torques) == self._read_array.size:
                qd, tau = self._read_array.unpack(velocities), self._read_array.unpack(torques)
            else:  # one is absent, or not packed
                whole = pb.EgmRobot.FromString(data).researchState
                qd, tau = whole.jointVel[:], whole.torqueMeas[:]
            is_kinematic = research.order == _KINEMATIC
            qd, tau = axes.array(qd, is_kinematic), axes.array(tau, is_kinematic)
            if tau is not None:
                return qd, tau, "measured"
        torque = self._read_joints(message.torqueRef) if message.torqueRef else ()
        if len(torque) == axes.head:
            # ABB's message holds six values: the seventh axis has none.
            return qd, axes.kinematic((*torque, *[nan] * axes.tail)), "reference"
        return qd, None, "none"

    def _q_ext(self, external: Sequence[float], in_radians: bool) -> np.ndarray:
        if not isfinite(sum(external)):
            raise Refused("not finite", f"external axes {external}")
        q_ext = np.array(external[self._axes.tail :]) * (1.0 if in_radians else RADIAN)
        q_ext.flags.writeable = False
        return q_ext


class _Reply:
    """One EgmSensor kept and refilled, with handles on its arrays: half the time of building it anew."""

    def __init__(self, axes: AxisMap, extension: bool, speed: bool) -> None:
        self._axes = axes
        self._sensor = sensor = pb.EgmSensor()
        self._header = sensor.header
        self._header.mtype = _CORRECTION
        self._research = sensor.researchRef if extension else None
        if self._research is not None:
            self._research.order = _KINEMATIC
        self._arrays = [self._handles(motion) for motion in (sensor.planned, sensor.speedRef)[: 1 + speed]]

    def _handles(self, motion: Any) -> tuple[Any, Any]:
        """Return the arrays of joints and of external joints, with their final lengths."""
        motion.joints.joints.extend([0.0] * self._axes.head)
        if self._axes.tail:
            motion.externalJoints.joints.extend([0.0] * self._axes.tail)
        return motion.joints.joints, motion.externalJoints.joints if self._axes.tail else None

    def encode(self, ref: Reference) -> bytes:
        header, research, axes = self._header, self._research, self._axes
        header.seqno, header.tm = ref.seq & _UINT32, ref.tm_ms & _UINT32
        for (joints, external), values in zip(self._arrays, ref):  # Reference begins with q, qd
            wire = axes.abb((values / axes.scale).tolist())
            joints[:] = wire[: axes.head]
            for k in range(axes.tail):  # one value, if any: a slice would cost three times as much
                external[k] = wire[axes.head + k]
        if research is not None:
            research.echoSeqno, research.echoTNs = ref.robot_seq & _UINT32, ref.robot_mono_ns & _UINT64
            research.torqueFF[:] = () if ref.tau is None else ref.tau.tolist()
            research.validMask = 0 if ref.tau is None else 1
        return self._sensor.SerializeToString()


def _nanoseconds(seconds: int, microseconds: int) -> int:
    return seconds * 10**9 + microseconds * 1000 if seconds < _MAX_SECONDS and microseconds < 10**9 else 0


def _flavour(message: Any, force_is_rw7: bool) -> str:
    """Return the RobotWare flavour by the fields present (as abb_libegm does it)."""
    feedback = message.feedBack
    newer = ("moveIndex", "collisionInfo", "rapidFromRobot", "torqueRef")
    if force_is_rw7 or feedback.HasField("timeStamp") or any(message.HasField(name) for name in newer):
        return "7"
    if message.HasField("utilizationRate"):
        return "6.10"
    return "6.07" if feedback.HasField("time") else "6.06"
