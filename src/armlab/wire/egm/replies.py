"""What goes to the robot: EgmSensor with joints or with a pose, EgmSensorPathCorr."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import RADIAN, AxisMap
from armlab.wire.egm.pose import pose_from_matrix
from armlab.wire.egm.types import Beside, Reference

__all__ = ["Replies", "encode_path_correction", "encode_pose"]

_CORRECTION, _PATH_CORRECTION = 3, 4
_KINEMATIC = 1
_GAINS = 0b11000  # posGainScale and velGainScale are valid
_UINT32, _UINT64 = 2**32 - 1, 2**64 - 1
_TWIST = np.array([1e-3, 1e-3, 1e-3, RADIAN, RADIAN, RADIAN])


class Replies:
    """Joint references to bytes. An EgmSensor of each kind is kept and refilled: half the time of building it anew.

    Parameters
    ----------
    axes : order and units. extension : send the research extension.
    """

    def __init__(self, axes: AxisMap, extension: bool) -> None:
        self._axes, self._extension = axes, extension
        self._with_speed = _Reply(axes, extension, speed=True)
        self._without_speed = _Reply(axes, extension, speed=False)
        self._others: dict[tuple[bool, int, bool], _Reply] = {}  # with external axes: (speed, how many, their speed)

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of an EgmSensor.

        Parameters
        ----------
        ref : finite values.
        """
        if ref.beside is not None:
            return self._with_more(ref, ref.beside)
        return self._without_speed.encode(ref) if ref.qd is None else self._with_speed.encode(ref)

    def _with_more(self, ref: Reference, beside: Beside) -> bytes:
        """Return the bytes of an EgmSensor with references of external axes and data for RAPID."""
        kind = ref.qd is not None, 0 if beside.q_ext is None else len(beside.q_ext), beside.qd_ext is not None
        if kind not in self._others:
            speed, count, speed_beyond = kind
            self._others[kind] = _Reply(self._axes, self._extension, speed, (count, count * speed_beyond))
        return self._others[kind].encode(ref)


class _Reply:
    """One EgmSensor with handles on its arrays; `beyond`: external axes beyond the robot's, of position and speed."""

    def __init__(self, axes: AxisMap, extension: bool, speed: bool, beyond: tuple[int, int] = (0, 0)) -> None:
        self._axes = axes
        self._scale = axes.external_scale(beyond[0])
        self._zeros = (0.0,) * axes.n
        self._sensor = sensor = pb.EgmSensor()
        self._header = sensor.header
        self._header.mtype = _CORRECTION
        self._research = sensor.researchRef if extension else None
        if self._research is not None:
            self._research.order = _KINEMATIC
        motions = (sensor.planned, sensor.speedRef)[: 1 + speed]
        self._arrays = [self._handles(motion, count) for motion, count in zip(motions, beyond)]

    def _handles(self, motion: Any, beyond: int) -> tuple[Any, Any]:
        """Return the arrays of joints and of external joints, with their final lengths."""
        external = self._axes.tail + beyond
        motion.joints.joints.extend([0.0] * self._axes.head)
        if external:
            motion.externalJoints.joints.extend([0.0] * external)
        return motion.joints.joints, motion.externalJoints.joints if external else None

    def encode(self, ref: Reference) -> bytes:
        header, research, axes = self._header, self._research, self._axes
        header.seqno, header.tm = ref.seq & _UINT32, ref.tm_ms & _UINT32
        for (joints, external), values in zip(self._arrays, ref):  # Reference begins with q, qd
            wire = axes.abb((values / axes.scale).tolist())
            joints[:] = wire[: axes.head]
            for k in range(axes.tail):  # one value, if any: a slice would cost three times as much
                external[k] = wire[axes.head + k]
        if ref.beside is not None:
            self._say(ref.beside)
        if research is not None:
            research.echoSeqno, research.echoTNs = ref.robot_seq & _UINT32, ref.robot_mono_ns & _UINT64
            loosened = self._zeros if ref.free else ()
            research.torqueFF[:] = () if ref.tau is None else ref.tau.tolist()
            research.posGainScale[:], research.velGainScale[:] = loosened, loosened
            research.validMask = (ref.tau is not None) | (_GAINS if ref.free else 0)
        return self._sensor.SerializeToString()

    def _say(self, beside: Beside) -> None:
        """Fill in the axes beyond the robot's own, and what goes to RAPID."""
        for (_, external), values in zip(self._arrays, (beside.q_ext, beside.qd_ext)):
            if values is not None:
                external[self._axes.tail :] = (values / self._scale).tolist()
        sensor = self._sensor
        sensor.ClearField("rapidToRobot")
        if beside.rapid_data is not None:
            sensor.rapidToRobot.dnum.extend(beside.rapid_data.tolist())
        if beside.rapid_digital is not None:
            sensor.rapidToRobot.digVal = beside.rapid_digital


def encode_pose(T_frame_tool: np.ndarray, twist: np.ndarray | None, seq: int, tm_ms: int) -> bytes:
    """Return the bytes of an EgmSensor that holds a pose; the quaternion, never Euler angles, which would win over it.

    Parameters
    ----------
    T_frame_tool : (4, 4). twist : (6,) [v; w] or None. seq, tm_ms : as in `Reference`.
    """
    sensor = pb.EgmSensor(header=_header(_CORRECTION, seq, tm_ms))
    pose_from_matrix(sensor.planned.cartesian, T_frame_tool)
    if twist is not None:
        sensor.speedRef.cartesians.value.extend((twist / _TWIST).tolist())
    return sensor.SerializeToString()


def encode_path_correction(yz: Sequence[float], age: float, seq: int, tm_ms: int) -> bytes:
    """Return the bytes of an EgmSensorPathCorr.

    Parameters
    ----------
    yz : across the path [m]. age : of the measurement [s]. seq, tm_ms : as in `Reference`.
    """
    message = pb.EgmSensorPathCorr(header=_header(_PATH_CORRECTION, seq, tm_ms))
    where = message.pathCorr.pos
    where.x, where.y, where.z = 0.0, 1e3 * yz[0], 1e3 * yz[1]
    message.pathCorr.age = round(1e3 * age) & _UINT32
    return message.SerializeToString()


def _header(mtype: int, seq: int, tm_ms: int) -> Any:
    return pb.EgmHeader(seqno=seq & _UINT32, tm=tm_ms & _UINT32, mtype=mtype)
