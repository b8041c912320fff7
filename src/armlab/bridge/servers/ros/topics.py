"""ROS topics of a cell: message types, and `Topics`, which converts rows to messages."""

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
from armlab.robots.urdf.writing import write_urdf

_OTHERS = {
    # Names and order as in ros-industrial/abb_robot_driver_interfaces; constants are not message fields.
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


@cache
def later() -> Any:
    """Return the message types of Iron and later distributions, some of which have changed (rmw_dds_common)."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


_HIGHEST = 232  # larger domain numbers have no UDP port
_LARGEST = {"trajectory_msgs/msg/JointTrajectory": 2**19}  # maximum size of a received message in bytes
_USUAL = 2**17


def domain_number(given: int | None, environment: Mapping[str, str] = os.environ) -> int:
    """Return the given domain; default: ROS_DOMAIN_ID, or 0 if it is unset."""
    text = environment.get("ROS_DOMAIN_ID", "") or "0"
    if given is not None:
        return given
    if not text.isdecimal() or int(text) > _HIGHEST:
        raise ConfigError(f"Expected ROS_DOMAIN_ID from 0 to {_HIGHEST}, got {text!r}. Correct or unset the variable.")
    return int(text)


def type_name(name: str) -> str:
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


def content(name: str, cdr: bytes) -> Any:
    """Return the content of a command message: its `data`, a whole trajectory, or None for an empty message."""
    most = _LARGEST.get(name, _USUAL)
    if len(cdr) > most:
        raise CommandRefused(f"Expected a {name} of at most {most} bytes, got {len(cdr)}.")
    try:
        message = store().deserialize_cdr(cdr, name)
        return message if name in _LARGEST else getattr(message, "data", None)
    except Exception as error:  # the codec's exceptions for invalid bytes are undocumented
        raise CommandRefused(f"Expected a {name}, got {len(cdr)} invalid bytes ({error}).") from None


@dataclass(frozen=True)
class RosTopic:
    """Published topic: full name and ROS 2 type, for example "sensor_msgs/msg/JointState"."""

    name: str
    type: str


@dataclass(eq=False)
class ArmRow:
    """Fields of one arm in a binary row."""

    robot: Robot
    places: Mapping[str, tuple[Struct, int]]  # see `row.places`
    data: bytes
    wall_ns: int

    def __getitem__(self, name: str) -> tuple[Any, ...]:
        """Return the numbers of a field, such as "q"."""
        form, offset = self.places[name]
        return form.unpack_from(self.data, offset)

    def numbers(self, name: str) -> tuple[float, ...]:
        """Return the numbers of a field, or an empty tuple if any number is NaN (missing field)."""
        values = self[name]
        return () if any(map(math.isnan, values)) else values

    @cached_property
    def T_base_tool(self) -> np.ndarray:
        """Tool pose (4, 4) in base axes at the measured joint positions."""
        return kinematics.forward(self.robot, self["q"])

    def in_tool_axes(self, wrench: Sequence[float]) -> tuple[float, ...]:
        """Rotate a wrench (6,) at the tool point from base axes to tool axes."""
        (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = self.T_base_tool.tolist()
        x, y, z, u, v, w = wrench
        return (
            a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z,
            a * u + d * v + g * w, b * u + e * v + h * w, c * u + f * v + i * w,
        )  # fmt: skip


def header(stamp_ns: int, frame_id: str = "") -> Any:
    """Return a std_msgs/msg/Header with a wall-clock time stamp [ns]."""
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
    """Return the message for the first available wrench among the fields."""
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
    """Return the EGM states, whose values start at 1 in the message but at 0 in the row."""
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
"""Topics per arm, published with each row: type and message function, which returns None for missing fields."""

_TF = "tf2_msgs/msg/TFMessage"
_TF_PERIOD_NS = 20_000_000  # ns between messages of /tf


def _frame(stamp_ns: int, parent: str, child: str, T_parent_child: np.ndarray) -> Any:
    types: Mapping[str, Any] = store().types
    w, x, y, z = quaternion.from_matrix(T_parent_child[:3, :3]).tolist()
    vector = types["geometry_msgs/msg/Vector3"](*T_parent_child[:3, 3].tolist())
    transform = types["geometry_msgs/msg/Transform"](vector, types["geometry_msgs/msg/Quaternion"](x, y, z, w))
    return types["geometry_msgs/msg/TransformStamped"](header(stamp_ns, parent), child, transform)


def _fixed_frames(robots: Iterable[Robot]) -> Any:
    """Return the frames of the fixed links, named as in the URDF."""
    found = []
    for robot in robots:
        last, links = (
            f"link_{robot.n}",
            {"mount": robot.T_base_mount, "flange": robot.links[-1], "tool": robot.T_flange_tool},
        )
        for parent, (child, T) in zip(("base", last, "flange"), links.items(), strict=True):
            found.append(_frame(time.time_ns(), f"{robot.name}_{parent}", f"{robot.name}_{child}", T))
    return store().types[_TF](found)


def _moving_frames(arms: Iterable[ArmRow]) -> Any:
    """Return the frames of the moving links, named as in the URDF."""
    found = []
    for arm in arms:
        robot, names = arm.robot, ["mount", *(f"link_{i + 1}" for i in range(arm.robot.n))]
        for i, (q, T) in enumerate(zip(arm.numbers("q"), robot.links)):
            move = np.eye(4)
            if robot.prismatic[i]:
                move[2, 3] = q
            else:
                move[:2, :2] = (math.cos(q), -math.sin(q)), (math.sin(q), math.cos(q))
            found.append(_frame(arm.wall_ns, f"{robot.name}_{names[i]}", f"{robot.name}_{names[i + 1]}", T @ move))
    return store().types[_TF](found)


_ONCE_A_SECOND = {"diagnostics": "diagnostic_msgs/msg/DiagnosticArray", "parameters": "std_msgs/msg/String"}
_PERIOD_NS = 1_000_000_000  # ns between messages of these topics
_MONO = Struct("<q")

Messages = Iterable[tuple[RosTopic, Any]]
"""Topics with their messages (types from `store`)."""


class Topics:
    """Topics of a cell; converts its rows to their messages."""

    latched: dict[str, tuple[RosTopic, Any]]
    """Topics with constant messages, by name; late-joining readers also receive them."""

    def __init__(self, robots: Mapping[str, Robot], schema: RowSchema, tf: bool = False) -> None:
        self.answer = ""
        self._schema, self._robots, self._status = schema, dict(robots), Status(schema)
        self._due, self._tf_due, self._last = 0, 0, b""
        self._silence: tuple[bytes, int] | None = None  # last row, and start of the period without rows
        self._places = {name: places(schema, name) for name in robots}
        self._makers = {f"/{robot}/{name}": (robot, make) for robot in robots for name, (_, make) in TOPICS.items()}
        types = {name: type_ for name, (type_, _) in TOPICS.items()} | _ONCE_A_SECOND
        found = {f"/{robot}/{name}": type_ for robot in robots for name, type_ in types.items()}
        text = store().types["std_msgs/msg/String"]
        urdf = {name: write_urdf(robot, prefix=f"{name}_") for name, robot in robots.items()}
        latched = {f"/{name}/robot_description": text(urdf[name]) for name in robots}
        if tf:
            found["/tf"] = _TF
            latched["/tf_static"] = _fixed_frames(robots.values())
        self.latched = {name: (RosTopic(name, one.__msgtype__), one) for name, one in latched.items()}
        self.published: dict[str, RosTopic] = {name: RosTopic(name, type_) for name, type_ in found.items()}
        self.published |= {name: topic for name, (topic, _) in self.latched.items()}

    def of_row(self, data: bytes, wanted: Collection[str]) -> Iterator[tuple[RosTopic, Any]]:
        """Yield the wanted messages of a row: first those of the arms that the row updates, then those due once per
        second."""
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
        if "/tf" in wanted and arms and mono_ns >= self._tf_due:
            self._tf_due = mono_ns + _TF_PERIOD_NS
            yield self.published["/tf"], _moving_frames(arms.values())
        self._status.add(data)
        self._last = data
        yield from self._once_a_second(mono_ns, 0, wanted)

    def of_silence(self, now_ns: int, wanted: Collection[str]) -> Messages:
        """Return the once-per-second messages that are due while no rows arrive; return no messages if a row has
        arrived since the last call."""
        if self._silence is None or self._silence[0] is not self._last:
            self._silence = self._last, now_ns
            return ()
        silent_ns = now_ns - self._silence[1]
        mono_ns = _MONO.unpack_from(self._last, MONO)[0] if self._last else 0
        return self._once_a_second(mono_ns + silent_ns, silent_ns, wanted)

    def of_parameters(self, parameters: Mapping[str, Mapping[str, Any]], wanted: Collection[str]) -> Messages:
        """Yield the parameter values as JSON for each robot's topic "parameters"."""
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
_SILENT = 1.0  # s without a packet after which an error is reported


def diagnostics(
    robot: str, wall_ns: int, counts: Mapping[str, Any], commander: str, answer: str = "", silent: float = 0.0
) -> Any:
    """Return the diagnostics of one arm; `silent` is the time since its last packet [s] (initially infinite)."""
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


_FAULTS = {"missed": "packets missed", "late": "late replies", "drops": "packets refused"}


def _number(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:.1f}"
