"""Topics of a recording: columns are mapped to ROS 2 messages, which are encoded by patching templates."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from armlab.log.file_formats.description import distinct
from armlab.log.recording.rows import CODES, COUNTS, FLAGS, REALS, SELDOM, RowLayout, Slot
from armlab.wire import cdr

CLOCK_KEY = "armlab.clock"  # channel metadata: the messages of this channel are the rows of the table
# channel metadata of a column t: name of its clock, and the wall-clock time at t = 0 [ns]
CLOCK_NAME_KEY, T0_KEY = "armlab.clock_name", "armlab.t0_ns"
COLUMN_KEY = "column."  # channel metadata "column.<name>": JSON description of the column <name>

_TICK_NUMBERS = (*(name for name in COUNTS if name != "stamp_ns"), *CODES)  # the message header holds the stamp
_OWN_TYPES = {
    "armlab_msgs/msg/Tick": "std_msgs/Header header\n"
    + "".join(f"int64 {name}\n" for name in _TICK_NUMBERS)
    + "".join(f"float64 {name}\n" for name in REALS)
    + "".join(f"uint8 {name}\n" for name in FLAGS)
    + "uint8[] clamped",
    "armlab_msgs/msg/Column": "std_msgs/Header header\nfloat64[] values",
    "armlab_msgs/msg/Parameter": (
        "builtin_interfaces/Time stamp\nint64 sequence\nstring name\nstring value\nstring who"
    ),
    "armlab_msgs/msg/WrenchEstimate": "std_msgs/Header header\nfloat64[6] wrench\nfloat64[36] covariance",
}
WRENCH_FIELDS = tuple(f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in "xyz")
_ESTIMATE = {"wrench_hat": ("wrench",), "wrench_hat_cov": ("covariance",)}
_RAW = ".wrench_raw"  # suffix, after the source name, of the column with a force sensor's readings in sensor axes
POSE_FIELDS = tuple(f"pose.position.{axis}" for axis in "xyz") + tuple(f"pose.orientation.{axis}" for axis in "xyzw")


@dataclass(frozen=True, slots=True)
class Topic:
    """Topic in a robot's namespace, with the message fields of each column.

    Message fields of `optional` columns may be empty sequences; each message of the topic with `clock` is one row of
    the table.
    """

    name: str
    type: str
    fields: Mapping[str, tuple[str, ...]]
    frame_id: str = ""
    labels: tuple[str, ...] = ()
    optional: frozenset[str] = frozenset()
    clock: bool = False

    def metadata(self, slots: Mapping[str, Slot]) -> dict[str, str]:
        """Return the channel metadata from which any reader can rebuild the columns."""
        data = {CLOCK_KEY: "rows"} if self.clock else {}
        for name, paths in self.fields.items():
            column, missing = slots[name].column, slots[name].missing
            about: dict[str, Any] = {"fields": list(paths), "shape": list(column.shape), "unit": column.unit}
            about |= {"frame": column.frame, "kind": column.kind, "labels": list(column.labels)}
            if missing is not None:
                about["missing"] = missing
            if paths == POSE_FIELDS:  # a user-defined pose is stored as 16 numbers
                about["encoding"] = "position xyz, quaternion xyzw"
            data[COLUMN_KEY + name] = json.dumps(about)
        return data


def topics(layout: RowLayout, joint_names: Sequence[str]) -> list[Topic]:
    """Return the topics for recording one arm, with the clock topic first."""
    labels = tuple(joint_names)
    joints = {
        "joint_states": ("q", "qd", "tau"),
        "joint_states_ref": ("q_ref", "qd_ref", "tau_ref"),
        "joint_states_sent": ("q_sent", "qd_sent", "tau_sent"),
    }
    scalars = (*_TICK_NUMBERS, *REALS, *FLAGS, "clamped")
    found = [
        Topic("tick", "armlab_msgs/msg/Tick", {n: (n,) for n in scalars}, optional=frozenset(["clamped"]), clock=True)
    ]
    for name, columns in joints.items():
        fields = dict(zip(columns, (("position",), ("velocity",), ("effort",)), strict=True))
        found.append(Topic(name, "sensor_msgs/msg/JointState", fields, "", labels, frozenset(columns)))
    found += [
        Topic("wrench", "geometry_msgs/msg/WrenchStamped", {"wrench_raw": WRENCH_FIELDS}, "sensor"),
        Topic("tcp_pose", "geometry_msgs/msg/PoseStamped", {"T_frame_tool": POSE_FIELDS}, "controller"),
        Topic("wrench_hat", "armlab_msgs/msg/WrenchEstimate", _ESTIMATE, "base"),
    ]
    own = [name for name in layout.extra if name not in found[-1].fields]
    found += [column_topic(name) for name in ("q_planned", "q_ext", "wrench", *SELDOM)]
    for name in own:
        source = name.removesuffix(_RAW)
        if source != name and layout.slots[name].size == 6:  # a force sensor with its own source
            topic = f"wrench/{topic_name(source)}"
            found.append(Topic(topic, "geometry_msgs/msg/WrenchStamped", {name: WRENCH_FIELDS}, source))
        else:
            found.append(column_topic(name))
    names = distinct({place: topic.name for place, topic in enumerate(found)})  # columns "a.b" and "a_b" collide
    return [replace(topic, name=names[place]) for place, topic in enumerate(found)]


def column_topic(name: str) -> Topic:
    return Topic(f"columns/{topic_name(name)}", "armlab_msgs/msg/Column", {name: ("values",)})


def clock_metadata(t0_ns: int, clock: str) -> dict[str, str]:
    """Return the metadata of a column `t`: the wall-clock time at t = 0 [ns], and the name of the clock."""
    return {T0_KEY: str(t0_ns), CLOCK_NAME_KEY: clock}


def topic_name(name: str) -> str:
    """Return a name with every character invalid in a ROS topic replaced by ``_``."""
    return re.sub(r"\W", "_", name, flags=re.ASCII) or "_"


@cache
def store() -> Any:
    """Return the known message types of ROS 2 Humble and armlab."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    known = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _OWN_TYPES.items():
        known.register(get_types_from_msg(text, name))
    return known


