"""`Topics`: what goes out under which name, made from rows; a topic that nobody reads costs nothing."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from armlab.bridge.ros.arm import Arm, header
from armlab.bridge.ros.diagnostics import diagnostics
from armlab.bridge.ros.types import store
from armlab.bridge.row import read_row
from armlab.bridge.row_schema import RowSchema
from armlab.bridge.status import Status
from armlab.robots import Robot

__all__ = ["Published", "Topics"]

_SELDOM = 1_000_000_000  # ns between two messages of the topics that change seldom


@dataclass(frozen=True)
class Published:
    """A topic that goes out: its full name and its ROS 2 type, for example "sensor_msgs/msg/JointState"."""

    name: str
    type: str


class Topics:
    """The topics of a cell.

    Parameters
    ----------
    robots : the arms by name. schema : of the rows.

    Attributes
    ----------
    published : by full name. answer : to a client that has no other way to learn why it was refused; it goes with the
        diagnostics.
    """

    def __init__(self, robots: Mapping[str, Robot], schema: RowSchema) -> None:
        self.answer = ""
        self._robots, self._schema, self._status = dict(robots), schema, Status(schema)
        self._due = 0
        makers = {f"/{robot}/{name}": (robot, type_, make) for robot in robots for name, (type_, make) in _MADE.items()}
        self._makers = {name: (robot, make) for name, (robot, _, make) in makers.items()}
        self._seldom = {f"/{robot}/{name}": type_ for robot in robots for name, type_ in _SELDOM_TYPES.items()}
        found = {name: type_ for name, (_, type_, _) in makers.items()} | self._seldom
        self.published = {name: Published(name, type_) for name, type_ in found.items()}

    def of_row(self, data: bytes, wanted: Collection[str]) -> Iterator[tuple[Published, Any]]:
        """Yield the messages of a row: of the arm that it is the row of, and of those topics only.

        Parameters
        ----------
        data : one row, of the schema. wanted : full names.

        Yields
        ------
        The topic and a message object of `ros.store`. A topic the row has no number for has no message.

        Raises
        ------
        LinkError : no row of this schema.
        """
        row = read_row(self._schema, data)
        self._status.add(data)
        arms = {name: Arm(robot, row) for name, robot in self._robots.items() if row.values[f"{name}.fresh"]}
        for name in wanted:
            robot, make = self._makers.get(name, ("", None))
            if make is None or robot not in arms:
                continue
            message = make(arms[robot])
            if message is not None:
                yield self.published[name], message
        if row.mono_ns >= self._due:
            self._due = row.mono_ns + _SELDOM
            commanders = {name: row.values[f"{name}.commander"] for name in self._robots}
            yield from self._diagnostics(row.wall_ns, commanders, wanted)

    def of_parameters(
        self, parameters: Mapping[str, Mapping[str, Any]], wanted: Collection[str]
    ) -> Iterator[tuple[Published, Any]]:
        """Yield the values of all parameters in force as JSON text, for each robot's "parameters".

        Parameters
        ----------
        parameters : see `LoopEnd.parameters`. wanted : full names.
        """
        text = json.dumps({name: about["value"] for name, about in parameters.items()})
        message = store().types["std_msgs/msg/String"](text)
        for name in (f"/{robot}/parameters" for robot in self._robots):
            if name in wanted:
                yield self.published[name], message

    def _diagnostics(
        self, wall_ns: int, commanders: Mapping[str, str], wanted: Collection[str]
    ) -> Iterator[tuple[Published, Any]]:
        names = [robot for robot in self._robots if f"/{robot}/diagnostics" in wanted]
        if names:
            arms = self._status.summary()["arms"]
            for robot in names:
                message = diagnostics(robot, wall_ns, arms[robot], commanders[robot], self.answer)
                yield self.published[f"/{robot}/diagnostics"], message


def _joints(*columns: str) -> Callable[[Arm], Any]:
    def make(arm: Arm) -> Any:
        values = [arm.numbers(name) for name in columns]
        if not any(map(len, values)):
            return None
        return store().types["sensor_msgs/msg/JointState"](header(arm.wall_ns), arm.joint_names, *values)

    return make


def _wrench(*columns: str) -> Callable[[Arm], Any]:
    """Return the maker of the wrench of the first of these columns that is there, in tool axes."""

    def make(arm: Arm) -> Any:
        wrench = next((values for name in columns if len(values := arm.numbers(name))), None)
        if wrench is None:
            return None
        types, numbers = store().types, arm.in_tool_axes(wrench).tolist()
        vector = types["geometry_msgs/msg/Vector3"]
        both = types["geometry_msgs/msg/Wrench"](vector(*numbers[:3]), vector(*numbers[3:]))
        return types["geometry_msgs/msg/WrenchStamped"](header(arm.wall_ns, f"{arm.robot.name}_tool"), both)

    return make


def _covariance(arm: Arm) -> Any:
    cov = arm.numbers("wrench_hat_cov")
    if not len(cov):
        return None
    types = store().types
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return types["std_msgs/msg/Float64MultiArray"](layout, arm.covariance_in_tool_axes(cov).ravel())


def _pose(arm: Arm) -> Any:
    if not len(arm.numbers("q")):
        return None
    types = store().types
    w, x, y, z = arm.tool_quaternion.tolist()
    position = types["geometry_msgs/msg/Point"](*arm.T_base_tool[:3, 3].tolist())
    pose = types["geometry_msgs/msg/Pose"](position, types["geometry_msgs/msg/Quaternion"](x, y, z, w))
    return types["geometry_msgs/msg/PoseStamped"](header(arm.wall_ns, f"{arm.robot.name}_base"), pose)


def _egm(arm: Arm) -> Any:
    """Return the states of EGM; the message counts from 1 what ABB counts from 0."""
    types = store().types
    channel = types["abb_egm_msgs/msg/EGMChannelState"](
        name=arm.robot.name,
        active=True,
        egm_convergence_met=arm["converged"] == 1,
        egm_client_state=arm["mci"] + 1,
        motor_state=arm["motors"] + 1,
        rapid_execution_state=arm["rapid"] + 1,
        utilization_rate=arm["utilization"],
    )
    return types["abb_egm_msgs/msg/EGMState"](header(arm.wall_ns), [channel])


_JOINT_STATE, _WRENCH = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"
_MADE: dict[str, tuple[str, Callable[[Arm], Any]]] = {
    "joint_states": (_JOINT_STATE, _joints("q", "qd", "tau")),
    "joint_states_ref": (_JOINT_STATE, _joints("q_ref", "qd_ref", "tau_ref")),
    "joint_states_sent": (_JOINT_STATE, _joints("q_sent", "qd_sent", "tau_sent")),
    "wrench": (_WRENCH, _wrench("wrench")),
    "wrench_hat": (_WRENCH, _wrench("wrench_hat")),
    "wrench_hat_covariance": ("std_msgs/msg/Float64MultiArray", _covariance),
    "force_torque_sensor_broadcaster/wrench": (_WRENCH, _wrench("wrench", "wrench_hat")),
    "tcp_pose": ("geometry_msgs/msg/PoseStamped", _pose),
    "egm_states": ("abb_egm_msgs/msg/EGMState", _egm),
}
_SELDOM_TYPES = {"diagnostics": "diagnostic_msgs/msg/DiagnosticArray", "parameters": "std_msgs/msg/String"}
