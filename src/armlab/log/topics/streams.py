"""Column names for the numbers in ROS messages (joints, wrenches, poses, frames), and streams of columns from topics.

The messages of a topic become fields (N, k) by dotted name (`mcap.decode`), and the fields become columns of a `Table`.
At any nesting depth, a Wrench becomes one column (N, 6), and a Pose or Transform one column of matrices (N, 4, 4). A
JointState becomes position, velocity and effort by joint; all other fields keep their dotted names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armlab.lie import quaternion, se3
from armlab.log.column import Column
from armlab.log.mcap.decode import Decoded
from armlab.wire import cdr

JOINTS = "sensor_msgs/msg/JointState"
JOINT_PARTS = {"position": ("q", "rad"), "velocity": ("qd", "rad/s"), "effort": ("tau", "N m")}
_XYZ = tuple("xyz")
_XYZW = tuple("xyzw")
_TWIST = (*(f"linear.{a}" for a in _XYZ), *(f"angular.{a}" for a in _XYZ))
_SIX = {
    "geometry_msgs/msg/Wrench": ((*(f"force.{a}" for a in _XYZ), *(f"torque.{a}" for a in _XYZ)), "N, N m"),
    "geometry_msgs/msg/Twist": (_TWIST, "m/s, rad/s"),
    "geometry_msgs/msg/Accel": (_TWIST, "m/s^2, rad/s^2"),
}
_POSES = {
    "geometry_msgs/msg/Pose": (*(f"position.{a}" for a in _XYZ), *(f"orientation.{a}" for a in _XYZW)),
    "geometry_msgs/msg/Transform": (*(f"translation.{a}" for a in _XYZ), *(f"rotation.{a}" for a in _XYZW)),
}
_HEADER = "std_msgs/msg/Header"
_MARKED = {JOINTS, _HEADER, "std_msgs/msg/MultiArrayLayout", *_SIX, *_POSES}
_TRANSFORMS = "geometry_msgs/msg/TransformStamped"
_LENGTH = 1e-3  # tolerance on the norm of a quaternion
_BYTES = 64  # longer byte arrays are images, not measurements
_INDEX = re.compile(r"\[[^\]]*\]")


@dataclass(slots=True)
class TopicFields:
    """Names of the numeric fields of one message type, taken from the strings in its messages.

    `parts`: dotted name without indices -> type of a nested message that forms one column. `joints`: prefix of a
    JointState -> lists of joint names. `frames`: dotted name of each frame_id -> name of the frame.
    """

    type: str
    types: cdr.Definitions
    parts: dict[str, str] = field(default_factory=dict)
    joints: dict[str, dict[tuple[str, ...], None]] = field(default_factory=dict)
    frames: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.type in _MARKED:
            self.parts[""] = self.type
        self._find(self.type, "")

    def _find(self, name: str, path: str) -> None:  # the CDR decoder bounds the recursion
        for field_name, description in self.types.get(name, ()):
            inner, *_ = cdr.held(description)
            there = f"{path}.{field_name}" if path else field_name
            if inner in _MARKED or inner == _TRANSFORMS:
                self.parts[there] = inner
            if inner:
                self._find(inner, there)

    def named(self, found: cdr.Layout) -> list[cdr.Field]:
        """Return the fields of a message with joint and frame names in place of indices."""
        pairs, fields = {}, []
        for path, text in found.texts.items():
            if path.endswith("frame_id") and isinstance(text, str):
                self.frames.setdefault(path, text)
            if path.endswith("].child_frame_id"):
                place = path.removesuffix(".child_frame_id")
                if self.parts.get(_INDEX.sub("", place)) == _TRANSFORMS:
                    pairs[place] = f"{place[: place.rindex('[')]}[{found.texts.get(f'{place}.header.frame_id')}>{text}]"
        for one in found.fields:
            if (one.dtype in ("u1", "i1") and one.count > _BYTES) or one.path.endswith(cdr.NO_MEMBER):
                continue
            place = one.path[: one.path.find("]") + 1]
            if place in pairs:
                fields.append(replace(one, path=pairs[place] + one.path[len(place) :]))
            else:
                fields += self._by_joint(one, found)
        return fields

    def _by_joint(self, one: cdr.Field, found: cdr.Layout) -> Sequence[cdr.Field]:
        """Split the fields of a JointState into one field per joint, with the joint name."""
        prefix, _, last = one.path.rpartition(".")
        if last not in JOINT_PARTS or self.parts.get(_INDEX.sub("", prefix)) != JOINTS:
            return [one]
        names = found.texts.get(f"{prefix}.name" if prefix else "name", ())
        if not one.count or not isinstance(names, tuple) or not len(set(names)) == len(names) == one.count:
            return [one]
        self.joints.setdefault(prefix, {})[names] = None
        size = (one.stop - one.start) // one.count
        starts = range(one.start, one.stop, size)
        return [
            replace(one, path=f"{one.path}[{name}]", start=start, stop=start + size, count=1)
            for name, start in zip(names, starts, strict=True)
        ]


def columns_of_fields(
    topic: TopicFields, fields: Mapping[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], dict[str, Column], list[str]]:
    """Convert fields (N, k) to columns by dotted name; also return their descriptions and notes on faults."""
    groups: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    for path, array in fields.items():
        prefix = _whole(topic, path)
        kind = "" if prefix is None else topic.parts[_INDEX.sub("", prefix)]
        if kind in (_HEADER, "std_msgs/msg/MultiArrayLayout"):
            continue
        groups.setdefault((path, "") if prefix is None else (prefix, kind), {})[path] = array
    values: dict[str, np.ndarray] = {}
    columns: dict[str, Column] = {}
    notes: list[str] = []
    for (prefix, kind), parts in groups.items():
        made = _made(topic, prefix, kind, parts, notes)
        for name, (array, column) in made.items():
            values[name], columns[name] = array, column
    return values, columns, notes


def _whole(topic: TopicFields, path: str) -> str | None:
    """Return the shortest prefix of a dotted name that forms one column, or None."""
    dots = [k for k, letter in enumerate(path) if letter == "." and path.count("[", 0, k) == path.count("]", 0, k)]
    for stop in (0, *dots):
        if topic.parts.get(_INDEX.sub("", path[:stop]), _TRANSFORMS) != _TRANSFORMS:
            return path[:stop]
    return None


def _made(
    topic: TopicFields, prefix: str, kind: str, parts: Mapping[str, np.ndarray], notes: list[str]
) -> dict[str, tuple[np.ndarray, Column]]:
    """Return the columns of one nested message or one field."""
    inner = {path[len(prefix) :].lstrip(".") if kind else "": array for path, array in parts.items()}
    if kind == JOINTS:
        return _joint_columns(topic, prefix, inner, notes)
    paths, unit = _SIX.get(kind, (_POSES.get(kind, ()), "1, m"))
    if paths and all(path in inner and inner[path].shape[1] == 1 for path in paths):
        array = np.concatenate([inner[path] for path in paths], axis=1).astype(float, copy=False)
        frame = _frame(topic, prefix)
        if kind in _SIX:
            return {prefix: (array, Column(unit=unit, frame=frame))}
        matrices, lost = _matrices(array)
        if lost:
            notes.append(
                f"{lost} poses of {prefix or 'the message'} are missing: their quaternions do not have unit norm"
            )
        return {prefix: (matrices, Column(unit=unit, frame=frame, kind="pose"))}
    made = {}
    for path, array in parts.items():
        array = array[:, 0] if array.shape[1] == 1 else array
        if array.dtype == np.uint64 and (array > np.iinfo(np.int64).max).any():
            array = array.astype(float)
        column_kind = {"i": "count", "u": "count", "b": "flag"}.get(array.dtype.kind, "real")
        made[path] = (array, Column(unit="1", kind=column_kind))
    return made


def _joint_columns(
    topic: TopicFields, prefix: str, inner: Mapping[str, np.ndarray], notes: list[str]
) -> dict[str, tuple[np.ndarray, Column]]:
    names = list(dict.fromkeys(name for one in topic.joints.get(prefix, ()) for name in one))
    found: dict[str, tuple[np.ndarray, Column]] = {}
    for part, (symbol, unit) in JOINT_PARTS.items():
        name = f"{prefix}.{symbol}" if prefix else symbol
        there = {joint: inner[f"{part}[{joint}]"] for joint in names if f"{part}[{joint}]" in inner}
        if there:
            rows = len(next(iter(there.values())))
            nothing = np.full((rows, 1), np.nan)
            array = np.concatenate([there.get(joint, nothing) for joint in names], axis=1)
            found[name] = (array, Column(unit=unit, frame="joint", labels=tuple(names)))
            lost = np.isfinite(inner[part]).any(axis=1).sum() if part in inner else 0
            if lost:
                notes.append(f"{name} of {lost} messages are missing: the messages do not name the joints")
        elif part in inner:  # no joint names
            found[name] = (inner[part], Column(unit=unit, frame="joint"))
    return found


def _matrices(array: np.ndarray) -> tuple[np.ndarray, int]:
    """Convert positions and quaternions xyzw (N, 7) to matrices (N, 4, 4), NaN if invalid; count the invalid rows."""
    wrong = ~(np.abs(np.linalg.norm(array[:, 3:], axis=1) - 1.0) <= _LENGTH)
    given = np.isfinite(array).all(axis=1)
    quaternions = np.where(wrong[:, None], [0.0, 0.0, 0.0, 1.0], array[:, 3:])[:, [3, 0, 1, 2]]
    T = se3.from_rp(quaternion.to_matrix(quaternions), np.where(wrong[:, None], 0.0, array[:, :3]))
    T[wrong] = np.nan
    return T, int((wrong & given).sum())


def _frame(topic: TopicFields, prefix: str) -> str:
    """Return the frame of the nearest enclosing header."""
    above = prefix
    while True:
        above = above.rpartition(".")[0]
        frame = topic.frames.get(f"{above}.header.frame_id" if above else "header.frame_id")
        if frame is not None or not above:
            return frame or ""


_NAMELESS = ("data", "value")  # single fields of std_msgs types, whose names are meaningless
_WALL = 10**18  # ns, in 2001: later stamps are wall-clock times
_PAIR = re.compile(r"^(?P<list>[^\[]*)\[(?P<parent>[^\]>]*)>(?P<child>[^\]]*)\]\.transform$")


@dataclass(frozen=True, slots=True)
class Stream:
    """Columns of one topic with common times: recording time and, with a header, creation time."""

    topic: str
    type: str
    log_ns: np.ndarray
    stamp_ns: np.ndarray | None
    values: Mapping[str, np.ndarray]
    columns: Mapping[str, Column]

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names of a JointState; empty for other types."""
        return next((one.labels for one in self.columns.values()), ()) if self.type == JOINTS else ()

    @property
    def rate(self) -> float:
        """Message rate [Hz]; 0 for fewer than two messages."""
        stamps = self.log_ns if self.stamp_ns is None else self.stamp_ns
        length = (int(stamps.max()) - int(stamps.min())) / 1e9 if len(stamps) > 1 else 0.0
        return (len(stamps) - 1) / length if length > 0 else 0.0

    def rows(self, which: np.ndarray) -> Stream:
        stamps = None if self.stamp_ns is None else self.stamp_ns[which]
        values = {name: array[which] for name, array in self.values.items()}
        return replace(self, log_ns=self.log_ns[which], stamp_ns=stamps, values=values)

    def ordered(self, joints: Sequence[str]) -> Stream:
        """Return the JointState with the given joints in the given order."""
        places = [self.joints.index(name) for name in joints]
        values = {name: array[:, places] for name, array in self.values.items()}
        columns = {name: replace(column, labels=tuple(joints)) for name, column in self.columns.items()}
        return replace(self, values=values, columns=columns)