@cache
def definition(name: str) -> str:
    """Return the ``ros2msg`` schema of a message type, including nested types."""
    return store().generate_msgdef(name, ros_version=2)[0]


def event(stamp_ns: int, text: str) -> bytes:
    """Return an rcl_interfaces/msg/Log message of level INFO."""
    types = store().types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    log = types["rcl_interfaces/msg/Log"](
        stamp=stamp, level=20, name="armlab", msg=_in_utf8(text), file="", function="", line=0
    )
    return bytes(store().serialize_cdr(log, "rcl_interfaces/msg/Log"))


def parameter(stamp_ns: int, sequence: int, name: str, value: Any, who: str) -> bytes:
    """Return an armlab_msgs/msg/Parameter message with its value as JSON."""
    types = store().types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    text = json.dumps(getattr(value, "tolist", lambda: value)())
    words = {"name": _in_utf8(name), "value": text, "who": _in_utf8(who)}
    setting = types["armlab_msgs/msg/Parameter"](stamp=stamp, sequence=sequence, **words)
    return bytes(store().serialize_cdr(setting, "armlab_msgs/msg/Parameter"))


def _in_utf8(text: str) -> str:
    """Escape lone surrogates, which occur in some JSON strings and file names, so they do not stop a recording."""
    return text.encode(errors="backslashreplace").decode()


Plan = tuple[int, bool, list[tuple[int, bytes, bool]], list[tuple[bytes, list[tuple[int, int, int]]]], bool]


def plan(channel: int, topic: Topic, slots: Mapping[str, Slot]) -> Plan:
    """Return the plan of `kernels.RowEncoder` for a topic: message templates from rosbags, and copy operations."""
    held = {name: slots[name] for name in topic.fields}
    columns = [(slot.start, slot.nothing, name in topic.optional) for name, slot in held.items()]
    optional = [name for name in held if name in topic.optional]
    variants = []
    for there in range(1 << len(optional)):
        absent = {name for bit, name in enumerate(optional) if not there >> bit & 1}
        variants.append(_variant(topic, held, absent))
    return channel, topic.clock, columns, variants, "T_frame_tool" in held


def _variant(topic: Topic, slots: Mapping[str, Slot], absent: Set[str]) -> tuple[bytes, list[tuple[int, int, int]]]:
    """Serialise a message with empty sequences for some columns, and locate its numbers."""
    counts = {name: 0 if name in absent else slot.size for name, slot in slots.items()}
    raw = _serialised(topic, counts)
    found = cdr.layout(raw, topic.type, cdr.definitions(topic.type, definition(topic.type)))
    copies = []
    for name, paths in topic.fields.items():
        at = slots[name].start
        for path in paths:
            place = found.field(path)
            if place is None or not counts[name]:
                continue
            copies.append((place.start, at, place.stop - place.start))
            at += place.stop - place.start
    return raw, _merged(copies)


def _merged(copies: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Merge copy operations that are contiguous in the message and in the row."""
    merged: list[tuple[int, int, int]] = []
    for to, start, count in copies:
        if merged and (to, start) == (merged[-1][0] + merged[-1][2], merged[-1][1] + merged[-1][2]):
            merged[-1] = (*merged[-1][:2], merged[-1][2] + count)
        else:
            merged.append((to, start, count))
    return merged


def _serialised(topic: Topic, counts: Mapping[str, int]) -> bytes:
    """Serialise a message with zeros in all fields and sequences of length `counts`."""
    message = blank(topic.type)
    message.header.frame_id = topic.frame_id
    if topic.labels:
        message.name = list(topic.labels)
    for name, paths in topic.fields.items():
        current = getattr(message, paths[0], None) if len(paths) == 1 else None
        if isinstance(current, np.ndarray):
            setattr(message, paths[0], np.zeros(counts[name], dtype=current.dtype))
    return bytes(store().serialize_cdr(message, topic.type))


def blank(name: str) -> Any:
    """Return a message with zeros, empty strings and empty sequences."""
    values = {}
    for field_name, (node, detail) in store().fielddefs[name][1]:
        if int(node) == 2:
            values[field_name] = blank(detail)
        elif int(node) == 1:
            values[field_name] = "" if detail[0] == "string" else 0
        else:
            element, length = detail
            texts = int(element[0]) == 1 and element[1][0] == "string"
            values[field_name] = [""] * length if texts else np.zeros(length, dtype=element[1][0])
    return store().types[name](**values)
