"""The bridge's side of EGM: decode EgmRobot, encode EgmSensor and EgmSensorPathCorr.

The only place, with its neighbours in this package and `native/wire/egm.cpp`, where degrees, millimetres and
milliseconds exist. `decode` never raises, whatever the bytes; what is wrong comes back as a `Drop`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from armlab import kernels
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import RADIAN, AxisMap, Linkage, Refused
from armlab.wire.egm.pose_force import NO_POSE, is_layout_of_rw7, pose_from_matrix, pose_values, read_pose
from armlab.wire.egm.types import Drop, Packet, Reference, RobotAxes

_CORRECTION, _PATH_CORRECTION = 3, 4
_UINT32 = 2**32 - 1
_KINEMATIC = 1
_MAX_SECONDS = 9_000_000_000  # a later clock does not fit int64 nanoseconds: it counts as absent
_TWIST = np.array([1e-3, 1e-3, 1e-3, RADIAN, RADIAN, RADIAN])


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


class EgmCodec:
    """EgmRobot to `Packet` and `Reference` to EgmSensor, for one arm.

    The RobotWare flavour is decided on the first packet of a session and kept until `reset`.

    Parameters
    ----------
    arm : RobotAxes
        The robot: number of joints, which are prismatic, ABB's axis numbers.
    extension : bool
        Send the research extension (field 101). It is understood whenever it arrives.
    units : sequence of str
        "deg" or "mm" on the wire, for each joint in kinematic order and then for each external axis; see `AxisMap`.

    Attributes
    ----------
    capabilities : frozenset of str
        "position", "velocity", "external_axes" and "rapid_data", unless a prismatic joint is among ABB's first six axes
        and `units` is empty. "measured_torque" and "torque" with the extension.
    robotware : str
        Flavour of this session, "" before its first packet.
    """

    def __init__(self, arm: RobotAxes, extension: bool = False, units: Sequence[str] = ()) -> None:
        self._axes, self._linkage = AxisMap(arm, units), Linkage.of(arm)
        axes = self._axes
        self._messages = kernels.EgmMessages(Packet, Drop, axes.order, axes.scale, axes.beyond, extension)
        self.robotware = ""
        moves = ("position", "velocity", "external_axes", "rapid_data") if self._axes.can_move else ()
        research = ("measured_torque", "torque") if extension and moves else ("measured_torque",) if extension else ()
        self.capabilities: frozenset[str] = frozenset((*moves, *research))

    def reset(self) -> None:
        """Forget the flavour: a new session begins."""
        self.robotware = ""

    def decode(self, data: bytes) -> Packet | Drop:
        """Return the packet, or why it is dropped. Never raises.

        Parameters
        ----------
        data : bytes
            One datagram.
        """
        found = self._messages.read(data, self.robotware)
        if type(found) is Drop:
            return found
        self.robotware = found.robotware
        return found if self._linkage is None else self._linkage.heard(found)

    def details(self, data: bytes) -> Details | None:
        """Return the fields of a datagram that a `Packet` leaves out, None for invalid datagrams. Never raises.

        Parameters
        ----------
        data : bytes
            One datagram.
        """
        try:
            found = _details(self._axes, pb.EgmRobot.FromString(data), self.robotware)
        except (DecodeError, Refused):
            return None
        return found if self._linkage is None else self._linkage.heard(found)

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of an EgmSensor that holds a joint reference.

        Parameters
        ----------
        ref : Reference
            Finite values; the bridge has checked them.
        """
        return self._messages.write(ref if self._linkage is None else self._linkage.said(ref))

    def encode_pose(self, T_frame_tool: np.ndarray, twist: np.ndarray | None, seq: int, tm_ms: int) -> bytes:
        """Return the bytes of an EgmSensor that holds a pose, for `EGMRunPose`.

        The orientation is a quaternion, never Euler angles, which would win over it.

        Parameters
        ----------
        T_frame_tool : ndarray, shape (4, 4), m
            Pose in the frame that RAPID activated.
        twist : ndarray, shape (6,), m/s and rad/s, or None
            Its speed [v; w].
        seq, tm_ms : int
            As in `Reference`.
        """
        sensor = pb.EgmSensor(header=_header(_CORRECTION, seq, tm_ms))
        pose_from_matrix(sensor.planned.cartesian, T_frame_tool)
        if twist is not None:
            sensor.speedRef.cartesians.value.extend((twist / _TWIST).tolist())
        return sensor.SerializeToString()

    def encode_path_correction(self, yz: Sequence[float], age: float, seq: int, tm_ms: int) -> bytes:
        """Return the bytes of an EgmSensorPathCorr, for `EGMMoveL` and `EGMMoveC`; at most one per 24 ms acts.

        Parameters
        ----------
        yz : sequence of 2 floats, m
            Correction across the path in the sensor's tool frame; along the path none acts.
        age : float, s
            Age of the measurement.
        seq, tm_ms : int
            As in `Reference`.
        """
        message = pb.EgmSensorPathCorr(header=_header(_PATH_CORRECTION, seq, tm_ms))
        where = message.pathCorr.pos
        where.x, where.y, where.z = 0.0, 1e3 * yz[0], 1e3 * yz[1]
        message.pathCorr.age = round(1e3 * age) & _UINT32
        return message.SerializeToString()


def _header(mtype: int, seq: int, tm_ms: int) -> Any:
    return pb.EgmHeader(seqno=seq & _UINT32, tm=tm_ms & _UINT32, mtype=mtype)


def _details(axes: AxisMap, message: Any, robotware: str) -> Details:
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
