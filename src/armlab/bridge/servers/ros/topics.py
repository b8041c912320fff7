"""ROS topics of a cell: message types, and `Topics`, which makes messages from rows."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from struct import Struct
from typing import Any

import numpy as np

from armlab import kinematics
from armlab.bridge.servers.row import MONO, RowSchema, places, read_head, read_row
from armlab.bridge.servers.status import Status
from armlab.errors import CommandRefused, ConfigError
from armlab.lie import quaternion
from armlab.robots import Robot

_OTHERS = {
    # Names and order as in ros-industrial/abb_robot_driver_interfaces; constants are no part of a message.
    "abb_egm_msgs/msg/EGMChannelState": (
        "string name\nbool active\nbool egm_convergence_met\nuint8 egm_client_state\nuint8 motor_state\n"
        "uint8 rapid_execution_state\nfloat64 utilization_rate"
    ),
    "abb_egm_msgs/msg/EGMState": "std_msgs/Header header\nEGMChannelState[] egm_channels",
}


@cache
def store() -> Any:
    """Return the message types with their codecs (a typestore of `rosbags`)."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    known = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _OTHERS.items():
        known.register(get_types_from_msg(text, name))
    return known


_HIGHEST = 232  # beyond it there is no UDP port
_LARGEST = 2**17  # bytes of a message to us


def domain_number(given: int | None, environment: Mapping[str, str] = os.environ) -> int:
    """Return the number of the domain: as given, else that of ROS_DOMAIN_ID, else 0."""
    text = environment.get("ROS_DOMAIN_ID", "") or "0"
    if given is not None:
        return given
    if not text.isdecimal() or int(text) > _HIGHEST:
        raise ConfigError(f"Expected ROS_DOMAIN_ID from 0 to {_HIGHEST}, got {text!r}. Set it, or unset it for 0.")
    return int(text)


def type_name(name: str) -> str:
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


def content(name: str, cdr: bytes) -> Any:
    """Return what a command says: numbers, a text, or None of an empty one."""
    if len(cdr) > _LARGEST:
        raise CommandRefused(f"Expected a {name} of at most {_LARGEST} bytes, got {len(cdr)}.")
    try:
        return getattr(store().deserialize_cdr(cdr, name), "data", None)
    except Exception as error:  # what a codec raises on bytes of others is nowhere listed
        raise CommandRefused(f"Expected a {name}, got {len(cdr)} bytes that are none ({error}).") from None


@dataclass(frozen=True)
class RosTopic:
    """A published topic: its full name and its ROS 2 type, for example "sensor_msgs/msg/JointState"."""

    name: str
    type: str


