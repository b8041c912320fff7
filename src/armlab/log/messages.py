"""The topics of a recording: which columns go into which ROS 2 message, and the messages as patched templates."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from armlab.log.rows import SELDOM, RowLayout, Slot
from armlab.wire import cdr

__all__ = [
    "CLOCK_KEY", "CLOCK_NAME_KEY", "COLUMN_KEY", "T0_KEY", "Pen", "Topic", "blank", "clock_metadata", "column_topic",
    "definition", "event", "parameter", "store", "topic_name", "topics",
]  # fmt: skip

CLOCK_KEY = "armlab.clock"  # channel metadata: the messages of this channel are the rows of the table
# channel metadata of a column t: whose clock it is, and the wall clock of t = 0 [ns]
CLOCK_NAME_KEY, T0_KEY = "armlab.clock_name", "armlab.t0_ns"
COLUMN_KEY = "column."  # channel metadata "column.<name>": JSON, how to rebuild the column <name>

_TICK_NUMBERS = (
    "tick", "seq", "seq_sent", "session", "missed", "drops", "robot_ns", "receive_ns", "send_ns",
    "step_ns", "motors", "mci", "rapid", "qd_source", "tau_source",
)  # fmt: skip
_TICK_REALS = ("session_t", "dt", "utilization")
_TICK_FLAGS = ("converged", "late")
_OWN_TYPES = {
    "armlab_msgs/msg/Tick": "\n".join(
        [
            "std_msgs/Header header",
            *(f"int64 {name}" for name in _TICK_NUMBERS),
            *(f"float64 {name}" for name in _TICK_REALS),
            *(f"uint8 {name}" for name in _TICK_FLAGS),
            "uint8[] clamped",
        ]
    ),
    "armlab_msgs/msg/Column": "std_msgs/Header header\nfloat64[] values",
    "armlab_msgs/msg/Parameter": (
        "builtin_interfaces/Time stamp\nint64 sequence\nstring name\nstring value\nstring who"
    ),
    "armlab_msgs/msg/WrenchEstimate": "std_msgs/Header header\nfloat64[6] wrench\nfloat64[36] covariance",
}
_WRENCH = tuple(f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in "xyz")
_POSE = tuple(f"pose.position.{axis}" for axis in "xyz") + tuple(f"pose.orientation.{axis}" for axis in "xyzw")


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording.

    Attributes
    ----------
    name : below the robot's, for example "joint_states".
    type : ROS 2 message type.
    fields : column -> dotted names of the message fields that hold it.
    frame_id : of the header. labels : names of the joints, for JointState.
    optional : columns that may be missing from a message, their sequence empty.
    clock : its messages are the rows of the table.
    """

    name: str
    type: str
    fields: Mapping[str, tuple[str, ...]]
    frame_id: str = ""
    labels: tuple[str, ...] = ()
    optional: frozenset[str] = frozenset()
    clock: bool = False

    def metadata(self, slots: Mapping[str, Slot]) -> dict[str, str]:
        """Return the channel metadata from which a reader rebuilds the columns without knowing armlab."""
        data = {CLOCK_KEY: "rows"} if self.clock else {}
        for name, paths in self.fields.items():
            column, missing = slots[name].column, slots[name].missing
            about: dict[str, Any] = {"fields": list(paths), "shape": list(column.shape), "unit": column.unit}
            about |= {"frame": column.frame, "kind": column.kind, "labels": list(column.labels)}
            if missing is not None:
                about["missing"] = missing
            if paths == _POSE:  # a pose of the user's own is kept as its 16 numbers
                about["encoding"] = "position xyz, quaternion xyzw"
            data[COLUMN_KEY + name] = json.dumps(about)
        return data


