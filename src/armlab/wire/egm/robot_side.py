"""EGM codec of the simulated controller, which encodes EgmRobot and decodes EgmSensor."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from armlab.errors import ConfigError, UnknownName
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import RADIAN, AxisMap, Linkage, Refused
from armlab.wire.egm.codec import (
    CORRECTION,
    KINEMATIC,
    PATH_CORRECTION,
    TWIST,
    UINT32,
    pose_from_matrix,
    pose_values,
    read_pose,
)
from armlab.wire.egm.types import Drop, RobotAxes

ROBOTWARE = ("6.06", "6.07", "6.10", "7")
"""RobotWare versions whose EgmRobot messages are supported."""

MAX_BYTES = 1024
"""Receive buffer size of abb_libegm and abbegm, which silently drop longer messages."""

_WIRE_ARRAYS = {
    "qd": "jointVel",
    "tau": "torqueMeas",
    "tau_total": "torqueRefTotal",
    "tau_gravity": "torqueGravity",
    "current": "motorCurrent",
    "q_reference": "jointPosRef",
    "qd_reference": "jointVelRef",
}

EXTENSION_ARRAYS = tuple(_WIRE_ARRAYS)
"""Names in `RobotMessage` of the EgmRIState arrays, in the order of fields 1 to 7."""

DEFAULT_ARRAYS = EXTENSION_ARRAYS[:4]
"""Arrays sent by default."""

_ANGULAR = ("qd", "q_reference", "qd_reference")
_DATA = 2  # message type


class RobotMessage(NamedTuple):
    """Content of one EgmRobot in SI units, (n,) in kinematic order; None omits a field."""

    seqno: int
    tm_ms: int | None
    q: np.ndarray
    q_planned: np.ndarray | None = None
    robot_ns: int | None = None
    q_ext: Sequence[float] = ()  # rad
    T_frame_tool: np.ndarray | None = None
    motors: int | None = 1
    mci: int | None = 3
    rapid: int | None = 2
    converged: bool | None = False
    utilization: float | None = 0.0  # percent
    wrench_raw: np.ndarray | None = None
    rapid_data: Sequence[float] = ()
    rapid_digital: bool | None = None
    tau_reference: np.ndarray | None = None  # torqueRef (RobotWare 7, ABB axes 1 to 6 only)
    qd: np.ndarray | None = None  # this and the following fields: extension, with the arrays configured in the codec
    tau: np.ndarray | None = None
    tau_total: np.ndarray | None = None
    tau_gravity: np.ndarray | None = None
    current: np.ndarray | None = None
    q_reference: np.ndarray | None = None
    qd_reference: np.ndarray | None = None
    mono_ns: int = 0
    overruns: int = 0
    mode: int = 1
    used_seq: int = 0
    queue_depth: int = 0


class SensorMessage(NamedTuple):
    """Decoded EgmSensor or EgmSensorPathCorr in SI units; missing fields are None, and NaN is kept."""

    seqno: int | None
    tm_ms: int | None
    mtype: int  # 3 correction, 4 path correction
    q: np.ndarray | None = None
    qd: np.ndarray | None = None
    T_frame_tool: np.ndarray | None = None
    twist: np.ndarray | None = None
    path_yz: np.ndarray | None = None  # in the tool frame of the sensor [m]
    path_age: float | None = None  # s
    rapid_data: np.ndarray | None = None
    rapid_digital: bool | None = None
    tau: np.ndarray | None = None  # `tau` to `echo_seq`: valid arrays and echoes of the extension
    qd_reference: np.ndarray | None = None
    q_reference: np.ndarray | None = None
    gain_q: np.ndarray | None = None
    gain_qd: np.ndarray | None = None
    echo_mono_ns: int | None = None
    echo_seq: int | None = None
    q_ext: np.ndarray | None = None


class RobotSideCodec:
    """Codec of one simulated arm, which encodes `RobotMessage` as EgmRobot and decodes EgmSensor to `SensorMessage`.

    RobotWare 6.06 sends angles in radians. `extension` lists the names of the `EXTENSION_ARRAYS` to send; True selects
    `DEFAULT_ARRAYS`. `force` states whether messages contain `wrench_raw`. `external` and `data` are the numbers of
    external axes and RAPID values.
    """

    def __init__(
        self,
        arm: RobotAxes,
        robotware: str = "6.10",
        extension: bool | Iterable[str] = False,
        *,
        force: bool = False,
        external: int = 0,
        data: int = 0,
    ) -> None:
        if robotware not in ROBOTWARE:
            raise ConfigError(f"Expected robotware to be one of {', '.join(ROBOTWARE)}, got {robotware!r}.")
        self._axes, self._linkage = AxisMap(arm), Linkage.of(arm)
        self._robotware = robotware
        self._arrays = DEFAULT_ARRAYS if extension is True else tuple(extension or ())
        for name in self._arrays:
            if name not in EXTENSION_ARRAYS:
                raise UnknownName.among("array of the extension", name, EXTENSION_ARRAYS)
        self._scale = np.ones(arm.n) if robotware == "6.06" else self._axes.scale
        self._check_size(force, external, data)

    def encode_robot(self, message: RobotMessage) -> bytes:
        """Encode one EgmRobot. Fields unknown to the RobotWare version are omitted."""
        if self._linkage is not None:
            message = self._linkage.to_axes(message)
        robot = pb.EgmRobot()
        header = robot.header
        header.seqno, header.mtype = message.seqno & UINT32, _DATA
        if message.tm_ms is not None:
            header.tm = message.tm_ms & UINT32
        self._motion(robot.feedBack, message.q, message)
        if message.q_planned is not None:
            self._motion(robot.planned, message.q_planned, message)
        for field, value in (
            (robot.motorState, message.motors),
            (robot.mciState, message.mci),
            (robot.rapidExecState, message.rapid),
        ):
            if value is not None:
                field.state = value
        if message.converged is not None:
            robot.mciConvergenceMet = message.converged
        if self._robotware in ("6.10", "7"):
            self._newer_fields(robot, message)
        if self._arrays:
            self._research(robot.researchState, message)
        return robot.SerializeToString()

    def decode_sensor(self, data: bytes) -> SensorMessage | Drop:
        """Decode the sensor's message, or return the reason for dropping it. Never raises an error; NaN values are
        kept."""
        try:
            sensor = pb.EgmSensor.FromString(data)
            header = sensor.header
            if not sensor.HasField("header"):
                return Drop("no header", f"{len(data)} bytes without a header")
            if header.mtype == PATH_CORRECTION:
                return _path_correction(pb.EgmSensorPathCorr.FromString(data))
            if header.mtype != CORRECTION:
                return Drop("wrong type", f"expected message type 3 or 4 (from a sensor), got {header.mtype}")
            found = self._sensor(sensor)
            return found if self._linkage is None else self._linkage.from_axes(found)
        except DecodeError:
            return Drop("unparsable", f"{len(data)} bytes are not a protobuf message")
        except Refused as refused:
            return refused.drop

    def _motion(self, motion: Any, q: np.ndarray, message: RobotMessage) -> None:
        values = self._axes.wire(q, self._scale)
        motion.joints.joints.extend(values[: self._axes.head])
        external_scale = 1.0 if self._robotware == "6.06" else RADIAN
        external = [*values[self._axes.head :], *(value / external_scale for value in message.q_ext)]
        if external:
            motion.externalJoints.joints.extend(external)
        if message.T_frame_tool is not None:
            pose_from_matrix(motion.cartesian, message.T_frame_tool)
        if message.robot_ns is not None and self._robotware != "6.06":
            motion.time.sec, rest = divmod(message.robot_ns, 10**9)
            motion.time.usec = rest // 1000

    def _newer_fields(self, robot: Any, message: RobotMessage) -> None:
        is_rw7 = self._robotware == "7"
        if message.utilization is not None:
            robot.utilizationRate = message.utilization
        if message.wrench_raw is not None:
            force = pb.EgmForceRw7(fcActive=True) if is_rw7 else pb.EgmForceRw6()
            force.force.extend(message.wrench_raw.tolist())
            robot.measuredForce = force.SerializeToString()
        if not is_rw7:
            return
        robot.moveIndex = 0
        robot.collisionInfo.collsionTriggered = False
        if message.rapid_digital is not None or len(message.rapid_data):
            robot.rapidFromRobot.digVal = bool(message.rapid_digital)
            robot.rapidFromRobot.dnum.extend(message.rapid_data)
        if message.tau_reference is not None:
            robot.torqueRef.joints.extend(self._axes.abb(message.tau_reference.tolist())[: self._axes.head])

    def _research(self, research: Any, message: RobotMessage) -> None:
        for name in self._arrays:
            values = getattr(message, name)
            if values is not None:
                scaled = values / self._axes.scale if name in _ANGULAR else values
                getattr(research, _WIRE_ARRAYS[name]).extend(scaled.tolist())
        research.tNs, research.overruns, research.mode = message.mono_ns, message.overruns, message.mode
        research.order = KINEMATIC
        research.usedSeqno, research.queueDepth = message.used_seq & UINT32, message.queue_depth

    def _check_size(self, force: bool, external: int, data: int) -> None:
        """Raise an error if the largest message of the configuration exceeds the buffers of other clients."""
        axes = np.full(self._axes.n, 1.0)
        arrays: dict[str, Any] = dict.fromkeys(self._arrays, axes)
        worst = RobotMessage(
            seqno=UINT32,
            tm_ms=UINT32,
            q=axes,
            q_planned=axes,
            robot_ns=2**62,
            q_ext=[1.0] * external,
            T_frame_tool=np.eye(4),
            wrench_raw=np.ones(6) if force else None,
            rapid_data=[1.0] * data,
            rapid_digital=True,
            tau_reference=axes,
            mono_ns=2**62,
            overruns=UINT32,
            used_seq=UINT32,
            queue_depth=UINT32,
            **arrays,
        )
        size = len(self.encode_robot(worst))
        if size > MAX_BYTES:
            spare = ", ".join(reversed(self._arrays)) or "the external axes and the RAPID data"
            raise ConfigError(
                f"Expected messages of at most {MAX_BYTES} bytes, the buffer size of other EGM "
                f"clients, got up to {size} bytes in this configuration. Omit some of {spare}."
            )

    def _sensor(self, sensor: Any) -> SensorMessage:
        header, axes = sensor.header, self._axes
        pose = read_pose(sensor.planned.cartesian, euler_wins=True)
        speed = sensor.speedRef.cartesians.value
        rapid = sensor.rapidToRobot
        beyond = sensor.planned.externalJoints.joints[axes.tail :]
        return SensorMessage(
            seqno=header.seqno if header.HasField("seqno") else None,
            tm_ms=header.tm if header.HasField("tm") else None,
            mtype=header.mtype,
            q=_joints(axes, sensor.planned),
            qd=_joints(axes, sensor.speedRef),
            T_frame_tool=None if pose is None else np.reshape(pose_values(pose), (4, 4)),
            twist=np.multiply(speed, TWIST) if len(speed) == 6 else None,
            rapid_data=np.array(rapid.dnum) if rapid.dnum else None,
            rapid_digital=rapid.digVal if rapid.HasField("digVal") else None,
            q_ext=RADIAN * np.array(beyond) if beyond else None,
            **_research_reference(axes, sensor.researchRef) if sensor.HasField("researchRef") else {},
        )


def _joints(axes: AxisMap, motion: Any) -> np.ndarray | None:
    if motion.joints.joints or motion.externalJoints.joints:
        return np.array(axes.joints(motion.joints.joints[:], motion.externalJoints.joints[:])) * axes.scale
    return None


def _research_reference(axes: AxisMap, research: Any) -> dict[str, Any]:
    fields = (
        ("tau", research.torqueFF, 1.0),
        ("qd_reference", research.velRef, axes.scale),
        ("q_reference", research.posRef, axes.scale),
        ("gain_q", research.posGainScale, 1.0),
        ("gain_qd", research.velGainScale, 1.0),
    )
    found: dict[str, Any] = {"echo_mono_ns": research.echoTNs, "echo_seq": research.echoSeqno}
    for bit, (name, values, scale) in enumerate(fields):
        array = axes.array(values[:], research.order == KINEMATIC) if research.validMask >> bit & 1 else None
        found[name] = None if array is None else np.array(array) * scale
    return found


def _path_correction(message: Any) -> SensorMessage:
    header, correction = message.header, message.pathCorr
    return SensorMessage(
        seqno=header.seqno if header.HasField("seqno") else None,
        tm_ms=header.tm if header.HasField("tm") else None,
        mtype=header.mtype,
        path_yz=1e-3 * np.array([correction.pos.y, correction.pos.z]),
        path_age=1e-3 * correction.age,
    )
