"""Numbers of foreign writers: other chunks, other compression, no chunks, other layouts, both byte orders."""

from __future__ import annotations

import io
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.typesys import Stores, get_typestore

from armlab.errors import LogError
from armlab.log.mcap.decode import Decoded, decode, decode_by, message_counts, messages
from armlab.log.mcap.message_layouts import MessageReader
from armlab.log.mcap.records import contents, unpacked
from armlab.wire.cdr import definitions

TYPE = "sensor_msgs/msg/JointState"
PATHS = ["position", "effort", "header.stamp.sec"]


@pytest.fixture(scope="module")
def store():
    return get_typestore(Stores.ROS2_HUMBLE)


def written(store, rows: list[tuple[list[str], int]], big: bool = False, **options) -> tuple[bytes, np.ndarray]:
    """Write JointStates with these names and lengths of effort; return the file and the positions (N, k)."""
    rng = np.random.default_rng(1)
    out = io.BytesIO()
    writer = Writer(out, **options)
    writer.start()
    schema = writer.register_schema(TYPE, "ros2msg", store.generate_msgdef(TYPE, ros_version=2)[0].encode())
    other = writer.register_channel("/other", "cdr", schema)
    channel = writer.register_channel("/states", "cdr", schema)
    positions = []
    for i, (names, efforts) in enumerate(rows):
        message = store.types[TYPE](
            header=store.types["std_msgs/msg/Header"](
                stamp=store.types["builtin_interfaces/msg/Time"](sec=i, nanosec=0), frame_id=""
            ),
            name=names,
            position=rng.normal(size=3),
            velocity=np.zeros(0),
            effort=np.full(efforts, float(i)),
        )
        positions.append(message.position)
        raw = bytes(store.serialize_cdr(message, TYPE, little_endian=not big))
        for number in (other, channel, other) if i % 3 else (channel,):
            writer.add_message(number, i, raw, i, i)
    writer.finish()
    return out.getvalue(), np.array(positions).reshape(-1, 3)


def read_back(data: bytes) -> Decoded:
    view = memoryview(data)
    found = contents(view)
    number = next(n for n, channel in found.channels.items() if channel.topic == "/states")
    decoded, damage = decode(view, found, {number: PATHS})
    assert damage == []
    assert [raw for *_, raw in messages(view, found, number)] == [raw for *_, raw in messages(view, found, number)]
    assert message_counts(view, found)[number] == len(decoded[number].sequence)
    return decoded[number]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunk_size": 300},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"repeat_channels": False},
        {"use_statistics": False},
        {"enable_crcs": False},
        {"use_chunking": False},
    ],
)
def test_other_writers(store, options: dict) -> None:
    data, positions = written(store, [(["a", "b", "c"], 3)] * 200, **options)
    found = read_back(data) if options != {"use_chunking": False} else read_loose(data)
    assert np.array_equal(found.fields["position"], positions)
    assert np.array_equal(found.sequence, np.arange(200))
    assert np.array_equal(found.log_ns, np.arange(200))
    assert np.array_equal(found.fields["header.stamp.sec"][:, 0], np.arange(200))


def read_loose(data: bytes) -> Decoded:
    """Read a file without chunks."""
    view = memoryview(data)
    found = contents(view)
    counts = message_counts(view, found)
    assert {number: len(list(messages(view, found, number))) for number in counts} == dict(counts)
    told: list[float] = []
    channel = found.channels[2]
    reader = MessageReader(channel.type, definitions(channel.type, channel.schema), frozenset(PATHS))
    decoded, _ = decode_by(view, found, {2: reader}, lambda done, *_: told.append(done))
    assert told == []  # there is no chunk to tell of
    assert np.array_equal(decoded[2].sequence, decode(view, found, {2: PATHS})[0][2].sequence)
    return decoded[2]


def test_big_endian(store) -> None:
    data, positions = written(store, [(["a"], 1)] * 20, big=True)
    found = read_back(data)
    assert np.array_equal(found.fields["position"], positions)
    assert found.fields["position"].dtype.isnative


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(st.sampled_from([["a", "b", "c"], ["a", "b", "d"], ["long name", "b", "c"], []]), st.integers(0, 3)),
        min_size=1,
        max_size=40,
    ),
    st.sampled_from([200, 1 << 20]),
)
def test_mixed_layouts_keep_their_rows(store, rows: list[tuple[list[str], int]], chunk_size: int) -> None:
    data, positions = written(store, rows, chunk_size=chunk_size)
    found = read_back(data)
    assert np.array_equal(found.fields["position"], positions)
    efforts = [count for _, count in rows]
    if any(efforts):
        effort = found.fields["effort"]
        assert effort.shape == (len(rows), max(efforts))
        for i, count in enumerate(efforts):
            assert np.all(effort[i, :count] == i)
            assert np.all(np.isnan(effort[i, count:]))
    else:
        assert "effort" not in found.fields