def topics(layout: RowLayout, joint_names: Sequence[str]) -> list[Topic]:
    """Return the topics of a recording of one arm, the clock first."""
    labels = tuple(joint_names)
    joints = {
        "joint_states": ("q", "qd", "tau"),
        "joint_states_ref": ("q_ref", "qd_ref", "tau_ref"),
        "joint_states_sent": ("q_sent", "qd_sent", "tau_sent"),
    }
    scalars = (*_TICK_NUMBERS, *_TICK_REALS, *_TICK_FLAGS, "clamped")
    found = [
        Topic("tick", "armlab_msgs/msg/Tick", {n: (n,) for n in scalars}, optional=frozenset(["clamped"]), clock=True)
    ]
    for name, columns in joints.items():
        fields = dict(zip(columns, (("position",), ("velocity",), ("effort",)), strict=True))
        found.append(Topic(name, "sensor_msgs/msg/JointState", fields, "", labels, frozenset(columns)))
    found += [
        Topic("wrench", "geometry_msgs/msg/WrenchStamped", {"wrench_raw": _WRENCH}, "sensor"),
        Topic("tcp_pose", "geometry_msgs/msg/PoseStamped", {"T_frame_tool": _POSE}, "controller"),
        Topic(
            "wrench_hat",
            "armlab_msgs/msg/WrenchEstimate",
            {"wrench_hat": ("wrench",), "wrench_hat_cov": ("covariance",)},
            "base",
        ),
    ]
    own = ["q_planned", "q_ext", "wrench", *SELDOM, *(name for name in layout.extra if name not in found[-1].fields)]
    return found + [column_topic(name) for name in own]


def column_topic(name: str) -> Topic:
    """Return the topic of one column by itself."""
    return Topic(f"columns/{topic_name(name)}", "armlab_msgs/msg/Column", {name: ("values",)})


def clock_metadata(t0_ns: int, clock: str) -> dict[str, str]:
    """Return what is written beside a column `t`: the wall clock of t = 0 [ns], and whose clock it is."""
    return {T0_KEY: str(t0_ns), CLOCK_NAME_KEY: clock}


def topic_name(name: str) -> str:
    """Return a name with everything that ROS does not allow in a topic replaced by ``_``."""
    return re.sub(r"\W", "_", name, flags=re.ASCII) or "_"


