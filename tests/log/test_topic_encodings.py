"""JSON and protobuf, message by message."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log.topics.messages import decode_one_by_one, numbers_in_json, numbers_in_protobuf


def test_json() -> None:
    raw = b'{"t": {"sec": 1}, "q": [1, 2.5], "name": "x", "on": true, "deep": [{"a": 1}, {"a": 2}], "none": null}'
    found = numbers_in_json(raw)
    assert found == {"t.sec": 1, "q": [1.0, 2.5], "on": True, "deep[0].a": 1, "deep[1].a": 2}
    assert numbers_in_json(b"3.5") == {"value": 3.5}
    with pytest.raises(LogError, match=r"Expected a message in JSON, got: Input data was truncated\."):
        numbers_in_json(b"{")
    assert len(numbers_in_json(b"[%b]" % b",".join([b"1"] * 5000))["value"]) == 5000  # a scan, whole
    assert len(numbers_in_json(b"[" * 40 + b"1" + b"]" * 40)) == 0  # deeper than anything that measures


def test_messages_become_fields() -> None:
    raws = [b'{"a": 1, "b": [1, 2]}', b"no", b'{"a": 2, "b": [3], "c": true}', b'{"a": 123456789012345678901}']
    decoded, bad, reason = decode_one_by_one([(k, 10 * k, raw) for k, raw in enumerate(raws)], numbers_in_json)
    assert (bad, reason) == (1, "Expected a message in JSON, got: Input data was truncated.")
    assert decoded.sequence.tolist() == [0, 2, 3]
    assert decoded.log_ns.tolist() == [0, 20, 30]
    assert decoded.fields["a"].dtype == float  # one is larger than 64 bits
    np.testing.assert_array_equal(decoded.fields["b"], [[1, 2], [3, np.nan], [np.nan, np.nan]])
    np.testing.assert_array_equal(decoded.fields["c"][:, 0], [np.nan, 1, np.nan])
    whole, *_ = decode_one_by_one([(0, 0, b'{"k": 1, "f": true}')], numbers_in_json)
    least, *_ = decode_one_by_one([(0, 0, b"%d" % -(2**63)), (1, 1, b"%d" % (2**63 - 1))], numbers_in_json)
    assert least.fields["value"].tolist() == [[-(2**63)], [2**63 - 1]]
    assert (whole.fields["k"].dtype.kind, whole.fields["f"].dtype.kind) == ("i", "b")


@pytest.mark.parametrize("raw", [b'{"a": 1%b}' % (b"0" * 400), b'{"a": [2, -1%b]}' % (b"0" * 400), b"[" * 5000])
def test_numbers_that_no_real_number_holds_and_endless_lists(raw: bytes) -> None:
    decoded, bad, reason = decode_one_by_one([(0, 0, raw), (1, 1, b'{"a": 3}')], numbers_in_json)
    assert decoded.fields["a"].tolist() == [[3]]
    assert bad == 1
    assert reason.startswith("Expected a message in JSON, got: ")


def test_one_long_message_does_not_ask_for_memory_in_all_rows() -> None:
    """Ten megabytes of messages, 480 GB of columns; and as many names as messages, just below what is refused."""
    long = b"[%b]" % b",".join([b"1"] * 1_000_000)
    decoded, bad, reason = decode_one_by_one(
        ((k, k, raw) for k, raw in enumerate([long, b"no", *[b"[1]"] * 60_000])), numbers_in_json
    )
    assert decoded.fields == {}
    assert len(decoded.sequence) == 0
    assert bad == 60_002
    assert reason.startswith(
        "Expected values that are alike, got 60001 rows with 1060000 numbers, up to 1000000 in value"
    )
    decoded, bad, _ = decode_one_by_one(((k, k, b'{"%d": %d}' % (k, k)) for k in range(5000)), numbers_in_json)
    assert bad == 0
    assert [decoded.fields[str(k)][k, 0] for k in range(5000)] == list(range(5000))
    assert np.isfinite(decoded.fields["7"]).sum() == 1


def test_protobuf() -> None:
    from google.protobuf import descriptor_pb2, struct_pb2, timestamp_pb2

    files = descriptor_pb2.FileDescriptorSet()
    for module in (timestamp_pb2, struct_pb2):
        module.DESCRIPTOR.CopyToProto(files.file.add())
    definition = files.SerializeToString()
    stamp = numbers_in_protobuf("google.protobuf.Timestamp", definition)
    assert stamp(timestamp_pb2.Timestamp(seconds=3, nanos=4).SerializeToString()) == {"seconds": 3, "nanos": 4}
    with pytest.raises(LogError, match=r"Expected a google\.protobuf\.Timestamp in protobuf, got: Error parsing"):
        stamp(b"\x08")
    listed = struct_pb2.ListValue(values=[struct_pb2.Value(number_value=2.0), struct_pb2.Value(string_value="x")])
    found = numbers_in_protobuf("google.protobuf.ListValue", definition)(listed.SerializeToString())
    assert found["values[0].number_value"] == 2.0
    for name, data in (("google.protobuf.Nix", definition), ("google.protobuf.Timestamp", b"\xff\xff")):
        with pytest.raises(LogError, match=f"the definition of {name} in protobuf"):
            numbers_in_protobuf(name, data)
