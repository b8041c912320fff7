"""EGM codec of the bridge, which decodes EgmRobot and encodes EgmSensor and EgmSensorPathCorr.

Degrees, millimetres and milliseconds exist only in this package and in `native/wire/egm.cpp`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, nan, sin, sqrt
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from armlab import kernels
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import RADIAN, AxisMap, Linkage, Refused
from armlab.wire.egm.types import Drop, Packet, Reference, RobotAxes

NO_POSE = (nan,) * 16
"""Matrix elements of a missing pose."""


def pose_values(pose: Sequence[float]) -> tuple[float, ...]:
    """Return the 16 values of a matrix [m] from x, y, z [mm] and u0 (scalar) to u3; `NO_POSE` for a norm near 0."""
    x, y, z, a, b, c, d = pose
    norm = a * a + b * b + c * c + d * d
    if not 1e-12 < norm < 1e12:  # also NaN
        return NO_POSE
    s = 2.0 / norm
    b2, c2, d2 = s * b * b, s * c * c, s * d * d
    bc, bd, cd = s * b * c, s * b * d, s * c * d
    ab, ac, ad = s * a * b, s * a * c, s * a * d
    return (
        1.0 - c2 - d2, bc - ad, bd + ac, 1e-3 * x,
        bc + ad, 1.0 - b2 - d2, cd - ab, 1e-3 * y,
        bd - ac, cd + ab, 1.0 - b2 - c2, 1e-3 * z,
        0.0, 0.0, 0.0, 1.0,
    )  # fmt: skip


def read_pose(pose: Any, euler_wins: bool = False) -> tuple[float, ...] | None:
    """Return x, y, z [mm] and u0 to u3 of an EgmPose, or None if position or orientation is missing."""
    if euler_wins and pose.HasField("pos") and pose.HasField("euler"):
        x, y, z = (0.5 * RADIAN * angle for angle in (pose.euler.x, pose.euler.y, pose.euler.z))
        if not isfinite(x + y + z):
            return pose.pos.x, pose.pos.y, pose.pos.z, nan, nan, nan, nan
        (a, b), (c, d), (e, f) = ((cos(half), sin(half)) for half in (x, y, z))
        turned = a * c * e + b * d * f, b * c * e - a * d * f, a * d * e + b * c * f, a * c * f - b * d * e
        return (pose.pos.x, pose.pos.y, pose.pos.z, *turned)
    if not (pose.HasField("pos") and pose.HasField("orient")):
        return None
    where, turn = pose.pos, pose.orient
    return where.x, where.y, where.z, turn.u0, turn.u1, turn.u2, turn.u3


def pose_from_matrix(pose: Any, T_frame_tool: np.ndarray) -> None:
    """Write a (4, 4) matrix [m] into an EgmPose message: position in mm and the quaternion with u0 >= 0."""
    (r00, r01, r02, x), (r10, r11, r12, y), (r20, r21, r22, z) = T_frame_tool.tolist()[:3]
    pos, orient = pose.pos, pose.orient
    pos.x, pos.y, pos.z = 1e3 * x, 1e3 * y, 1e3 * z
    # Each candidate is 4 u_i times the quaternion; the largest u_i keeps the division well conditioned.
    squares = (1 + r00 + r11 + r22, 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22)
    largest = max(range(4), key=squares.__getitem__)
    candidates = (
        (squares[0], r21 - r12, r02 - r20, r10 - r01),
        (r21 - r12, squares[1], r01 + r10, r02 + r20),
        (r02 - r20, r01 + r10, squares[2], r12 + r21),
        (r10 - r01, r02 + r20, r12 + r21, squares[3]),
    )
    factor = 0.5 / sqrt(squares[largest])
    if candidates[largest][0] < 0:
        factor = -factor
    orient.u0, orient.u1, orient.u2, orient.u3 = (factor * value for value in candidates[largest])


_RW7_TAGS = (
    b"\x08",
    b"\x11",
    b"\x12",
)  # first byte of measuredForce: field 1 bool; field 2 doubles, unpacked or packed
CORRECTION, PATH_CORRECTION = 3, 4  # message types
UINT32 = 2**32 - 1
KINEMATIC = 1  # joint order of the extension
TWIST = np.array([1e-3, 1e-3, 1e-3, RADIAN, RADIAN, RADIAN])  # SI per wire unit
_MAX_SECONDS = 9_000_000_000  # later clocks would overflow int64 nanoseconds and count as absent


class Details(NamedTuple):
    """Additional fields of an EgmRobot, in SI units and kinematic joint order.

    Missing numbers are NaN; other missing fields are None.

    Attributes
    ----------
    q_ext_planned : (k,) the controller's reference for the external axes [rad or m].
    T_frame_planned : (4, 4) the controller's reference pose [m].
    planned_ns : time of the reference, nanoseconds since 1970.
    stamp_ns, planned_stamp_ns : IEEE 1588 timestamps of the feedback and of the reference [ns].
    move_index : index of the RAPID movement.
    collision : whether collision detection has triggered.
    collision_quota : (k,) collision detection quotas, as sent.
    force_control : whether force control is active (RobotWare 7); otherwise the force is the raw sensor reading.
    test_signals : (k,) test signals, as sent.
    tau_total, tau_gravity : (n,) torque of the drives, and its feed-forward part [N m]; research extension.
    current : (n,) motor currents [A]; research extension.
    q_reference, qd_reference : (n,) references of the drives [rad, rad/s]; research extension.
    overruns : number of cycles missed by the controller; research extension.
    arm_id : arm number; research extension.
    mode : 0 off, 1 position, 2 velocity, 3 torque; research extension.
    used_seq : sequence number of the reply used in this cycle; research extension.
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
    """Codec of one arm, which decodes EgmRobot to `Packet` and encodes `Reference` as EgmSensor.

    The RobotWare version is detected from the first packet of a session and kept until `reset`.

    Parameters
    ----------
    arm : RobotAxes
        Robot, with its number of joints, prismatic joints and ABB's axis numbers.
    extension : bool
        Send the research extension (field 101). Received extensions are always decoded.
    units : sequence of str
        "deg" or "mm" on the wire, for each joint in kinematic order and then for each external axis; see `AxisMap`.

    Attributes
    ----------
    capabilities : frozenset of str
        "position", "velocity", "external_axes" and "rapid_data", unless a prismatic joint is among ABB's first six axes
        and `units` is empty. With the extension, also "measured_torque" and, if the position capability is present,
        "torque".
    robotware : str
        RobotWare version of this session; "" before its first packet.
    """

    robotware: str

    def __init__(self, arm: RobotAxes, extension: bool = False, units: Sequence[str] = ()) -> None:
        self._axes, self._linkage = AxisMap(arm, units), Linkage.of(arm)
        axes = self._axes
        self._messages = kernels.EgmMessages(Packet, Drop, axes.order, axes.scale, axes.beyond, extension)
        self.robotware = ""
        moves = ("position", "velocity", "external_axes", "rapid_data") if self._axes.can_move else ()
        research = ("measured_torque", "torque") if extension and moves else ("measured_torque",) if extension else ()
        self.capabilities: frozenset[str] = frozenset((*moves, *research))

    def reset(self) -> None:
        """Reset the RobotWare version for a new session."""
        self.robotware = ""

    def decode(self, data: bytes) -> Packet | Drop:
        """Decode a packet, or return the reason for dropping it. Never raises.

        Parameters
        ----------
        data : bytes
            One datagram.
        """
        found = self._messages.read(data, self.robotware)
        if type(found) is Drop:
            return found
        self.robotware = found.robotware
        return found if self._linkage is None else self._linkage.from_axes(found)

    def details(self, data: bytes) -> Details | None:
        """Return the fields of a datagram that `Packet` does not contain, or None for an invalid datagram. Never
        raises.

        Parameters
        ----------
        data : bytes
            One datagram.
        """
        try:
            found = _details(self._axes, pb.EgmRobot.FromString(data), self.robotware)
        except (DecodeError, Refused):
            return None
        return found if self._linkage is None else self._linkage.from_axes(found)

    def encode(self, ref: Reference) -> bytes:
        """Encode a joint reference as EgmSensor.

        Parameters
        ----------
        ref : Reference
            Reference with finite values, which the bridge has checked.
        """
        return self._messages.write(ref if self._linkage is None else self._linkage.to_axes(ref))

    def encode_pose(self, T_frame_tool: np.ndarray, twist: np.ndarray | None, seq: int, tm_ms: int) -> bytes:
        """Encode a pose reference as EgmSensor, for `EGMRunPose`.

        The orientation is sent only as a quaternion, because Euler angles would override the quaternion.

        Parameters
        ----------
        T_frame_tool : ndarray, shape (4, 4), m
            Pose in the frame activated by RAPID.
        twist : ndarray, shape (6,), m/s and rad/s, or None
            Speed of the pose, [v; w].
        seq, tm_ms : int
            As in `Reference`.
        """
        sensor = pb.EgmSensor(header=_header(CORRECTION, seq, tm_ms))
        pose_from_matrix(sensor.planned.cartesian, T_frame_tool)
        if twist is not None:
            sensor.speedRef.cartesians.value.extend((twist / TWIST).tolist())
        return sensor.SerializeToString()

    def encode_path_correction(self, yz: Sequence[float], age: float, seq: int, tm_ms: int) -> bytes:
        """Encode an EgmSensorPathCorr, for `EGMMoveL` and `EGMMoveC`; at most one message per 24 ms takes effect.

        Parameters
        ----------
        yz : sequence of 2 floats, m
            Correction normal to the path in the sensor's tool frame; a correction along the path has no effect.
        age : float, s
            Age of the measurement.
        seq, tm_ms : int
            As in `Reference`.
        """
        message = pb.EgmSensorPathCorr(header=_header(PATH_CORRECTION, seq, tm_ms))
        where = message.pathCorr.pos
        where.x, where.y, where.z = 0.0, 1e3 * yz[0], 1e3 * yz[1]
        message.pathCorr.age = round(1e3 * age) & UINT32
        return message.SerializeToString()


def _header(mtype: int, seq: int, tm_ms: int) -> Any:
    return pb.EgmHeader(seqno=seq & UINT32, tm=tm_ms & UINT32, mtype=mtype)


def _details(axes: AxisMap, message: Any, robotware: str) -> Details:
    planned, research, info = message.planned, message.researchState, message.collisionInfo
    beyond = planned.externalJoints.joints[axes.tail :]
    scale = np.ones(len(beyond)) if robotware == "6.06" else axes.external_scale(len(beyond))
    is_kinematic = research.order == KINEMATIC
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
    if data[:1] not in _RW7_TAGS:
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