@cache
def store() -> Any:
    """Return the message types that are known: those of ROS 2 Humble and ours."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    known = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _OWN_TYPES.items():
        known.register(get_types_from_msg(text, name))
    return known


@cache
def definition(name: str) -> str:
    """Return the ``ros2msg`` schema of a message type, the texts of the types it uses included."""
    return store().generate_msgdef(name, ros_version=2)[0]


def event(stamp_ns: int, text: str, level: int = 20) -> bytes:
    """Return an rcl_interfaces/msg/Log message (level 20 is INFO, 30 WARN, 40 ERROR)."""
    types = store().types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    log = types["rcl_interfaces/msg/Log"](
        stamp=stamp, level=level, name="armlab", msg=text, file="", function="", line=0
    )
    return bytes(store().serialize_cdr(log, "rcl_interfaces/msg/Log"))


def parameter(stamp_ns: int, sequence: int, name: str, value: Any, who: str) -> bytes:
    """Return an armlab_msgs/msg/Parameter message, its value as JSON."""
    types = store().types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    text = json.dumps(getattr(value, "tolist", lambda: value)())
    setting = types["armlab_msgs/msg/Parameter"](stamp=stamp, sequence=sequence, name=name, value=text, who=who)
    return bytes(store().serialize_cdr(setting, "armlab_msgs/msg/Parameter"))


@dataclass(slots=True)
class _Template:
    """A serialised message whose stamp and numbers are patched: pairs of places (in the message, in the row)."""

    buffer: bytearray
    view: memoryview
    copies: list[tuple[int, int, int, int]] = field(default_factory=list)


class Pen:
    """Writes the messages of one topic: serialised once by rosbags, then patched from the bytes of a row.

    Parameters
    ----------
    topic : what to write.
    slots : where its columns are in a row.
    """

    def __init__(self, topic: Topic, slots: Mapping[str, Slot]) -> None:
        self.topic = topic
        self._slots = {name: slots[name] for name in topic.fields}
        self._variants: dict[tuple[bool, ...], _Template] = {}
        self._places = [(slot.start, slot.stop, slot.nothing) for slot in self._slots.values()]
        self._pose = self._slots.get("T_frame_tool")

    def message(self, row: bytes, stamp_ns: int) -> bytearray | None:
        """Return the message of a row, valid until the next call; None when the row has none of its columns."""
        present = tuple([row[start:stop] not in (nothing, b"") for start, stop, nothing in self._places])
        if not (self.topic.clock or any(present)):
            return None
        template = self._variants.get(present)
        if template is None:
            template = self._variants[present] = self._build(row, present)
        struct.pack_into("<iI", template.buffer, 4, stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
        view = template.view
        if self._pose:
            view[template.copies[0][0] : template.copies[-1][1]] = _pose_bytes(row, self._pose)
            return template.buffer
        for start, stop, first, last in template.copies:
            view[start:stop] = row[first:last]
        return template.buffer

    def _build(self, row: bytes, present: tuple[bool, ...]) -> _Template:
        """Serialise a message with the sequences of this variant and find its numbers."""
        counts = {}
        for (name, slot), there in zip(self._slots.items(), present, strict=True):
            counts[name] = slot.size if there or name not in self.topic.optional else 0
        raw = _serialised(self.topic, counts)
        found = cdr.layout(raw, self.topic.type, cdr.definitions(self.topic.type, definition(self.topic.type)))
        buffer = bytearray(raw)
        template = _Template(buffer, memoryview(buffer))
        for name, paths in self.topic.fields.items():
            at = self._slots[name].start
            for path in paths:
                place = found.field(path)
                if place is None or not counts[name]:
                    continue
                width = place.stop - place.start
                template.copies.append((place.start, place.stop, at, at + width))
                at += width
        template.copies = _merged(template.copies)
        return template


def _merged(copies: list[tuple[int, int, int, int]]) -> list[tuple[int, int, int, int]]:
    """Join copies that continue each other in the message and in the row."""
    merged: list[tuple[int, int, int, int]] = []
    for copy in copies:
        if merged and merged[-1][1] == copy[0] and merged[-1][3] == copy[2]:
            merged[-1] = (merged[-1][0], copy[1], merged[-1][2], copy[3])
        else:
            merged.append(copy)
    return merged


def _serialised(topic: Topic, counts: Mapping[str, int]) -> bytes:
    """Return a message of the topic with zeros, its sequences as long as `counts` says."""
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
    """Return a message of a type with zeros and with empty texts and sequences of numbers or texts."""
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


def _pose_bytes(row: bytes, slot: Slot) -> bytes:
    """Return position xyz and quaternion xyzw of a pose in a row; w is not negative."""
    r = struct.unpack_from("<16d", row, slot.start)
    # Shepperd's method: divide by the largest of the four components
    trace = r[0] + r[5] + r[10]
    squares = (r[0] - r[5] - r[10], r[5] - r[0] - r[10], r[10] - r[0] - r[5], trace)
    largest = max(range(4), key=squares.__getitem__)
    big = (1.0 + squares[largest]) ** 0.5 / 2.0
    s = 0.25 / big
    xy, xz, yz = r[4] + r[1], r[8] + r[2], r[9] + r[6]
    xw, yw, zw = r[9] - r[6], r[2] - r[8], r[4] - r[1]
    x, y, z, w = (
        (big, xy * s, xz * s, xw * s),
        (xy * s, big, yz * s, yw * s),
        (xz * s, yz * s, big, zw * s),
        (xw * s, yw * s, zw * s, big),
    )[largest]
    sign = -1.0 if w < 0.0 else 1.0
    return struct.pack("<7d", r[3], r[7], r[11], sign * x, sign * y, sign * z, sign * w)
