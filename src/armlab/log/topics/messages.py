"""Messages by topic in logs from other programs: ROS 2 (MCAP and SQLite), ROS 1, JSON and protobuf."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from armlab.errors import LogError
from armlab.log.column import refuse_ragged
from armlab.log.file_formats.description import Progress
from armlab.log.mcap import decode
from armlab.log.mcap.records import Contents
from armlab.log.topics.streams import TopicFields
from armlab.wire import cdr

Numbers = dict[str, Any]
"""Dotted name -> number or list of numbers."""

_MAX_DEPTH = 32
_MAX_NAMES = 4096  # fields per message; larger messages are point clouds or maps
_LARGEST = 2**63  # larger integers are converted to floats
_PROTOBUF_MESSAGE, _PROTOBUF_NUMBERS = 11, {1, 2, 3, 4, 5, 6, 7, 8, 13, 14, 15, 16, 17, 18}


def decode_one_by_one(
    messages: Iterable[tuple[int, int, bytes]], numbers: Callable[[bytes], Numbers]
) -> tuple[decode.Decoded, int, str]:
    """Decode messages (sequence, log time, bytes); also return the number of skipped messages and the reason for
    skipping the first one."""
    sequence: list[int] = []
    log_ns: list[int] = []
    columns: dict[str, tuple[list[int], list[Any]]] = {}
    bad, reason = 0, ""
    for number, stamp, raw in messages:
        try:
            found = numbers(raw)
        except LogError as error:
            bad, reason = bad + 1, reason or str(error)
            continue
        for name, value in found.items():
            rows, values = columns.setdefault(name, ([], []))
            rows.append(len(sequence))
            values.append(value)
        sequence.append(number)
        log_ns.append(stamp)
    widths = {name: max(map(_size, values)) for name, (_, values) in columns.items()}
    try:
        refuse_ragged(len(sequence), widths, sum(sum(map(_size, values)) for _, values in columns.values()))
    except LogError as error:
        bad, reason = bad + len(sequence), str(error)
        sequence, log_ns, columns = [], [], {}
    fields = {name: _array(len(sequence), *column, widths[name]) for name, column in columns.items()}
    return decode.Decoded(np.array(sequence, dtype=np.uint32), np.array(log_ns, dtype=np.int64), fields), bad, reason


def _size(value: Any) -> int:
    return len(value) if isinstance(value, list) else 1


def _array(count: int, rows: list[int], values: list[Any], width: int) -> np.ndarray:
    """Assemble the numbers or lists of numbers of all rows into an array (N, k), padded with NaN."""
    if len(rows) == count and all(isinstance(value, bool) for value in values):
        return np.array(values)[:, None]
    if len(rows) == count and all(isinstance(value, int) for value in values):
        try:
            return np.array(values, dtype=np.int64)[:, None]
        except OverflowError:
            pass
    array = np.full((count, width), np.nan)
    for row, value in zip(rows, values, strict=True):
        array[row, : _size(value)] = value
    return array


def numbers_in_json(raw: bytes) -> Numbers:
    """Return the numbers and lists of numbers in a JSON message; strings are skipped."""
    found: Numbers = {}
    try:
        _collect(msgspec.json.decode(raw), "", found, 0)
    except (ValueError, RecursionError, OverflowError) as error:
        raise LogError(f"Expected a message in JSON, got: {str(error).rstrip('.')}.") from None
    return found


def _collect(value: Any, path: str, found: Numbers, depth: int) -> None:
    if depth > _MAX_DEPTH or len(found) > _MAX_NAMES:
        return
    if isinstance(value, dict):
        for key, inner in value.items():
            _collect(inner, f"{path}.{key}" if path else str(key), found, depth + 1)
    elif isinstance(value, int | float):
        found[path or "value"] = value if -_LARGEST <= value < _LARGEST else float(value)
    elif isinstance(value, list):
        if value and all(isinstance(one, int | float) for one in value):
            found[path or "value"] = [float(one) for one in value]
        else:
            for index, inner in enumerate(value[:_MAX_NAMES]):
                _collect(inner, f"{path}[{index}]", found, depth + 1)


def numbers_in_protobuf(name: str, definition: bytes) -> Callable[[bytes], Numbers]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

    try:
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(definition).file:
            pool.Add(file)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    except (message.DecodeError, KeyError, TypeError, ValueError) as error:
        raise LogError(f"Expected a protobuf definition of {name}, got an invalid one: {error}.") from None

    def numbers(raw: bytes) -> Numbers:
        found: Numbers = {}
        try:
            _collect_protobuf(kind.FromString(raw), "", found, 0)
        except (message.DecodeError, ValueError, RecursionError) as error:
            raise LogError(f"Expected a protobuf message of type {name}, got: {str(error).rstrip('.')}.") from None
        return found

    return numbers


def _collect_protobuf(message: Any, path: str, found: Numbers, depth: int) -> None:
    if depth > _MAX_DEPTH or len(found) > _MAX_NAMES:
        return
    for member in message.DESCRIPTOR.fields:
        there, value = f"{path}.{member.name}" if path else member.name, getattr(message, member.name)
        is_list = hasattr(value, "__len__") and not isinstance(value, str | bytes)  # older protobuf API
        several = getattr(member, "is_repeated", is_list)
        if member.type == _PROTOBUF_MESSAGE and several and not isinstance(value, Mapping):
            for index, inner in enumerate(value[:_MAX_NAMES]):
                _collect_protobuf(inner, f"{there}[{index}]", found, depth + 1)
        elif member.type == _PROTOBUF_MESSAGE and not several and message.HasField(member.name):
            _collect_protobuf(value, there, found, depth + 1)
        elif member.type in _PROTOBUF_NUMBERS:
            found[there] = [float(one) for one in value] if several else value


_PACKAGES = {  # packages without robot data
    "action_msgs", "diagnostic_msgs", "lifecycle_msgs", "rcl_interfaces", "rosgraph_msgs", "rosapi_msgs",
    "statistics_msgs", "type_description_interfaces", "visualization_msgs",
}  # fmt: skip
_HEADER = "std_msgs/msg/Header"
_TYPES = {  # strings, images, point clouds, maps
    "std_msgs/msg/String", "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud",
    "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid", "std_msgs/msg/Empty",
}  # fmt: skip


@dataclass(slots=True)
class TopicMessages:
    """Topics of a log: names, messages, skipped topics, and notes on damage."""

    fields: dict[str, TopicFields] = field(default_factory=dict)
    parts: dict[str, list[decode.Decoded]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)

    def reader(self, topic: str, type_: str, types: cdr.Definitions) -> decode.MessageReader:
        """Return the reader of a topic's messages, which names the values by joint and frame."""
        fields = self.fields.setdefault(topic, TopicFields(type_, types))
        return decode.MessageReader(type_, types, None, fields.named)

    def add(self, topic: str, decoded: decode.Decoded) -> None:
        """Add the messages of a topic; messages without numbers are ignored."""
        if len(decoded.sequence):
            self.parts.setdefault(topic, []).append(decoded)

    def decoded(self) -> Iterator[tuple[str, TopicFields, decode.Decoded]]:
        """Yield each topic with its column names and all messages; inconsistent parts are reported as damage."""
        for topic, parts in self.parts.items():
            try:
                whole = _joined(parts)
            except LogError as error:
                self.damage.append(decode.skipped(sum(len(part.sequence) for part in parts), topic, str(error)))
                continue
            yield topic, self.fields[topic], whole