def stem(topic: str) -> str:
    """Return the prefix of column names for a topic: "/ft/wrench" gives "ft.wrench"."""
    return topic.strip("/").replace("/", ".")


def rate_text(streams: Sequence[Stream]) -> str:
    """Return the topics and their rates, fastest first, for an error message."""
    lines = {}
    for one in sorted(streams, key=lambda one: -one.rate):
        rate = f"{one.rate:.4g} Hz" if one.rate else f"{len(one.log_ns)} message"
        frames = f" ({', '.join(list(one.values)[:2])})" if one.type == "tf2_msgs/msg/TFMessage" else ""
        lines[f"{one.topic}{frames} {rate}"] = None
    return ", ".join(lines)


def streams_of(topic: str, fields: TopicFields, decoded: Decoded) -> tuple[list[Stream], list[str]]:
    """Return the streams of a topic, one per publisher of transforms or joints, and notes on faults."""
    values, columns, notes = columns_of_fields(fields, decoded.fields)
    notes = [f"{topic}: {note}" for note in notes]
    if not values:
        return [], notes
    stamps = _stamps(decoded.fields, "header")
    whole = Stream(topic, fields.type, decoded.log_ns, stamps, values, columns)
    order = np.argsort(decoded.log_ns, kind="stable")
    if not np.array_equal(order, np.arange(len(order))):
        whole = whole.rows(order)
    if fields.type == JOINTS:
        return _by_joints(whole, list(fields.joints.get("", ()))), notes
    if any(_PAIR.match(name) for name in values):
        return _by_frames(whole, decoded.fields, order), notes
    if len(values) == 1 and (columns[next(iter(values))].unit != "1" or next(iter(values)) in _NAMELESS):
        values, columns = {stem(topic): whole.values[n] for n in values}, {stem(topic): columns[n] for n in values}
        return [replace(whole, values=values, columns=columns)], notes
    named = {name: f"{stem(topic)}.{name}" for name in values}
    values = {own: whole.values[name] for name, own in named.items()}
    return [replace(whole, values=values, columns={own: columns[name] for name, own in named.items()})], notes


