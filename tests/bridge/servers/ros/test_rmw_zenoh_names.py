"""Golden bytes and texts of rmw_zenoh's dialect."""

from __future__ import annotations

import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.bridge.servers.ros import store
from armlab.bridge.servers.ros.rmw_zenoh import ANY, Distribution, Names, Origin, Writer
from armlab.errors import MissingExtra

JOINTS, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
NAMES = Names(0, "aac3178e146ba6f1fc6e6a4085e77f21")


def test_keys_of_data() -> None:
    key = f"0/yumi_left/joint_states/sensor_msgs::msg::dds_::JointState_/{HASH}"
    assert NAMES.data("/yumi_left/joint_states", JOINTS) == key
    assert NAMES.data("/a/b", ARRAY, ANY) == "0/a/b/std_msgs::msg::dds_::Float64MultiArray_/*"
    humble: Distribution = "humble"
    old = Names(7, "1", humble).data("/joint_states", JOINTS)
    assert old == "7/joint_states/sensor_msgs::msg::dds_::JointState_/TypeHashNotSupported"
    assert NAMES.hash(JOINTS) == HASH == store().hash_rihs01(JOINTS)


def test_tokens() -> None:
    start = "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0"
    assert NAMES.node() == f"{start}/0/NN/%/%/armlab"
    about = f"%yumi_left%joint_states/sensor_msgs::msg::dds_::JointState_/{HASH}"
    assert NAMES.writer(10, "/yumi_left/joint_states", JOINTS) == f"{start}/10/MP/%/%/armlab/{about}/::,10:,:,:,,"
    assert NAMES.reader(2, "/yumi_left/joint_states", JOINTS) == f"{start}/2/MS/%/%/armlab/{about}/2::,1:,:,:,,"


def test_the_attachment_is_what_zenoh_serialises() -> None:
    ext = pytest.importorskip("zenoh.ext", reason="the extra net is not installed")
    id_ = bytes(range(16))
    expected = ext.z_serialize((ext.Int64(3), ext.Int64(1_700_000_000_000_000_000), id_)).to_bytes()
    assert Origin(3, 1_700_000_000_000_000_000, id_).pack() == expected
    assert len(expected) == 33
    assert Origin.read(expected) == (3, 1_700_000_000_000_000_000, id_)


def test_messages_of_a_writer_are_numbered_from_one() -> None:
    pytest.importorskip("xxhash", reason="the extra net is not installed")
    writer = Writer("")
    assert writer.id[::-1].hex() == "99aa06d3014798d86001c324468d497f", "XXH3-128 of nothing, by its own test vectors"
    found = [Origin.read(writer.next(stamp)) for stamp in (5, 6)]
    assert found == [(1, 5, writer.id), (2, 6, writer.id)]
    assert Writer("a").id != Writer("b").id


@given(st.binary(max_size=50))
def test_other_attachments_are_none(data: bytes) -> None:
    found = Origin.read(data)
    assert (found is not None) == (len(data) == 33 and data[16] == 16)
    if found is not None:
        assert found.pack() == data
        assert len(found.client) == 32
    assert Origin.read(None) is None


def test_without_xxhash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xxhash", None)
    with pytest.raises(MissingExtra, match=r"armlab\[net\]"):
        Writer("")
