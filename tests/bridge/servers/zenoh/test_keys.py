"""Names and attachments on Zenoh, byte by byte."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.bridge.servers.zenoh.keys import COMMANDS, EVERY, Attached, key, robot_of
from armlab.errors import CommandRefused


def test_names() -> None:
    assert key("lab1", "yumi_left", "state") == "armlab/lab1/yumi_left/state"
    assert key("lab1", EVERY, "alive") == "armlab/lab1/*/alive"
    assert robot_of("armlab/lab1/yumi_left/param/gain") == ("lab1", "yumi_left")
    assert COMMANDS == {"position": "q", "velocity": "qd", "effort": "tau", "motion": "q qd"}


def test_golden_attachment() -> None:
    one = Attached(bytes(range(16)), 1, -2)
    assert one.pack().hex() == "000102030405060708090a0b0c0d0e0f0100000000000000feffffffffffffff"
    assert one.client == "000102030405060708090a0b0c0d0e0f"
    assert Attached(b"labpc-" + b"A" * 10, 1, 0).client != Attached(b"labpc-" + b"B" * 10, 1, 0).client


@given(st.binary(max_size=80))
def test_attachments_are_read_or_refused(data: bytes) -> None:
    if len(data) == 32:
        assert Attached.read(data) == Attached(data[:16], *struct.unpack("<qq", data[16:]))
        assert Attached.read(data).pack() == data
    else:
        with pytest.raises(CommandRefused, match=f"got {len(data)} bytes"):
            Attached.read(data)


def test_no_attachment() -> None:
    with pytest.raises(CommandRefused, match="got none"):
        Attached.read(None)
