"""What of a row is in the messages of each topic of an arm: `FORMS`, by the name of the topic without the arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from struct import Struct
from typing import Any, NamedTuple

import numpy as np

from armlab import kinematics
from armlab.bridge.servers.ros.types import store
from armlab.lie import quaternion
from armlab.robots import Robot

__all__ = ["Arm", "Columns", "FORMS", "Form", "Kind", "diagnostics", "header"]


class Arm:
    """One arm in one row.

    Parameters
    ----------
    robot : the arm. places : of its fields, see `row.places`. data : the row. wall_ns : its wall clock.
    """

    __slots__ = ("_T_base_tool", "_data", "_places", "robot", "wall_ns")

    def __init__(self, robot: Robot, places: Mapping[str, tuple[Struct, int]], data: bytes, wall_ns: int) -> None:
        self.robot, self.wall_ns = robot, wall_ns
        self._places, self._data = places, data
        self._T_base_tool: np.ndarray | None = None

    def __getitem__(self, name: str) -> tuple[Any, ...]:
        """Return the numbers of a field of the row, named without the robot."""
        form, offset = self._places[name]
        return form.unpack_from(self._data, offset)

    def numbers(self, name: str) -> tuple[float, ...]:
        """Return the numbers of a field, or none when it is not there (one is NaN)."""
        form, offset = self._places[name]
        values = form.unpack_from(self._data, offset)
        if math.isnan(sum(values)) and any(map(math.isnan, values)):  # a sum of infinities is NaN, too
            return ()
        return values

    @property
    def T_base_tool(self) -> np.ndarray:
        """(4, 4) by the measured joints."""
        if self._T_base_tool is None:
            self._T_base_tool = kinematics.forward(self.robot, self["q"])
        return self._T_base_tool

    @property
    def tool_quaternion(self) -> np.ndarray:
        """Orientation of the tool in base axes, w x y z."""
        return quaternion.from_matrix(self.T_base_tool[:3, :3])

    def in_tool_axes(self, wrench: Sequence[float]) -> tuple[float, ...]:
        """Return a wrench of six numbers, of base axes at the tool point, in the axes of the tool."""
        (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = self.T_base_tool.tolist()
        x, y, z, u, v, w = wrench
        return (
            a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z,
            a * u + d * v + g * w, b * u + e * v + h * w, c * u + f * v + i * w,
        )  # fmt: skip

    def covariance_in_tool_axes(self, cov: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) of a wrench in the axes of the tool."""
        both = np.kron(np.eye(2), self.T_base_tool[:3, :3])
        return both.T @ cov @ both


def header(stamp_ns: int, frame_id: str = "") -> Any:
    """Return a std_msgs/msg/Header.

    stamp_ns : wall clock. frame_id : name of the frame.
    """
    types: Mapping[str, Any] = store().types
    stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    return types["std_msgs/msg/Header"](stamp, frame_id)


Columns = tuple[tuple[Any, ...], ...]
"""The numbers of one message in its order, column by column; of one that is absent there are none."""


class Kind(Enum):
    """How the numbers of messages come from the fields of a row."""

    COPIED = "as they are, each field that is there"
    TURNED = "the first field that is there, a wrench, in tool axes"
    POSE = "the pose of the tool"
    OTHER = "some other way"


class Form(NamedTuple):
    """What of a row is in the messages of one topic.

    type : of the messages. kind : how their numbers come from the fields. fields : of the row, by name without the arm.
    message : gives the message of an arm, a stamp [ns] and its numbers; nothing else of a row is in it.
    other : gives the numbers when the kind is no other.
    """

    type: str
    kind: Kind
    fields: tuple[str, ...]
    message: Callable[[Robot, int, Columns], Any]
    other: Callable[[Arm], Columns | None] | None = None

    def columns(self, arm: Arm) -> Columns | None:
        """Return the numbers of a message, None when the row has nothing for it."""
        if self.other is not None:
            return self.other(arm)
        columns = tuple([arm.numbers(name) for name in self.fields])
        if not any(columns):
            return None
        if self.kind is Kind.TURNED:
            return (arm.in_tool_axes(next(filter(None, columns))),)
        return columns if self.kind is Kind.COPIED else (_pose(arm),)


def _joint_state(robot: Robot, stamp_ns: int, columns: Columns) -> Any:
    values = [np.array(column, dtype=float) for column in columns]
    return store().types["sensor_msgs/msg/JointState"](header(stamp_ns), list(robot.ros_joint_names), *values)


def _wrench_stamped(robot: Robot, stamp_ns: int, columns: Columns) -> Any:
    types, (numbers,) = store().types, columns
    vector = types["geometry_msgs/msg/Vector3"]
    both = types["geometry_msgs/msg/Wrench"](vector(*numbers[:3]), vector(*numbers[3:]))
    return types["geometry_msgs/msg/WrenchStamped"](header(stamp_ns, f"{robot.name}_tool"), both)


def _covariance(arm: Arm) -> Columns | None:
    cov = arm.numbers("wrench_hat_cov")
    return (tuple(arm.covariance_in_tool_axes(np.reshape(cov, (6, 6))).ravel().tolist()),) if cov else None