def is_measurement(type_: str) -> bool:
    """Return whether messages of this type contain numerical robot data."""
    return type_ not in _TYPES and type_.partition("/")[0] not in _PACKAGES


def read_mcap_topics(
    view: memoryview,
    found: Contents,
    wanted: Callable[[str, str], bool],
    into: TopicMessages,
    progress: Progress | None = None,
) -> None:
    """Read the CDR-, JSON- or protobuf-encoded topics of an MCAP file."""
    readers: dict[int, decode.MessageReader] = {}
    others: dict[int, Callable[[bytes], dict[str, Any]]] = {}
    for number, channel in found.channels.items():
        if not wanted(channel.topic, channel.type):
            continue
        if not is_measurement(channel.type):
            into.left_out[channel.topic] = channel.type
            continue
        try:
            if channel.encoding == "cdr":
                types = cdr.definitions(channel.type, channel.schema, channel.schema_encoding)
                readers[number] = into.reader(channel.topic, channel.type, types)
            elif channel.encoding == "json":
                others[number] = numbers_in_json
            elif channel.encoding == "protobuf":
                schema = channel.schema.encode(errors="surrogateescape")
                others[number] = numbers_in_protobuf(channel.type, schema)
            else:
                raise LogError(f"Expected messages encoded as cdr, json or protobuf, got {channel.encoding!r}.")
        except LogError as error:
            into.left_out[channel.topic] = str(error).rstrip(".")
    decoded, damage = decode.decode_by(view, found, readers, progress)
    into.damage += damage
    for number, one in decoded.items():
        into.add(found.channels[number].topic, one)
    for number, numbers in others.items():
        topic = found.channels[number].topic
        into.fields.setdefault(topic, TopicFields(found.channels[number].type, {}))
        one, bad, reason = decode_one_by_one(decode.messages(view, found, number), numbers)
        if bad:
            into.damage.append(decode.skipped(bad, topic, reason))
        into.add(topic, one)


