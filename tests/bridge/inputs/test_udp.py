"""Datagrams of another program."""

from __future__ import annotations

import json
import select
import socket
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.bridge import UdpSource
from armlab.errors import ConfigError, LinkError
from armlab.log import Column

FIELDS = {"wrench": Column((6,))}
LAYOUT = {"seq": "<u4", "stamp_ns": "<i8", "wrench": "<f8"}
PACK = struct.Struct("<Iq6d")


class Sender:
    def __init__(self, source: UdpSource) -> None:
        self.source = source
        source.start()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def __call__(self, *data: bytes) -> None:
        for one in data:
            self.socket.sendto(one, (self.source.host, self.source.port))

    def close(self) -> None:
        self.source.close()
        self.socket.close()


@pytest.fixture
def force() -> Iterator[Sender]:
    sender = Sender(UdpSource("force", FIELDS, 0.001, 0, LAYOUT))
    yield sender
    sender.close()


def test_the_newest_counts_and_gaps_are_counted(force: Sender) -> None:
    assert force.source.newest() is None
    force(PACK.pack(2, 20, *np.zeros(6)))
    force.source.newest()
    force(*(PACK.pack(seq, 10 * seq, *np.arange(6.0) + seq) for seq in (3, 4, 7)))
    reading = force.source.newest()
    assert reading is not None
    assert (reading.seq, reading.source_ns, reading.gaps) == (7, 70, 2)
    np.testing.assert_array_equal(reading.values["wrench"], np.arange(6.0) + 7)
    assert force.source.newest() is reading
    force(PACK.pack(0, 5, *np.zeros(6)))
    restarted = force.source.newest()
    assert restarted is not None
    assert (restarted.seq, restarted.gaps) == (0, 2)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "1e400", "NaN", "18446744073709551616", '"1"', "null", "[1]"])
def test_numbers_beyond_64_bits_are_dropped(number: str) -> None:
    """Each of them ended a run: the log has them as floats, and stamps are mapped."""
    sender = Sender(UdpSource("force", {"p": Column(unit="m")}, 0.001, 0))
    for name in ("seq", "stamp_ns"):
        sender(b'{"p": 1.0, "%s": %s}' % (name.encode(), number.encode()))
        assert sender.source.newest() is None
    assert sender.source.drops == 2
    sender(b'{"p": 2.0, "seq": -18446744073709551615}')
    sender.source.newest()
    sender(b'{"p": 2.0, "seq": 18446744073709551615}')
    reading = sender.source.newest()
    assert reading is not None
    assert reading.gaps == 2**53
    sender.close()


def test_json() -> None:
    sender = Sender(UdpSource("force", FIELDS, 0.001, 0))
    sender(json.dumps({"wrench": [1, 2, 3, 4, 5, 6]}).encode())
    first = sender.source.newest()
    sender(json.dumps({"wrench": [0] * 6, "seq": 5, "stamp_ns": 12}).encode(), b'{"torque": 1}', b"[1]", b"{")
    second = sender.source.newest()
    assert first is not None
    assert second is not None
    assert (first.seq, first.source_ns, second.seq, second.source_ns) == (0, 0, 5, 12)
    assert sender.source.drops == 3
    assert "could not be read" in sender.source.problem
    sender.close()


@settings(max_examples=200)
@given(data=st.binary(max_size=200))
def test_any_datagram_is_a_reading_or_a_drop(data: bytes) -> None:
    for layout in (LAYOUT, "json"):
        source = UdpSource("force", FIELDS, 0.001, 0, layout)  # type: ignore[arg-type]
        source._take(data, 1, 1)
        assert (source.newest() is None) == (source.drops == 1)


def test_what_came_before_the_start_is_not_there(force: Sender) -> None:
    force(PACK.pack(0, 0, *np.zeros(6)))
    force.source.close()
    force.source.start()
    assert not select.select([force.source._port], [], [], 0.0)[0]


@pytest.mark.parametrize(
    "layout",
    [{"seq": "<u4"}, {"wrench": "<f8", "torque": "<f8"}, {"wrench": "U3"}, {"wrench": "no type"}],
)
def test_wrong_layouts(layout: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="layout"):
        UdpSource("force", FIELDS, 0.001, 0, layout)


def test_a_port_in_use(force: Sender) -> None:
    with pytest.raises(LinkError, match="in use"):
        UdpSource("other", FIELDS, 0.001, force.source.port).start()
