"""Messages from other programs in every encoding."""

from __future__ import annotations

import contextlib
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from armlab import log
from armlab.errors import LogError, UnknownName
from armlab.log.mcap.decode import Decoded
from armlab.log.topics.messages import TopicMessages, decode_one_by_one, numbers_in_json, numbers_in_protobuf
from armlab.log.topics.streams import TopicFields

NAMES = ("a", "b", "c")


@pytest.mark.parametrize("chunking", [True, False])
def test_files_of_mcap(ros: Any, tmp_path: Path, chunking: bool) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=chunking)
        writer.start("ros2")
        kind = "sensor_msgs/msg/JointState"
        schema = writer.register_schema(kind, "ros2msg", ros.store.generate_msgdef(kind, ros_version=2)[0].encode())
        state = writer.register_channel("/joint_states", "cdr", schema)
        text = writer.register_channel("/state", "json", writer.register_schema("state", "jsonschema", b"{}"))
        odd = writer.register_channel("/odd", "flatbuffer", writer.register_schema("odd", "flatbuffer", b"\xff"))
        for i in range(20):
            writer.add_message(state, i, ros.raw(ros.joints(i + 1, NAMES, [i, 0, 0])), i, i)
            writer.add_message(text, i, json.dumps({"gain": i, "name": "x"}).encode(), i, i)
            writer.add_message(odd, i, b"\0", i, i)
        writer.finish()
    table = log.read(path, clock="/joint_states")
    np.testing.assert_array_equal(table["q"][:, 0], np.arange(20))
    np.testing.assert_array_equal(table["state.gain"], np.arange(20))
    reason = "Expected messages encoded as cdr, json or protobuf, got 'flatbuffer'"
    assert table.notes == (f"skipped: /odd ({reason})",)
    with pytest.raises(LogError, match=rf"as clock= for .*, got /odd: {reason}\."):
        log.read(path, clock="/odd")
    assert log.read(path, ["q"], robot=None).names == ("q",)


