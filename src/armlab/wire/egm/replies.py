"""What goes to the robot: EgmSensor with joints or with a pose, EgmSensorPathCorr."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from armlab import kernels
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import RADIAN, AxisMap
from armlab.wire.egm.layout import find_places
from armlab.wire.egm.pose import pose_from_matrix
from armlab.wire.egm.types import Beside, Reference

__all__ = ["Replies", "encode_path_correction", "encode_pose"]

_CORRECTION, _PATH_CORRECTION = 3, 4
_KINEMATIC = 1
_GAINS = 0b11000  # posGainScale and velGainScale are valid
_INTEGERS = ("header.seqno", "header.tm", "researchRef.echoSeqno", "researchRef.echoTNs")
_UINT32, _UINT64 = 2**32 - 1, 2**64 - 1
_TWIST = np.array([1e-3, 1e-3, 1e-3, RADIAN, RADIAN, RADIAN])


class Replies:
    """Joint references to bytes: serialised once for each kind of reply, then written into the bytes of the one before.

    Parameters
    ----------
    axes : order and units. extension : send the research extension.
    """

    def __init__(self, axes: AxisMap, extension: bool) -> None:
        self._axes, self._extension = axes, extension
        self._names = _INTEGERS if extension else _INTEGERS[:2]
        self._writers: dict[tuple[bool, ...], kernels.EgmWriter] = {}

    def encode(self, ref: Reference) -> bytes:
        """Return the bytes of an EgmSensor.

        Parameters
        ----------
        ref : finite values.
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
