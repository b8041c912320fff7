"""What of a row is in the messages of each topic of an arm: `FORMS`, by the name of the topic without the arm."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from armlab.bridge.ros.arm import Arm, header
from armlab.bridge.ros.types import store
from armlab.robots import Robot

__all__ = ["FORMS", "Columns", "Form", "Kind"]

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

    Attributes
    ----------
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
        """Return the numbers of a message, None when the row has nothing for it.

        Parameters
        ----------
        arm : in the row.
        """
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