def test_files_of_foxglove(tmp_path: Path) -> None:
    foxglove = pytest.importorskip("foxglove")
    from foxglove.channels import PoseInFrameChannel
    from foxglove.messages import Pose, PoseInFrame, Quaternion, Timestamp, Vector3

    path = tmp_path / "run.mcap"
    with foxglove.open_mcap(path):
        poses = PoseInFrameChannel("/pose")
        for i in range(30):
            foxglove.log("/state", {"q": [i, i + 0.5], "mode": "run", "count": i}, log_time=1000 * i)
            pose = Pose(position=Vector3(x=float(i), y=0.0, z=1.0), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))
            poses.log(PoseInFrame(timestamp=Timestamp(i), frame_id="base", pose=pose), log_time=1000 * i)
    table = log.read(path)
    np.testing.assert_array_equal(table["state.q"], np.arange(30)[:, None] + [0, 0.5])
    assert table.columns["state.count"].kind == "count"
    np.testing.assert_array_equal(table["pose.pose.position.x"], np.arange(30))
    data = path.read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for stop in range(100, len(data), len(data) // 7):
            path.write_bytes(data[:stop])
            with contextlib.suppress(LogError, UnknownName):
                assert len(log.read(path, ["state.q"])) <= 30


def test_idl_and_types_that_nobody_defines(ros: Any, tmp_path: Path) -> None:
    idl = b"module lab_msgs { module msg { struct Gauge { double value; sequence<double> parts; }; }; };"
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for name, kind, text in (("Gauge", "ros2idl", idl), ("X", "ros2msg", b"float64 [[[")):
            writer.register_channel("/" + name, "cdr", writer.register_schema(f"lab_msgs/msg/{name}", kind, text))
        for i in range(3):
            writer.add_message(1, i, b"\0\1\0\0" + np.array([1.5]).tobytes() + b"\0\0\0\0", i, i)
            writer.add_message(2, i, b"\0\1\0\0", i, i)
        writer.finish()
    table = log.read(path)
    assert table["Gauge"].tolist() == [1.5, 1.5, 1.5]
    assert "skipped: /X (Expected a ros2msg definition of lab_msgs/msg/X" in table.notes[0]


def test_parts_of_a_topic_that_are_holes_together_are_left_out_alone() -> None:
    into = TopicMessages(fields={name: TopicFields("t/msg/T", {}) for name in ("/ragged", "/good")})
    for rows, width in ((1, 100_000), (3000, 1)):
        for topic in ("/ragged", "/good"):
            array = np.zeros((rows, 1 if topic == "/good" else width))
            into.add(topic, Decoded(np.zeros(rows, np.uint32), np.arange(rows), {"x": array}))
    ((name, _, decoded),) = into.decoded()
    assert (name, len(decoded.sequence)) == ("/good", 3001)
    words = "3001 messages on /ragged skipped: Expected arrays of similar size, got 3001 rows with 103000"
    assert [sentence[: len(words)] for sentence in into.damage] == [words]


def test_json() -> None:
    raw = b'{"t": {"sec": 1}, "q": [1, 2.5], "name": "x", "on": true, "deep": [{"a": 1}, {"a": 2}], "none": null}'
    found = numbers_in_json(raw)
    assert found == {"t.sec": 1, "q": [1.0, 2.5], "on": True, "deep[0].a": 1, "deep[1].a": 2}
    assert numbers_in_json(b"3.5") == {"value": 3.5}
    with pytest.raises(LogError, match=r"Expected a message in JSON, got: Input data was truncated\."):
        numbers_in_json(b"{")
    assert len(numbers_in_json(b"[%b]" % b",".join([b"1"] * 5000))["value"]) == 5000  # a scan, whole
    assert len(numbers_in_json(b"[" * 40 + b"1" + b"]" * 40)) == 0  # deeper than any real measurement


def test_messages_become_fields() -> None:
    raws = [b'{"a": 1, "b": [1, 2]}', b"no", b'{"a": 2, "b": [3], "c": true}', b'{"a": 123456789012345678901}']
    decoded, bad, reason = decode_one_by_one([(k, 10 * k, raw) for k, raw in enumerate(raws)], numbers_in_json)
    assert (bad, reason) == (1, "Expected a message in JSON, got: Input data was truncated.")
    assert (decoded.sequence.tolist(), decoded.log_ns.tolist()) == ([0, 2, 3], [0, 20, 30])
    assert decoded.fields["a"].dtype == float  # one is larger than 64 bits
    np.testing.assert_array_equal(decoded.fields["b"], [[1, 2], [3, np.nan], [np.nan, np.nan]])
    np.testing.assert_array_equal(decoded.fields["c"][:, 0], [np.nan, 1, np.nan])
    for raw in (b'{"a": 1%b}' % (b"0" * 400), b'{"a": [2, -1%b]}' % (b"0" * 400), b"[" * 5000):
        decoded, bad, reason = decode_one_by_one([(0, 0, raw), (1, 1, b'{"a": 3}')], numbers_in_json)
        assert (decoded.fields["a"].tolist(), bad) == ([[3]], 1)
        assert reason.startswith("Expected a message in JSON, got: ")
    whole, *_ = decode_one_by_one([(0, 0, b'{"k": 1, "f": true}')], numbers_in_json)
    least, *_ = decode_one_by_one([(0, 0, b"%d" % -(2**63)), (1, 1, b"%d" % (2**63 - 1))], numbers_in_json)
    assert least.fields["value"].tolist() == [[-(2**63)], [2**63 - 1]]
    assert (whole.fields["k"].dtype.kind, whole.fields["f"].dtype.kind) == ("i", "b")


def test_one_long_message_does_not_ask_for_memory_in_all_rows() -> None:
    long = b"[%b]" % b",".join([b"1"] * 200_000)
    raws = [long, b"no", *[b"[1]"] * 4_000]
    decoded, bad, reason = decode_one_by_one(((k, k, raw) for k, raw in enumerate(raws)), numbers_in_json)
    assert (decoded.fields, len(decoded.sequence), bad) == ({}, 0, 4_002)
    assert reason.startswith("Expected arrays of similar size, got 4001 rows with 204000 numbers, up to 200000 in v")
    decoded, bad, _ = decode_one_by_one(((k, k, b'{"%d": %d}' % (k, k)) for k in range(2000)), numbers_in_json)
    assert bad == 0
    assert [decoded.fields[str(k)][k, 0] for k in range(2000)] == list(range(2000))
    assert np.isfinite(decoded.fields["7"]).sum() == 1


def test_protobuf() -> None:
    from google.protobuf import descriptor_pb2, struct_pb2, timestamp_pb2

    files = descriptor_pb2.FileDescriptorSet()
    for module in (timestamp_pb2, struct_pb2):
        module.DESCRIPTOR.CopyToProto(files.file.add())
    definition = files.SerializeToString()
    stamp = numbers_in_protobuf("google.protobuf.Timestamp", definition)
    assert stamp(timestamp_pb2.Timestamp(seconds=3, nanos=4).SerializeToString()) == {"seconds": 3, "nanos": 4}
    with pytest.raises(
        LogError, match=r"Expected a protobuf message of type google\.protobuf\.Timestamp, got: Error parsing"
    ):
        stamp(b"\x08")
    listed = struct_pb2.ListValue(values=[struct_pb2.Value(number_value=2.0), struct_pb2.Value(string_value="x")])
    found = numbers_in_protobuf("google.protobuf.ListValue", definition)(listed.SerializeToString())
    assert found["values[0].number_value"] == 2.0
    for name, data in (("google.protobuf.Nix", definition), ("google.protobuf.Timestamp", b"\xff\xff")):
        with pytest.raises(LogError, match=f"a protobuf definition of {name}"):
            numbers_in_protobuf(name, data)
