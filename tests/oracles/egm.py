"""EGM datagrams read and written by protobuf and NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from armlab.wire.egm import Drop, Packet, Reference
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import AxisMap, Refused
from armlab.wire.egm.codec import pose_values, read_pose
from armlab.wire.egm.types import Beside

UINT32, UINT64 = 2**32 - 1, 2**64 - 1


def decode_egm(axes: AxisMap, data: bytes, robotware: str = "") -> Packet | Drop:
    """Return the packet of an EgmRobot, or the reason why it is dropped."""
    try:
        return packet(axes, pb.EgmRobot.FromString(data), robotware)
    except DecodeError:
        return Drop("unparsable", f"{len(data)} bytes are no protobuf message")
    except Refused as refused:
        return refused.drop


def packet(axes: AxisMap, message: Any, robotware: str) -> Packet:
    header, feedback, planned, research = message.header, message.feedBack, message.planned, message.researchState
    if not header.HasField("seqno"):
        raise Refused("no header", "a message without a header that has a sequence number")
    if header.mtype != 2:
        raise Refused("wrong type", f"expected message type 2 (data from the robot), got {header.mtype}")
    force, force_is_rw7 = decode_force(message.measuredForce)
    robotware = robotware or flavour(message, force_is_rw7)
    q = np.array(axes.joints(feedback.joints.joints, feedback.externalJoints.joints))
    beyond = np.array(feedback.externalJoints.joints[axes.tail :])
    qd = axes.array(research.jointVel, research.order == 1)
    tau = axes.array(research.torqueMeas, research.order == 1)
    for values in (q, beyond, qd or ()):
        if not np.all(np.abs(values) <= 1e9):
            raise Refused("not finite", "a joint, a velocity or an external axis is no number, or beyond 1e9")
    tau_source = "none" if tau is None else "measured"
    if tau is None and len(message.torqueRef.joints) == axes.head > 0:
        tau, tau_source = axes.kinematic((*message.torqueRef.joints, *[np.nan] * axes.tail)), "reference"
    scale, external_scale = axes.scale, axes.external_scale(len(beyond))
    if robotware == "6.06":
        scale, external_scale = np.ones(axes.n), np.ones(len(beyond))
    try:
        q_planned = np.array(axes.joints(planned.joints.joints, planned.externalJoints.joints))
    except Refused:
        q_planned = np.full(axes.n, np.nan)
    pose, time = read_pose(feedback.cartesian), feedback.time
    is_time = time.sec < 9 * 10**9 and time.usec < 10**9
    with np.errstate(all="ignore"):
        return Packet(
            header.seqno,
            header.tm if header.HasField("tm") else None,
            time.sec * 10**9 + time.usec * 1000 if is_time else 0,
            q * scale,
            q_planned * scale,
            beyond * external_scale,
            None if qd is None else np.array(qd) * axes.scale,
            None if tau is None else np.array(tau),
            tau_source,
            np.full((4, 4), np.nan) if pose is None else np.reshape(pose_values(pose), (4, 4)),
            np.array(force if len(force) == 6 else [np.nan] * 6),
            message.motorState.state,
            message.mciState.state,
            message.rapidExecState.state,
            message.mciConvergenceMet,
            message.utilizationRate if message.HasField("utilizationRate") else np.nan,
            robotware,
            np.array(message.rapidFromRobot.dnum),
            message.rapidFromRobot.digVal,
            research.tNs,
            research.queueDepth if message.HasField("researchState") else -1,
        )


def decode_force(data: bytes) -> tuple[Sequence[float], bool]:
    """Return the values of measuredForce and whether its layout is that of RobotWare 7, by its first tag."""
    kind = {8: pb.EgmForceRw7, 17: pb.EgmForceRw7, 18: pb.EgmForceRw7, 9: pb.EgmForceRw6, 10: pb.EgmForceRw6}
    if data[:1] and data[0] in kind:
        try:
            return kind[data[0]].FromString(data).force, kind[data[0]] is pb.EgmForceRw7
        except DecodeError:
            pass
    return (), False


def flavour(message: Any, force_is_rw7: bool) -> str:
    newer = ("moveIndex", "collisionInfo", "rapidFromRobot", "torqueRef")
    if force_is_rw7 or message.feedBack.HasField("timeStamp") or any(message.HasField(name) for name in newer):
        return "7"
    if message.HasField("utilizationRate"):
        return "6.10"
    return "6.07" if message.feedBack.HasField("time") else "6.06"


def encode_egm(axes: AxisMap, ref: Reference, extension: bool) -> bytes:
    """Return the bytes of an EgmSensor."""
    beside = ref.beside or Beside()
    sensor: Any = pb.EgmSensor(header=pb.EgmHeader(seqno=ref.seq & UINT32, tm=ref.tm_ms & UINT32, mtype=3))
    motions = [(sensor.planned, ref.q, beside.q_ext)]
    motions += [] if ref.qd is None else [(sensor.speedRef, ref.qd, beside.qd_ext)]
    for motion, values, beyond in motions:
        wire = axes.wire(values, axes.scale)
        external = () if beyond is None else beyond / axes.external_scale(len(beyond))
        motion.joints.joints.extend(wire[: axes.head])
        if axes.tail or len(external):
            motion.externalJoints.joints.extend((*wire[axes.head :], *external))
    if beside.rapid_data is not None:
        sensor.rapidToRobot.dnum.extend(beside.rapid_data.tolist())
    if beside.rapid_digital is not None:
        sensor.rapidToRobot.digVal = beside.rapid_digital
    if extension:
        research, loosened = sensor.researchRef, (0.0,) * axes.n if ref.free else ()
        research.order = 1
        research.echoSeqno, research.echoTNs = ref.robot_seq & UINT32, ref.robot_mono_ns & UINT64
        research.torqueFF.extend(() if ref.tau is None else ref.tau.tolist())
        research.posGainScale.extend(loosened)
        research.velGainScale.extend(loosened)
        research.validMask = (ref.tau is not None) | (0b11000 if ref.free else 0)
    return sensor.SerializeToString()