def _multi_array(robot: Robot, stamp_ns: int, columns: Columns) -> Any:
    types = store().types
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return types["std_msgs/msg/Float64MultiArray"](layout, np.array(columns[0], dtype=float))


def _pose(arm: Arm) -> tuple[float, ...]:
    w, x, y, z = arm.tool_quaternion.tolist()
    return (*arm.T_base_tool[:3, 3].tolist(), x, y, z, w)


def _pose_stamped(robot: Robot, stamp_ns: int, columns: Columns) -> Any:
    types, (numbers,) = store().types, columns
    position = types["geometry_msgs/msg/Point"](*numbers[:3])
    pose = types["geometry_msgs/msg/Pose"](position, types["geometry_msgs/msg/Quaternion"](*numbers[3:]))
    return types["geometry_msgs/msg/PoseStamped"](header(stamp_ns, f"{robot.name}_base"), pose)


def _egm(arm: Arm) -> Columns:
    """Return the states of EGM; the message counts from 1 what ABB counts from 0."""
    (converged,), (client,), (motors,), (rapid,) = arm["converged"], arm["mci"], arm["motors"], arm["rapid"]
    return (converged == 1,), (client + 1, motors + 1, rapid + 1), arm["utilization"]


def _egm_state(robot: Robot, stamp_ns: int, columns: Columns) -> Any:
    types, ((converged,), (client, motors, rapid), (utilization,)) = store().types, columns
    channel = types["abb_egm_msgs/msg/EGMChannelState"](
        name=robot.name,
        active=True,
        egm_convergence_met=converged,
        egm_client_state=client,
        motor_state=motors,
        rapid_execution_state=rapid,
        utilization_rate=utilization,
    )
    return types["abb_egm_msgs/msg/EGMState"](header(stamp_ns), [channel])


_JOINTS = "sensor_msgs/msg/JointState", Kind.COPIED
_WRENCH = "geometry_msgs/msg/WrenchStamped", Kind.TURNED
_ARRAY, _EGM = "std_msgs/msg/Float64MultiArray", "abb_egm_msgs/msg/EGMState"
FORMS: Mapping[str, Form] = {
    "joint_states": Form(*_JOINTS, ("q", "qd", "tau"), _joint_state),
    "joint_states_ref": Form(*_JOINTS, ("q_ref", "qd_ref", "tau_ref"), _joint_state),
    "joint_states_sent": Form(*_JOINTS, ("q_sent", "qd_sent", "tau_sent"), _joint_state),
    "wrench": Form(*_WRENCH, ("wrench",), _wrench_stamped),
    "wrench_hat": Form(*_WRENCH, ("wrench_hat",), _wrench_stamped),
    "wrench_hat_covariance": Form(_ARRAY, Kind.OTHER, (), _multi_array, _covariance),
    "force_torque_sensor_broadcaster/wrench": Form(*_WRENCH, ("wrench", "wrench_hat"), _wrench_stamped),
    "tcp_pose": Form("geometry_msgs/msg/PoseStamped", Kind.POSE, ("q",), _pose_stamped),
    "egm_states": Form(_EGM, Kind.OTHER, (), _egm_state, _egm),
}
"""Of every arm."""


_OK, _WARN, _ERROR = 0, 1, 2
_SILENT = 1.0  # s without a packet that are a fault


def diagnostics(
    robot: str, wall_ns: int, counts: Mapping[str, Any], commander: str, answer: str = "", silent: float = 0.0
) -> Any:
    """Return the message of one arm.

    answer : the last to a client, "" for none. silent : s since the last packet; infinite before the first.
    """
    types = store().types
    faults = [f"{counts[name]} {words}" for name, words in _FAULTS.items() if counts[name]]
    is_silent = silent > _SILENT
    link = ("no packet yet" if math.isinf(silent) else f"no packet for {silent:.1f} s") if is_silent else "receiving"
    shown = {
        "link": link,
        "rate [1/s]": _number(0.0 if is_silent else counts["rate"]),
        **{f"round trip {name} [us]": _number(counts[key]) for name, key in _TRIPS.items()},
        **{words: str(counts[name]) for name, words in _FAULTS.items()},
        "clamped samples": str(sum(map(sum, counts["clamps"].values()))),
        "session": str(counts["session"]),
        "commander": commander or "nobody",
        "last answer": answer or "none",
    }
    values = [types["diagnostic_msgs/msg/KeyValue"](key, value) for key, value in shown.items()]
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=_ERROR if is_silent else _WARN if faults else _OK,
        name=f"armlab: {robot}",
        message=", ".join([link] * is_silent + faults) or "every packet answered",
        hardware_id=robot,
        values=values,
    )
    return types["diagnostic_msgs/msg/DiagnosticArray"](header(wall_ns), [status])


_TRIPS = {"p50": "p50", "p99": "p99", "longest": "longest"}
_FAULTS = {"missed": "packets missed", "late": "late answers", "drops": "packets refused"}


def _number(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:.1f}"