def read_rosbags_topics(
    bag: Any, wanted: Callable[[str, str], bool], into: TopicMessages, progress: Progress | None = None
) -> None:
    """Read topics of a rosbag2 folder or a ROS 1 bag that `rosbags` has opened."""
    readers: dict[int, tuple[Any, decode.MessageReader, Callable[[bytes], bytes]]] = {}
    for connection in bag.connections:
        if not wanted(connection.topic, connection.msgtype):
            continue
        if not is_measurement(connection.msgtype):
            into.left_out[connection.topic] = connection.msgtype
            continue
        try:
            types, to_cdr = _types_of(connection)
        except LogError as error:
            into.left_out[connection.topic] = str(error).rstrip(".")
            continue
        readers[connection.id] = connection, into.reader(connection.topic, connection.msgtype, types), to_cdr
    raws: dict[int, list[bytes]] = {number: [] for number in readers}
    stamps: dict[int, list[int]] = {number: [] for number in readers}
    connections = [connection for connection, _, _ in readers.values()]
    total = max(sum(one.msgcount for one in connections), 1)
    found: Any = bag.messages(connections) if connections else ()  # rosbags yields all messages for an empty selection
    for done, (connection, stamp, raw) in enumerate(found):
        raws[connection.id].append(raw)
        stamps[connection.id].append(stamp)
        if progress and done % 10_000 == 0:
            progress(min(done, total), total, "messages")
    for number, (connection, reader, to_cdr) in readers.items():
        one, bad, reason = _decoded(raws[number], np.array(stamps[number], dtype=np.int64), to_cdr, reader)
        if bad:
            into.damage.append(decode.skipped(bad, connection.topic, reason))
        into.add(connection.topic, one)


def _types_of(connection: Any) -> tuple[cdr.Definitions, Callable[[bytes], bytes]]:
    """Return the definitions of a connection's type, from the bag or ROS 2, and a function that converts messages to
    CDR."""
    from rosbags.interfaces import ConnectionExtRosbag1
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from armlab.log.recording.ros_messages import store

    name, definition = connection.msgtype, connection.msgdef
    if isinstance(connection.ext, ConnectionExtRosbag1):
        converter = get_typestore(Stores.EMPTY)
        held = {**converter.fielddefs, **get_types_from_msg(definition.data, name)}
        if _HEADER in held:  # ROS 2 headers have no field seq
            held[_HEADER] = held[_HEADER][0], [one for one in held[_HEADER][1] if one[0] != "seq"]
        converter.register(held)
        fields = {one: [(key, _signed(about)) for key, about in entry[1]] for one, entry in held.items()}
        types = cdr.with_bytes(cdr.bounded(name, fields))
        return types, lambda raw: bytes(converter.ros1_to_cdr(raw, name))
    if definition.data:
        encoding = "ros2idl" if definition.format.name == "IDL" else "ros2msg"
        return cdr.definitions(name, definition.data, encoding), bytes
    if name not in store().fielddefs:
        raise LogError(
            f"Expected a definition of {name} in the bag, got no definition. Record the data as MCAP, which stores "
            "definitions."
        )
    return cdr.definitions(name, store().generate_msgdef(name, ros_version=2)[0]), bytes


def _signed(description: Any) -> Any:
    """Return the description of a ROS 1 field with its type byte as int8."""
    kind, detail = description
    if int(kind) > 2:
        return kind, (_signed(detail[0]), detail[1])
    return (kind, ("int8", 0)) if int(kind) == 1 and detail[0] == "byte" else description


def _decoded(
    raws: Sequence[bytes], stamps: np.ndarray, to_cdr: Callable[[bytes], bytes], reader: decode.MessageReader
) -> tuple[decode.Decoded, int, str]:
    """Decode messages in memory; also return the number of skipped messages and the reason for skipping the first
    one."""
    whole: list[bytes] = []
    kept: list[int] = []
    reason = ""
    for row, raw in enumerate(raws):
        try:
            whole.append(to_cdr(raw))
            kept.append(row)
        except Exception as error:  # rosbags raises its own errors, struct errors and assertions
            why = str(error).rstrip(".") or type(error).__name__
            reason = (
                reason
                or f"Expected a message of type {reader.type}, got "
                f"{len(raw)} bytes that do not match this type ({why})."
            )
    same = decode.of_length(np.array([len(raw) for raw in whole], dtype=np.int64))
    joined = ((rows, b"".join([whole[row] for row in rows.tolist()])) for rows in same)
    blocks = ((rows, np.frombuffer(raw, dtype=np.uint8).reshape(len(rows), -1)) for rows, raw in joined)
    read = decode.read_blocks(len(whole), blocks, reader)
    rows = np.array(kept, dtype=np.int64)[read.rows]
    try:
        fields = decode.assembled(len(rows), read.pieces)
    except LogError as error:
        rows, fields, reason = rows[:0], {}, str(error)
    return decode.Decoded(rows.astype(np.uint32), stamps[rows], fields), len(raws) - len(rows), reason or read.reason


def _joined(parts: Sequence[decode.Decoded]) -> decode.Decoded:
    if len(parts) == 1:
        return parts[0]
    ends = np.cumsum([len(part.sequence) for part in parts]).tolist()
    pieces = [
        (np.arange(end - len(part.sequence), end), {((path, a.shape[1]),): a for path, a in part.fields.items()})
        for end, part in zip(ends, parts, strict=True)
    ]
    return decode.Decoded(
        np.concatenate([part.sequence for part in parts]),
        np.concatenate([part.log_ns for part in parts]),
        decode.assembled(ends[-1], pieces),
    )