def test_text_that_differs_in_every_message(store) -> None:
    rows = [([f"name {i:04d}"], 1) for i in range(300)]
    data, positions = written(store, rows)
    assert np.array_equal(read_back(data).fields["position"], positions)


def test_messages_that_do_not_fit_their_type_are_named(store) -> None:
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    schema = writer.register_schema(TYPE, "ros2msg", store.generate_msgdef(TYPE, ros_version=2)[0].encode())
    channel = writer.register_channel("/states", "cdr", schema)
    plain = writer.register_channel("/plain", "json", schema)
    writer.add_message(channel, 1, b"\x00\x01\x00\x00garbage", 1)
    writer.add_message(plain, 1, b"{}", 1)
    writer.finish()
    view = memoryview(out.getvalue())
    found = contents(view)
    decoded, damage = decode(view, found, {channel: PATHS})
    assert len(decoded[channel].sequence) == 0
    assert damage == [
        "1 message on /states skipped: Expected 1 numbers of type uint32 in header.stamp.nanosec, got the end of the "
        "message."
    ]
    with pytest.raises(LogError, match="Expected messages in cdr on /plain, got 'json'"):
        decode(view, found, {plain: PATHS})


def test_a_damaged_chunk_costs_its_own_messages_only(numbered) -> None:
    raw = [numbered.message(row, [float(row)] * (2 if row == 70 else 1)) for row in range(100)]
    view, found = numbered.written(raw)
    bad = found.chunks[3]
    lost = {row for row in range(100) if raw[row] in unpacked(view, bad)}
    found.chunks[3] = replace(bad, crc=1)
    decoded, damage = decode(view, found, {1: ["a", "x"]})
    assert len(damage) == 1
    assert damage[0].startswith(f"chunk at byte {bad.start} skipped: Expected checksum 00000001 of the chunk at byte")
    rows = [row for row in range(100) if row not in lost]
    assert 2 < len(lost) < 20
    assert decoded[1].sequence.tolist() == decoded[1].fields["a"][:, 0].tolist() == rows
    assert np.array_equal(decoded[1].fields["x"][:, 0], rows)
    assert np.isnan(decoded[1].fields["x"][:, 1]).sum() == len(rows) - 1


@pytest.mark.parametrize("chunking", [True, False])
def test_a_damaged_message_costs_itself_only(chunking: bool) -> None:
    """Whether its file has chunks or none; one sentence tells of all of a channel."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=300, use_chunking=chunking)
    writer.start()
    schema = writer.register_schema("t/msg/T", "ros2msg", b"int32 a\nuint8[] x")
    for topic in ("/states", "/bad"):
        writer.register_channel(topic, "cdr", schema)
    for row in range(40):
        count = 1_828_716_544 if row % 9 == 4 else 1
        for channel, number in ((1, count), (2, 7)):
            raw = b"\0\1\0\0" + struct.pack("<iIB", row, number, 1)
            writer.add_message(channel, row, raw, row, row)
    writer.finish()
    view = memoryview(out.getvalue())
    decoded, damage = decode(view, contents(view), {1: ["a", "x"], 2: ["a"]})
    rows = [row for row in range(40) if row % 9 != 4]
    assert decoded[1].sequence.tolist() == decoded[1].fields["a"][:, 0].tolist() == rows
    assert decoded[2].fields == {}
    assert damage == [
        "4 messages on /states skipped: Expected at most 13 elements in x, got 1828716544.",
        "40 messages on /bad skipped: Expected 7 numbers of type uint8 in x, got the end of the message.",
    ]


def test_a_channel_whose_columns_would_be_holes_is_left_out_alone() -> None:
    """However its messages lie in chunks: none of these alone is refused."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=5000)
    writer.start()
    schema = writer.register_schema("t/msg/T", "ros2msg", b"int32 a\nfloat64[] x")
    for topic in ("/ragged", "/good"):
        writer.register_channel(topic, "cdr", schema)
    for row in range(3000):
        for channel in (1, 2):
            count = 100_000 if (channel, row) == (1, 1500) else 1
            raw = b"\0\1\0\0" + struct.pack("<iI", row, count) + bytes(8 * count)
            writer.add_message(channel, row, raw, row, row)
    writer.finish()
    view = memoryview(out.getvalue())
    decoded, damage = decode(view, contents(view), {1: ["a", "x"], 2: ["a", "x"]})
    assert decoded[1].fields == {}
    assert decoded[2].fields["a"][:, 0].tolist() == list(range(3000))
    (sentence,) = damage
    assert sentence.startswith(
        "3000 messages on /ragged skipped: Expected values that are alike, got 3000 rows with 105999"
    )
    assert len(decode(view, contents(view), {1: ["a"]})[0][1].fields["a"]) == 3000