def _stamps(fields: Mapping[str, np.ndarray], header: str) -> np.ndarray | None:
    """Return the stamps (N,) of a header [ns], or None if the header or a stamp is missing."""
    seconds, rest = fields.get(f"{header}.stamp.sec"), fields.get(f"{header}.stamp.nanosec")
    if seconds is None or rest is None or not np.isfinite(seconds).all() or not np.isfinite(rest).all():
        return None
    stamps = seconds[:, 0].astype(np.int64) * 10**9 + rest[:, 0].astype(np.int64)
    if not stamps.any() or (stamps[1:] <= 0).any():
        return None
    return stamps if stamps[0] > 0 or stamps.max() < _WALL else None  # simulated time begins at 0


def _by_joints(whole: Stream, lists: Sequence[tuple[str, ...]]) -> list[Stream]:
    """Split a stream by sets of joints published together, because an arm and its gripper may share a topic."""
    groups: list[set[str]] = []
    for names in lists:
        meeting = [group for group in groups if group & set(names)]
        groups = [group for group in groups if group not in meeting] + [set(names).union(*meeting)]
    if len(groups) < 2:
        return [whole]
    streams = []
    for group in sorted(groups, key=len, reverse=True):
        part = whole.ordered([name for name in whole.joints if name in group])
        there = np.any([np.isfinite(array).any(axis=1) for array in part.values.values()], axis=0)
        part = part.rows(there)
        kept = {name: array for name, array in part.values.items() if np.isfinite(array).any()}
        streams.append(replace(part, values=kept, columns={name: part.columns[name] for name in kept}))
    return streams


