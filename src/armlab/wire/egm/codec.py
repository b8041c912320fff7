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
from armlab.wire.egm.axes import RADIAN, AxisMap, Linkage, Refused
from armlab.wire.egm.details import Details, read_details
from armlab.wire.egm.message_layout import INTEGERS, Numbers, Shape, find_places
from armlab.wire.egm.pose_force import NO_WRENCH, decode_force, pose_from_matrix, read_pose
from armlab.wire.egm.types import Beside, Drop, Packet, Reference, RobotAxes

_CORRECTION, _PATH_CORRECTION = 3, 4
_KINEMATIC = 1
_GAINS = 0b11000  # posGainScale and velGainScale are valid
_INTEGERS = ("header.seqno", "header.tm", "researchRef.echoSeqno", "researchRef.echoTNs")
_UINT32, _UINT64 = 2**32 - 1, 2**64 - 1
_TWIST = np.array([1e-3, 1e-3, 1e-3, RADIAN, RADIAN, RADIAN])


class Replies:
    """Joint references as bytes: one template per kind of reply, with the numbers written into it."""

    def __init__(self, axes: AxisMap, extension: bool) -> None:
        self._axes, self._extension = axes, extension
        self._names = _INTEGERS if extension else _INTEGERS[:2]
        self._writers: dict[tuple[bool, ...], kernels.EgmWriter] = {}

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of an EgmSensor.

        `ref`: finite values.
        """
        q, qd, tau, seq, tm_ms, robot_seq, mono, free, beside = ref
        if beside is not None:
            return self._serialised(ref)
        kind = qd is None, tau is None, free
        sent = tau if self._extension else None
        arrays = (q,) if qd is None else (q, qd)
        arrays = arrays if sent is None else (*arrays, sent)
        integers = (seq & _UINT32, tm_ms & _UINT32, robot_seq & _UINT32, mono & _UINT64)[: len(self._names)]
        writer = self._writers.get(kind)
        data = None if writer is None else writer.write(arrays, integers)
        if data is None:
            data = self._serialised(ref)
            self._learn(kind, data, ref)
        return data

    def _learn(self, kind: tuple[bool, ...], data: bytes, ref: Reference) -> None:
        """Keep the bytes of a reply as the example of those of its kind."""
        places = find_places(data, pb.EgmSensor.DESCRIPTOR)
        if places is None:
            return
        axes, doubles = self._axes, places.doubles
        motions = ("planned", "speedRef")[: 1 if ref.qd is None else 2]
        offsets = [
            int(at)
            for motion in motions
            for at in axes.kinematic(
                [*doubles.get(f"{motion}.joints.joints", ()), *doubles.get(f"{motion}.externalJoints.joints", ())]
            )
        ]
        torques = doubles.get("researchRef.torqueFF", [])
        divisors = np.concatenate((*[axes.scale] * len(motions), np.ones(len(torques))))
        spans = [places.integers[name] for name in self._names]
        self._writers[kind] = kernels.EgmWriter(data, [*offsets, *torques], divisors, spans)

    def _serialised(self, ref: Reference) -> bytes:
        axes, beside = self._axes, ref.beside or Beside()
        sensor = pb.EgmSensor(header=_header(_CORRECTION, ref.seq, ref.tm_ms))
        motions: list[tuple[Any, np.ndarray, np.ndarray | None]] = [(sensor.planned, ref.q, beside.q_ext)]
        if ref.qd is not None:
            motions.append((sensor.speedRef, ref.qd, beside.qd_ext))
        for motion, values, beyond in motions:
            wire = axes.wire(values, axes.scale)
            external = () if beyond is None else (beyond / axes.external_scale(len(beyond))).tolist()
            motion.joints.joints.extend(wire[: axes.head])
            if axes.tail or external:
                motion.externalJoints.joints.extend((*wire[axes.head :], *external))
        if beside.rapid_data is not None:
            sensor.rapidToRobot.dnum.extend(beside.rapid_data.tolist())
        if beside.rapid_digital is not None:
            sensor.rapidToRobot.digVal = beside.rapid_digital
        if self._extension:
            self._say_more(sensor.researchRef, ref)
        return sensor.SerializeToString()

    def _say_more(self, research: Any, ref: Reference) -> None:
        research.order = _KINEMATIC
        research.echoSeqno, research.echoTNs = ref.robot_seq & _UINT32, ref.robot_mono_ns & _UINT64
        research.torqueFF.extend(() if ref.tau is None else ref.tau.tolist())
        loosened = (0.0,) * self._axes.n if ref.free else ()
        research.posGainScale.extend(loosened)
        research.velGainScale.extend(loosened)
        research.validMask = (ref.tau is not None) | (_GAINS if ref.free else 0)


def encode_pose(T_frame_tool: np.ndarray, twist: np.ndarray | None, seq: int, tm_ms: int) -> bytes:
    """Return the bytes of an EgmSensor that holds a pose; the quaternion, never Euler angles, which would win over it.

    `T_frame_tool`: (4, 4); `twist`: (6,) [v; w] or None.
    """
    sensor = pb.EgmSensor(header=_header(_CORRECTION, seq, tm_ms))
    pose_from_matrix(sensor.planned.cartesian, T_frame_tool)
    if twist is not None:
        sensor.speedRef.cartesians.value.extend((twist / _TWIST).tolist())
    return sensor.SerializeToString()


def encode_path_correction(yz: Sequence[float], age: float, seq: int, tm_ms: int) -> bytes:
    """Return the bytes of an EgmSensorPathCorr.

    `yz`: across the path [m]; `age`: of the measurement [s].
    """
    message = pb.EgmSensorPathCorr(header=_header(_PATH_CORRECTION, seq, tm_ms))
    where = message.pathCorr.pos
    where.x, where.y, where.z = 0.0, 1e3 * yz[0], 1e3 * yz[1]
    message.pathCorr.age = round(1e3 * age) & _UINT32
    return message.SerializeToString()


def _header(mtype: int, seq: int, tm_ms: int) -> Any:
    return pb.EgmHeader(seqno=seq & _UINT32, tm=tm_ms & _UINT32, mtype=mtype)


_DATA = 2
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

    def __init__(self, arm: RobotAxes, extension: bool = False, units: Sequence[str] = ()) -> None:
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
