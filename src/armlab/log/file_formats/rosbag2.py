"""Write a `Table` as a rosbag2 of standard message types, and read it back.

Every topic has one message per row. Joint positions, velocities and torques are stored as JointState, wrenches as
WrenchStamped, poses as PoseStamped, and other columns as std_msgs numbers, arrays or strings. `/t` stores the clock
exactly.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from armlab.errors import LogError, UnknownName
from armlab.lie import quaternion, se3
from armlab.log.column import Column
from armlab.log.file_formats.description import Description, Progress, distinct, of_json
from armlab.log.file_formats.opening import undamaged
from armlab.log.mcap.decode import MessageReader, assembled, read_blocks
from armlab.log.recording.ros_messages import POSE_FIELDS, WRENCH_FIELDS, blank, definition, store, topic_name
from armlab.log.table import Table
from armlab.wire import cdr

EXACT = 1e-12  # maximum error of RᵀR at which a quaternion represents R exactly
JOINTS = "sensor_msgs/msg/JointState"
WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
TEXT = "std_msgs/msg/String"
_FIELDS = {WRENCH: WRENCH_FIELDS, POSE: POSE_FIELDS}
_SCALARS = {"count": "std_msgs/msg/Int64", "flag": "std_msgs/msg/Bool"}
_ARRAYS = {"count": "std_msgs/msg/Int64MultiArray", "flag": "std_msgs/msg/UInt8MultiArray"}
_NUMBERS = {"std_msgs/msg/Int64MultiArray": "i8", "std_msgs/msg/UInt8MultiArray": "u1"}
_ENCAPSULATION = b"\0\1\0\0"  # plain CDR, little-endian


@dataclass(frozen=True, slots=True)
class BagTopic:
    """One topic: name, message type, and the dotted field names of each column."""

    name: str
    type: str
    fields: Mapping[str, tuple[str, ...]]


def whole_poses(table: Table) -> list[str]:
    """Return the pose columns that quaternions can represent exactly; empty rows are ignored."""
    found = []
    for name, column in table.columns.items():
        if column.kind == "pose" and column.shape == (4, 4):
            missing = np.isnan(table[name]).all(axis=(1, 2))
            if (se3.is_pose(table[name], EXACT) | missing).all():
                found.append(name)
    return found


def topics_of(columns: Mapping[str, Column], poses: Iterable[str]) -> list[BagTopic]:
    """Return the topics of a table, for both writing and reading."""
    rest, topics = dict(columns), [BagTopic("/t", "std_msgs/msg/Float64", {"t": ("data",)})]
    for ending in ("", "_ref", "_sent"):
        parts = {f"{name}{ending}": field for name, field in (("q", "position"), ("qd", "velocity"), ("tau", "effort"))}
        there = {name: (field,) for name, field in parts.items() if name in rest and rest[name].shape != (0,)}
        if there:
            topics.append(BagTopic(f"/joint_states{ending}", JOINTS, there))
            rest = {name: column for name, column in rest.items() if name not in there}
    kinds = {name: _type(name, column, poses) for name, column in rest.items()}
    names = distinct({name: f"/{topic_name(name)}" for name in rest}, [topic.name for topic in topics])
    return topics + [BagTopic(names[name], kind, {name: _FIELDS.get(kind, ("data",))}) for name, kind in kinds.items()]


def messages_of(topic: BagTopic, table: Table, stamps: np.ndarray, joint_names: Sequence[str] = ()) -> Iterator[bytes]:
    """Yield the message of each row, with `stamps` (N,) [ns] in its header."""
    if topic.type == TEXT:
        (name,) = topic.fields
        for value in table[name].tolist():
            raw = (value if isinstance(value, str) else json.dumps(value)).encode() + b"\0"
            yield _ENCAPSULATION + struct.pack("<I", len(raw)) + raw
        return
    values = {name: _encoded(topic, table[name]) for name in topic.fields}
    raw = _sample(topic, table, {name: array.shape[1] for name, array in values.items()}, joint_names)
    found = cdr.layout(raw, topic.type, _types(topic.type))
    block = np.tile(np.frombuffer(raw, dtype=np.uint8), (len(table), 1))
    filled: dict[str, np.ndarray] = {}
    for name, array in values.items():
        paths = topic.fields[name]
        filled |= zip(paths, [array] if len(paths) == 1 else np.hsplit(array, len(paths)), strict=True)
    filled |= {"header.stamp.sec": stamps[:, None] // 10**9, "header.stamp.nanosec": stamps[:, None] % 10**9}
    for place in found.fields:
        if place.path in filled and place.count:
            part = np.ascontiguousarray(filled[place.path], dtype=place.dtype)
            block[:, place.start : place.stop] = part.view(np.uint8).reshape(len(block), -1)
    whole, length = block.tobytes(), len(raw)
    yield from (whole[at : at + length] for at in range(0, len(whole), length))


def columns_of(topic: BagTopic, columns: Mapping[str, Column], raws: Sequence[bytes]) -> dict[str, np.ndarray]:
    """Return the columns (N, ...) from the messages of a topic."""
    if topic.type == TEXT:
        (name,) = topic.fields
        words = [raw[8 : 7 + struct.unpack_from("<I", raw, 4)[0]].decode() for raw in raws]
        whole = [json.loads(word) for word in words] if columns[name].shape else words  # arrays are JSON lists
        return {name: np.array(whole, dtype=np.str_).reshape(len(raws), *columns[name].shape)}
    wanted = frozenset(path for paths in topic.fields.values() for path in paths)
    fields: dict[str, np.ndarray] = {}
    if raws:
        if len({len(raw) for raw in raws}) > 1:
            raise LogError(
                f"Expected messages of equal length on {topic.name}, got several lengths. The bag was not "
                "written by armlab."
            )
        block = np.frombuffer(b"".join(raws), dtype=np.uint8).reshape(len(raws), len(raws[0]))
        reader = MessageReader(topic.type, _types(topic.type), wanted)
        read = read_blocks(len(raws), [(np.arange(len(raws)), block)], reader)
        if read.bad:
            raise LogError(f"Expected valid messages on {topic.name}, got {read.bad} corrupt ones: {read.reason}")
        fields = assembled(len(raws), read.pieces)
    return {name: _decoded(topic, paths, fields, len(raws), columns[name]) for name, paths in topic.fields.items()}


def _decoded(
    topic: BagTopic, paths: Sequence[str], fields: Mapping[str, np.ndarray], rows: int, column: Column
) -> np.ndarray:
    size = int(np.prod(column.shape, dtype=int))
    parts = [fields[path] for path in paths if path in fields]
    array = np.concatenate(parts, axis=1) if parts else np.zeros((rows, 0))
    if topic.type == POSE and rows:
        R = quaternion.to_matrix(np.where(np.isnan(array[:, :1]), [0.0, 0.0, 0.0, 1.0], array[:, 3:])[:, [3, 0, 1, 2]])
        array = np.where(np.isnan(array[:, :1]), np.nan, se3.from_rp(R, array[:, :3]).reshape(rows, 16))
    if rows and array.shape[1] != size:
        raise LogError(f"Expected {size} numbers in each message of {topic.name}, got {array.shape[1]}.")
    return array.reshape(rows, *column.shape)


def _type(name: str, column: Column, poses: Iterable[str]) -> str:
    if column.kind == "text":
        return TEXT
    if name in poses:
        return POSE
    if column.shape == (6,) and column.unit == "N, N m":
        return WRENCH
    if column.shape:
        return _ARRAYS.get(column.kind or "", "std_msgs/msg/Float64MultiArray")
    return _SCALARS.get(column.kind or "", "std_msgs/msg/Float64")


def _encoded(topic: BagTopic, array: np.ndarray) -> np.ndarray:
    """Return the numeric values (N, k) of a column in field order."""
    if topic.type != POSE:
        return array.reshape(len(array), int(np.prod(array.shape[1:], dtype=int)))
    missing = np.asarray(np.isnan(array).all(axis=(1, 2)))
    q = quaternion.from_matrix(np.where(missing[:, None, None], np.eye(4), array)[:, :3, :3])
    numbers = np.hstack([array[:, :3, 3], q[:, [1, 2, 3, 0]]])
    return np.where(missing[:, None], np.nan, numbers)


def _sample(topic: BagTopic, table: Table, counts: Mapping[str, int], joint_names: Sequence[str]) -> bytes:
    """Return a message of the topic in which all numbers are zero."""
    name = next(iter(topic.fields))
    if topic.type.endswith("MultiArray"):
        message = _multi_array(topic.type, table[name].shape[1:])
    else:
        message = blank(topic.type)
    if topic.type == JOINTS:
        labels = next((table.columns[one].labels for one in topic.fields if table.columns[one].labels), ())
        message.name = list(joint_names or labels or (f"joint_{k + 1}" for k in range(counts[name])))
        for one, (path,) in topic.fields.items():
            setattr(message, path, np.zeros(counts[one]))
    if hasattr(message, "header") and name != "t":
        message.header.frame_id = table.columns[name].frame or ""
    return bytes(store().serialize_cdr(message, topic.type))


def _multi_array(kind: str, shape: Sequence[int]) -> Any:
    types = store().types
    strides = np.cumprod([1, *reversed(shape)])[::-1]
    dims = [
        types["std_msgs/msg/MultiArrayDimension"](label=f"axis {k + 1}", size=size, stride=int(strides[k]))
        for k, size in enumerate(shape)
    ]
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=dims, data_offset=0)
    return types[kind](layout=layout, data=np.zeros(int(np.prod(shape, dtype=int)), dtype=_NUMBERS.get(kind, "f8")))


@cache
def _types(name: str) -> cdr.Definitions:
    return cdr.definitions(name, definition(name))


STORAGES = ("mcap", "sqlite3")
VERSION = 8  # last version of metadata.yaml with quality of service as text, which releases before Jazzy require
BLOCK = 10_000  # rows per block
LAST = 2**31 * 10**9  # ns: header stamps store seconds in 31 bits


def write_rosbag2(
    table: Table, folder: Path, storage: str, progress: Progress, joint_names: Sequence[str] = ()
) -> None:
    """Write a new folder with metadata.yaml and one file of messages, all of standard ROS 2 types."""
    import sqlite3

    from rosbags.rosbag2 import StoragePlugin, Writer

    if storage not in STORAGES:
        raise UnknownName.among("storage", storage, STORAGES)
    stamps, poses = _stamps(table), whole_poses(table)
    topics = topics_of(table.columns, poses)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    try:
        with Writer(folder, version=VERSION, storage_plugin=plugin) as bag:
            bag.set_custom_data("armlab", Description.of(table).json(poses=poses))
            connections = [bag.add_connection(topic.name, topic.type, typestore=store()) for topic in topics]
            for start in range(0, len(table), BLOCK):
                rows = slice(start, start + BLOCK)
                part = table.rows(rows)
                messages = zip(*(messages_of(topic, part, stamps[rows], joint_names) for topic in topics), strict=True)
                for stamp, row in zip(stamps[rows].tolist(), messages, strict=True):
                    for connection, message in zip(connections, row, strict=True):
                        bag.write(connection, stamp, message)
                progress(min(start + BLOCK, len(table)), len(table), "rows")
    except sqlite3.Error as error:
        raise OSError(0, str(error)) from None


def _stamps(table: Table) -> np.ndarray:
    """Return the wall-clock time of each row [ns], non-negative and increasing, so stamps preserve the row order."""
    if not len(table):
        return np.zeros(0, dtype=np.int64)
    if np.abs(table.t).max() >= LAST / 1e9:
        raise LogError(
            f"Expected times of at most {LAST / 1e9:.3g} s for a rosbag2 recording, got {np.abs(table.t).max():g} s."
        )
    stamps = np.round(table.t * 1e9).astype(np.int64)
    order = np.arange(len(stamps))
    stamps = np.maximum.accumulate(stamps - order) + order
    start = max(int(table.t0_ns), -int(stamps[0]))
    if start + int(stamps[-1]) >= LAST:
        raise LogError(
            f"Expected a log recorded before the year 2038, the limit of rosbag2 timestamps, got t0_ns {table.t0_ns}. "
            "Write another format."
        )
    return stamps + start


def is_ours(folder: Path) -> bool:
    """Return whether a folder was written by `write_rosbag2`: its metadata.yaml then describes a table."""
    try:
        return re.search(rb"(?m)^\s+armlab:", (folder / "metadata.yaml").read_bytes()) is not None
    except OSError:
        return False


def read_rosbag2(path: Path) -> Table:
    """Return the table in a rosbag2 written by `write_rosbag2`."""
    from rosbags.rosbag2 import Reader

    with undamaged(f"rosbag2 in {path}"), Reader(path) as bag:
        text = (getattr(bag.storage.metadata, "custom", None) or {}).get("armlab")
        if text is None:
            topics = ", ".join(f"{one.topic} ({one.msgtype})" for one in bag.connections) or "none"
            raise LogError(
                f"Expected a rosbag2 written by armlab in {path}, got a bag from another program; topics: {topics}."
            )
        return _table(path, bag, text)


def _table(path: Path, bag: Any, text: str) -> Table:
    about = of_json(text, path)
    columns = {"t": Column((), "s"), **about.described()}
    topics = topics_of(about.described(), json.loads(text).get("poses", ()))
    raws: dict[str, list[bytes]] = {topic.name: [] for topic in topics}
    for connection, _, raw in bag.messages():
        raws.setdefault(connection.topic, []).append(bytes(raw))
    values: dict[str, np.ndarray] = {}
    for topic in topics:
        if len(raws[topic.name]) != len(raws["/t"]):
            raise LogError(
                f"Expected {len(raws['/t'])} messages on {topic.name} in {path}, as on /t, got {len(raws[topic.name])}."
            )
        values |= columns_of(topic, columns, raws[topic.name])
    return about.table(path, values.pop("t"), {name: values[name] for name in about.columns})
