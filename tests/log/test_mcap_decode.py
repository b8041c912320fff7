"""Numbers from messages in MCAP files: layouts, blocks, columns."""

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
from armlab.log.mcap.decode import (
    Decoded,
    MessageReader,
    Room,
    assembled,
    decode,
    decode_chunk,
    message_counts,
    messages,
    variant_of,
)
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
        stamp = store.types["builtin_interfaces/msg/Time"](sec=i, nanosec=0)
        parts = {"header": store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=""), "name": names}
        parts |= {"position": rng.normal(size=3), "velocity": np.zeros(0), "effort": np.full(efforts, float(i))}
        message = store.types[TYPE](**parts)
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
    count = len(list(messages(view, found, number)))
    assert message_counts(view, found)[number] == len(decoded[number].sequence) == count
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
        {"big": True},
    ],
)
def test_other_writers(store, options: dict) -> None:
    data, positions = written(store, [(["a", "b", "c"], 3)] * 200, **options)
    found = read_back(data)
    assert np.array_equal(found.fields["position"], positions)
    for counted in (found.sequence, found.log_ns, found.fields["header.stamp.sec"][:, 0]):
        assert np.array_equal(counted, np.arange(200))


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.tuples(st.integers(0, 30), st.integers(0, 3)), min_size=1, max_size=40), st.sampled_from([200, 1 << 20])
)
def test_mixed_layouts_keep_their_rows(store, made: list[tuple[int, int]], chunk_size: int) -> None:
    """Messages with more layouts than are cached, and of several lengths."""
    names = [[], ["long name", "b", "c"], *([f"{k:02d}", "b", "c"] for k in range(2, 31))]
    rows = [(names[k], count) for k, count in made]
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


@pytest.mark.parametrize("chunking", [True, False])
def test_a_damaged_message_costs_itself_only(chunking: bool) -> None:
    """With or without chunks; one sentence reports all damaged messages of a channel."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=300, use_chunking=chunking)
    writer.start()
    schema = writer.register_schema("t/msg/T", "ros2msg", b"int32 a\nuint8[] x")
    for topic in ("/states", "/bad"):
        writer.register_channel(topic, "cdr", schema)
    writer.register_channel("/plain", "json", schema)
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
    with pytest.raises(LogError, match="Expected messages encoded as cdr on /plain, got 'json'"):
        decode(view, contents(view), {3: ["a"]})
    assert damage == [
        "4 messages on /states skipped: Expected at most 13 elements in x, got 1828716544.",
        "40 messages on /bad skipped: Expected 7 numbers of type uint8 in x, got the end of the message.",
    ]


def test_a_channel_whose_columns_would_be_holes_is_left_out_alone() -> None:
    """For any distribution of its messages over chunks; no chunk alone is refused."""
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
    words = "3000 messages on /ragged skipped: Expected arrays of similar size, got 3000 rows with 105999"
    assert [sentence[: len(words)] for sentence in damage] == [words]
    assert len(decode(view, contents(view), {1: ["a"]})[0][1].fields["a"]) == 3000


def test_an_index_that_cannot_be_true_takes_no_room_and_is_not_believed(store) -> None:
    readers = {2: MessageReader(TYPE, definitions(TYPE, store.generate_msgdef(TYPE, ros_version=2)[0]), None)}
    view = memoryview(written(store, [(["a"], row % 3) for row in range(60)], chunk_size=3000)[0])
    chunk = contents(view).chunks[0]
    data, (start, stop) = unpacked(view, chunk), chunk.indexes[2]
    whole = decode_chunk(view, chunk, data, readers, True)
    for wrong in ((start + 8, stop + 8), (7, 7 + stop - start)):
        parts = decode_chunk(view, replace(chunk, indexes={2: wrong}), data, readers, True)
        assert np.array_equal(parts[2].sequence, whole[2].sequence)
    view = memoryview(written(store, [(["a"], 1)] * 100, chunk_size=3000)[0])
    chunks = contents(view).chunks
    told = list(chunks)
    start, stop = told[2].indexes[2]
    told[2] = replace(told[2], indexes={2: (start, start + 16 * (told[2].size + 1))})
    told[3] = replace(told[3], indexes={2: (start, stop + 160)}, size=1 << 60)
    room = Room(view, told, readers)
    copied = [room.copy(place, unpacked(view, chunk)) for place, chunk in enumerate(chunks)]
    assert [2 in one for one in copied] == [True, True, False, False] + [True] * (len(chunks) - 4)
    rows = [len(one[2]) for one in copied if 2 in one]
    assert copied[-1][2].stop == sum(rows) + (stop - start) // 16 + 10


def test_a_message_of_many_parts_takes_time_in_proportion() -> None:
    """Copying all previous names for each number took an hour here."""
    text = "In[] points\n" + "=" * 80 + "\nMSG: t/In\nfloat64 x\nfloat64 y"
    found = MessageReader("t/msg/T", definitions("t/msg/T", text), None)
    raw = b"\0\1\0\0" + struct.pack("<Ixxxx", 20_000) + bytes(16 * 20_000)
    (run,) = variant_of(np.frombuffer(raw, np.uint8), found).runs
    assert len(run) == 40_000


def test_as_many_columns_as_messages_are_read_or_refused_at_once() -> None:
    """Each message has its own column; searching every message for every column would take hours."""
    pieces = [(np.array([k]), {((f"x{k}", 1),): np.array([[float(k)]])}) for k in range(20_000)]
    with pytest.raises(LogError, match="got 20000 rows with 20000 numbers, up to 1 in x0; padding the 20000 column"):
        assembled(20_000, pieces)
    values = assembled(2000, pieces[:2000])
    assert len(values) == 2000
    assert np.isfinite(values["x7"][:, 0]).nonzero()[0].tolist() == [7]


def test_counts_with_holes_in_one_piece_stay_missing_where_another_piece_has_none() -> None:
    """A piece of integers before one of reals with NaN: NaN must not become an integer."""
    path = "clamped"
    whole, holed = np.array([[1], [2]], dtype=np.uint8), np.array([[np.nan], [4.0]])
    pieces = [(np.array([0, 1]), {((path, 1),): whole}), (np.array([2, 3]), {((path, 1),): holed})]
    np.testing.assert_array_equal(assembled(4, pieces)[path][:, 0], [1.0, 2.0, np.nan, 4.0])