def _by_frames(whole: Stream, fields: Mapping[str, np.ndarray], order: np.ndarray) -> list[Stream]:
    """Split a stream of transforms into one stream for each set of transforms published together."""
    groups: dict[bytes, list[str]] = {}
    for name, array in whole.values.items():
        if _PAIR.match(name):
            there = np.isfinite(array).reshape(len(array), -1).all(axis=1)
            groups.setdefault(np.packbits(there).tobytes(), []).append(name)
    streams = []
    for names in sorted(groups.values(), key=len, reverse=True):
        first = whole.values[names[0]]
        there = np.isfinite(first).reshape(len(first), -1).all(axis=1)
        header = names[0].removesuffix(".transform") + ".header"
        stamps = _stamps({key: a[order][there] for key, a in fields.items() if key.startswith(header)}, header)
        values, columns = {}, {}
        for name in names:
            found = _PAIR.match(name)
            parent, child = (found[key].strip("/") for key in ("parent", "child")) if found else ("", "")
            values[f"{stem(whole.topic)}.{parent}.{child}"] = whole.values[name][there]
            columns[f"{stem(whole.topic)}.{parent}.{child}"] = replace(whole.columns[name], frame=parent)
        streams.append(Stream(whole.topic, whole.type, whole.log_ns[there], stamps, values, columns))
    return streams
