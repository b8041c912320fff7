"""`Details`: what an EgmRobot says that a `Packet` leaves out, read on demand: nobody needs it in every cycle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import AxisMap, Refused
from armlab.wire.egm.pose_force import NO_POSE, is_layout_of_rw7, pose_values, read_pose

_KINEMATIC = 1
_MAX_SECONDS = 9_000_000_000  # a later clock does not fit int64 nanoseconds: it counts as absent


class Details(NamedTuple):
    """The rest of one EgmRobot, SI, kinematic joint order. Numbers that were not sent are NaN, others None.

    Attributes
    ----------
    q_ext_planned : (k,) the controller's reference of the external axes. T_frame_planned : (4, 4) its pose.
    planned_ns : clock of the reference, nanoseconds since 1970. stamp_ns, planned_stamp_ns : of the IEEE 1588 clock.
    move_index : of RAPID's movement. collision : it was triggered. collision_quota : (k,) as sent.
    force_control : is active (RobotWare 7), else the force is that of the raw sensor. test_signals : (k,) as sent.
    tau_total, tau_gravity : (n,) torque of the drives, and what they feed forward [N m]. current : (n,) of motors [A].
    q_reference, qd_reference : (n,) references of the drives.
    overruns : cycles that the controller missed. arm_id : its number. mode : 0 off, 1 position, 2 velocity, 3 torque.
    used_seq : number of our reply that acts in this cycle. From `tau_total` on: the research extension.
    """

    q_ext_planned: np.ndarray
    T_frame_planned: np.ndarray
    planned_ns: int | None
    stamp_ns: int | None
    planned_stamp_ns: int | None
    move_index: int | None
    collision: bool | None
    collision_quota: np.ndarray
    force_control: bool | None
    test_signals: np.ndarray
    tau_total: np.ndarray
    tau_gravity: np.ndarray
    current: np.ndarray
    q_reference: np.ndarray
    qd_reference: np.ndarray
    overruns: int | None
    arm_id: int | None
    mode: int | None
    used_seq: int | None


def read_details(axes: AxisMap, data: bytes, robotware: str) -> Details | None:
    """Return the details of a datagram, None for what is no message of this robot. Never raises."""
    try:
        message = pb.EgmRobot.FromString(data)
        return _read(axes, message, robotware)
    except (DecodeError, Refused):
        return None


def _read(axes: AxisMap, message: Any, robotware: str) -> Details:
    planned, research, info = message.planned, message.researchState, message.collisionInfo
    beyond = planned.externalJoints.joints[axes.tail :]
    scale = np.ones(len(beyond)) if robotware == "6.06" else axes.external_scale(len(beyond))
    is_kinematic = research.order == _KINEMATIC
    pose = read_pose(planned.cartesian)

    def array(values: Sequence[float], factor: Any = 1.0) -> np.ndarray:
        found = axes.array(values[:], is_kinematic)
        return _frozen(np.full(axes.n, np.nan) if found is None else np.array(found) * factor)

    def count(name: str) -> int | None:
        return getattr(research, name) if research.HasField(name) else None

    return Details(
        q_ext_planned=_frozen(np.array(beyond) * scale),
        T_frame_planned=_frozen(np.reshape(NO_POSE if pose is None else pose_values(pose), (4, 4))),
        planned_ns=_nanoseconds(planned.time.sec, 1000 * planned.time.usec) if planned.HasField("time") else None,
        stamp_ns=_stamp(message.feedBack),
        planned_stamp_ns=_stamp(planned),
        move_index=message.moveIndex if message.HasField("moveIndex") else None,
        collision=info.collsionTriggered if info.HasField("collsionTriggered") else None,
        collision_quota=_frozen(np.array(info.collDetQuota)),
        force_control=_force_control(message.measuredForce),
        test_signals=_frozen(np.array(message.testSignals.signals)),
        tau_total=array(research.torqueRefTotal),
        tau_gravity=array(research.torqueGravity),
        current=array(research.motorCurrent),
        q_reference=array(research.jointPosRef, axes.scale),
        qd_reference=array(research.jointVelRef, axes.scale),
        overruns=count("overruns"),
        arm_id=count("armId"),
        mode=count("mode"),
        used_seq=count("usedSeqno"),
    )


def _force_control(data: bytes) -> bool | None:
    if not is_layout_of_rw7(data):
        return None
    force = pb.EgmForceRw7.FromString(data)
    return force.fcActive if force.HasField("fcActive") else None


def _stamp(motion: Any) -> int | None:
    return _nanoseconds(motion.timeStamp.sec, motion.timeStamp.nsec) if motion.HasField("timeStamp") else None


def _nanoseconds(seconds: int, nanoseconds: int) -> int | None:
    return seconds * 10**9 + nanoseconds if seconds < _MAX_SECONDS and nanoseconds < 10**12 else None


def _frozen(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array