class ArmRow:
    """The fields of one arm in a row of bytes; `places` says where they are (see `row.places`)."""

    def __init__(self, robot: Robot, places: Mapping[str, tuple[Struct, int]], data: bytes, wall_ns: int) -> None:
        self.robot, self.wall_ns = robot, wall_ns
        self._places, self._data = places, data

    def __getitem__(self, name: str) -> tuple[Any, ...]:
        """Return the numbers of a field, named without the robot."""
        form, offset = self._places[name]
        return form.unpack_from(self._data, offset)

    def numbers(self, name: str) -> tuple[float, ...]:
        """Return the numbers of a field, or none when one of them is NaN: the field is missing."""
        values = self[name]
        return () if any(map(math.isnan, values)) else values

    @cached_property
    def T_base_tool(self) -> np.ndarray:
        """Pose of the tool in the base (4, 4) at the measured joint positions."""
        return kinematics.forward(self.robot, self["q"])

    def in_tool_axes(self, wrench: Sequence[float]) -> tuple[float, ...]:
        """Return a wrench of six numbers, of base axes at the tool point, in the axes of the tool."""
        (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = self.T_base_tool.tolist()
        x, y, z, u, v, w = wrench
        return (
            a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z,
            a * u + d * v + g * w, b * u + e * v + h * w, c * u + f * v + i * w,
        )  # fmt: skip


def header(stamp_ns: int, frame_id: str = "") -> Any:
    """Return a std_msgs/msg/Header with the wall clock [ns]."""
    types: Mapping[str, Any] = store().types
    stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    return types["std_msgs/msg/Header"](stamp, frame_id)


def _joint_state(fields: Sequence[str], arm: ArmRow) -> Any:
    columns = [arm.numbers(name) for name in fields]
    if not any(columns):
        return None
    values = [np.array(column, dtype=float) for column in columns]
    return store().types[_JOINTS](header(arm.wall_ns), list(arm.robot.ros_joint_names), *values)


def _wrench_stamped(fields: Sequence[str], arm: ArmRow) -> Any:
    """Return the first wrench that the row has."""
    wrench = next(filter(None, map(arm.numbers, fields)), None)
    if wrench is None:
        return None
    types, numbers = store().types, arm.in_tool_axes(wrench)
    vector = types["geometry_msgs/msg/Vector3"]
    both = types["geometry_msgs/msg/Wrench"](vector(*numbers[:3]), vector(*numbers[3:]))
    return types[_WRENCH](header(arm.wall_ns, f"{arm.robot.name}_tool"), both)


def _covariance(arm: ArmRow) -> Any:
    cov = arm.numbers("wrench_hat_cov")
    if not cov:
        return None
    types, both = store().types, np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = arm.T_base_tool[:3, :3]
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return types[_ARRAY](layout, (both.T @ np.reshape(cov, (6, 6)) @ both).ravel())


def _pose_stamped(arm: ArmRow) -> Any:
    if not arm.numbers("q"):
        return None
    types, T_base_tool = store().types, arm.T_base_tool
    w, x, y, z = quaternion.from_matrix(T_base_tool[:3, :3]).tolist()
    position = types["geometry_msgs/msg/Point"](*T_base_tool[:3, 3].tolist())
    pose = types["geometry_msgs/msg/Pose"](position, types["geometry_msgs/msg/Quaternion"](x, y, z, w))
    return types[_POSE](header(arm.wall_ns, f"{arm.robot.name}_base"), pose)


def _egm_state(arm: ArmRow) -> Any:
    """Return the states of EGM; the message counts from 1 what ABB counts from 0."""
    types = store().types
    channel = types["abb_egm_msgs/msg/EGMChannelState"](
        name=arm.robot.name,
        active=True,
        egm_convergence_met=arm["converged"] == (1,),
        egm_client_state=arm["mci"][0] + 1,
        motor_state=arm["motors"][0] + 1,
        rapid_execution_state=arm["rapid"][0] + 1,
        utilization_rate=arm["utilization"][0],
    )
    return types[_EGM](header(arm.wall_ns), [channel])


_JOINTS, _WRENCH, _POSE = (
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/WrenchStamped",
    "geometry_msgs/msg/PoseStamped",
)
_ARRAY, _EGM = "std_msgs/msg/Float64MultiArray", "abb_egm_msgs/msg/EGMState"
TOPICS: Mapping[str, tuple[str, Callable[[ArmRow], Any]]] = {
    "joint_states": (_JOINTS, partial(_joint_state, ("q", "qd", "tau"))),
    "joint_states_ref": (_JOINTS, partial(_joint_state, ("q_ref", "qd_ref", "tau_ref"))),
    "joint_states_sent": (_JOINTS, partial(_joint_state, ("q_sent", "qd_sent", "tau_sent"))),
    "wrench": (_WRENCH, partial(_wrench_stamped, ("wrench",))),
    "wrench_hat": (_WRENCH, partial(_wrench_stamped, ("wrench_hat",))),
    "wrench_hat_covariance": (_ARRAY, _covariance),
    "force_torque_sensor_broadcaster/wrench": (_WRENCH, partial(_wrench_stamped, ("wrench", "wrench_hat"))),
    "tcp_pose": (_POSE, _pose_stamped),
    "egm_states": (_EGM, _egm_state),
}
"""Topics of every arm that come with each of its rows: the type, and what makes the message, None without numbers."""

_ONCE_A_SECOND = {"diagnostics": "diagnostic_msgs/msg/DiagnosticArray", "parameters": "std_msgs/msg/String"}
_PERIOD_NS = 1_000_000_000  # between two messages of those topics
_MONO = Struct("<q")

Messages = Iterable[tuple[RosTopic, Any]]
"""Topics with a message of `store` each."""


class Topics:
    """The topics of a cell."""

    def __init__(self, robots: Mapping[str, Robot], schema: RowSchema) -> None:
        self.answer = ""
        self._schema, self._robots, self._status = schema, dict(robots), Status(schema)
        self._due, self._last = 0, b""
        self._silence: tuple[bytes, int] | None = None  # the last row, and since when none came
        self._places = {name: places(schema, name) for name in robots}
        self._makers = {f"/{robot}/{name}": (robot, make) for robot in robots for name, (_, make) in TOPICS.items()}
        types = {name: type_ for name, (type_, _) in TOPICS.items()} | _ONCE_A_SECOND
        found = {f"/{robot}/{name}": type_ for robot in robots for name, type_ in types.items()}
        self.published = {name: RosTopic(name, type_) for name, type_ in found.items()}

    def of_row(self, data: bytes, wanted: Collection[str]) -> Iterator[tuple[RosTopic, Any]]:
        """Yield the wanted messages of a row: those of the arm whose row it is, then those due once a second."""
        _, mono_ns, wall_ns = read_head(self._schema, data)
        arms: dict[str, ArmRow] = {}
        for name, robot in self._robots.items():
            arm = ArmRow(robot, self._places[name], data, wall_ns)
            if arm["fresh"][0]:
                arms[name] = arm
        for name in wanted:
            robot, make = self._makers.get(name, ("", None))
            if make is not None and robot in arms and (message := make(arms[robot])) is not None:
                yield self.published[name], message
        self._status.add(data)
        self._last = data
        yield from self._once_a_second(mono_ns, 0, wanted)

    def of_silence(self, now_ns: int, wanted: Collection[str]) -> Messages:
        """Return what is due once a second while no row comes; nothing when a row came since the last call.

        Call it about as often, with any clock that goes on [ns].
        """
        if self._silence is None or self._silence[0] is not self._last:
            self._silence = self._last, now_ns
            return ()
        silent_ns = now_ns - self._silence[1]
        mono_ns = _MONO.unpack_from(self._last, MONO)[0] if self._last else 0
        return self._once_a_second(mono_ns + silent_ns, silent_ns, wanted)

    def of_parameters(self, parameters: Mapping[str, Mapping[str, Any]], wanted: Collection[str]) -> Messages:
        """Yield the values of all parameters (see `LoopEnd.parameters`) as JSON text, for each robot's "parameters"."""
        text = json.dumps({name: about["value"] for name, about in parameters.items()})
        message = store().types["std_msgs/msg/String"](text)
        for name in (f"/{robot}/parameters" for robot in self._robots):
            if name in wanted:
                yield self.published[name], message

    def _once_a_second(self, mono_ns: int, silent_ns: int, wanted: Collection[str]) -> Messages:
        if mono_ns < self._due:
            return ()
        self._due = mono_ns + _PERIOD_NS
        names = [robot for robot in self._robots if f"/{robot}/diagnostics" in wanted]
        return self._diagnostics(names, mono_ns, silent_ns) if names else ()

    def _diagnostics(self, names: list[str], mono_ns: int, silent_ns: int) -> Messages:
        row, arms = read_row(self._schema, self._last) if self._last else None, self._status.summary()["arms"]
        wall_ns = time.time_ns() if row is None else row.wall_ns + silent_ns
        for robot in names:
            commander = "" if row is None or silent_ns > _PERIOD_NS else row.values[f"{robot}.commander"]
            last_ns = arms[robot]["last_ns"]
            silent = math.inf if last_ns is None else 1e-9 * (mono_ns - last_ns)
            message = diagnostics(robot, wall_ns, arms[robot], commander, self.answer, silent)
            yield self.published[f"/{robot}/diagnostics"], message


_OK, _WARN, _ERROR = 0, 1, 2
_SILENT = 1.0  # s without a packet that are a fault


def diagnostics(
    robot: str, wall_ns: int, counts: Mapping[str, Any], commander: str, answer: str = "", silent: float = 0.0
) -> Any:
    """Return the message of one arm; `silent`: s since its last packet, infinite before the first."""
    types = store().types
    faults = [f"{counts[name]} {words}" for name, words in _FAULTS.items() if counts[name]]
    is_silent = silent > _SILENT
    link = ("no packet yet" if math.isinf(silent) else f"no packet for {silent:.1f} s") if is_silent else "receiving"
    shown = {
        "link": link,
        "rate [1/s]": _number(0.0 if is_silent else counts["rate"]),
        **{f"round trip {name} [us]": _number(counts[name]) for name in ("p50", "p99", "longest")},
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


_FAULTS = {"missed": "packets missed", "late": "late answers", "drops": "packets refused"}


def _number(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:.1f}"
