"""Fuzz targets for socket input: EGM, LabComm, and CDR messages."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from armlab import log, robots
from armlab.bridge.control.session import Session
from armlab.bridge.net.sockets import Arrival
from armlab.errors import ArmlabError, LabCommError, LogError
from armlab.wire import cdr
from armlab.wire.egm import Drop, EgmCodec, Packet, Reference
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec
from armlab.wire.labcomm import Decoder, Sample, parse_lc, to_lc
from armlab.wire.labcomm.encoder import write_packet

_FOLDER = tempfile.TemporaryDirectory(prefix="armlab-fuzz-")
_ARMS = ("yumi_left", "irb120", "irb2400")
_CLOSE = {"rtol": 1e-12, "atol": 1e-300, "equal_nan": True}


def pieces(data: bytes) -> Iterator[bytes]:
    """Yield the data after each length (uint16, big-endian)."""
    while len(data) >= 2:
        stop = 2 + int.from_bytes(data[:2], "big")
        yield data[2:stop]
        data = data[stop:]


@cache
def _arm(number: int) -> Any:
    return robots.load(_ARMS[number % len(_ARMS)])


def egm_robot(data: bytes) -> None:
    """Two robot packets: the first defines the layout, and decoding the second must equal parsing it anew."""
    arm = _arm(data[0] if data else 0)
    codec = EgmCodec(arm, extension=True)
    found = Drop("unparsable", "")
    for packet in list(pieces(data[1:]))[:4]:
        fresh = EgmCodec(arm, extension=True)
        fresh.robotware = codec.robotware
        found, parsed = codec.decode(packet), fresh.decode(packet)
        assert _same(found, parsed), (found, parsed)
        codec.details(packet)
    if isinstance(found, Packet) and np.abs(found.q).max() < 1e300:  # otherwise the conversion to degrees overflows
        _said_again(arm, found)


def _same(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    return all(
        np.array_equal(x, y, equal_nan=True) if isinstance(x, np.ndarray) else x == y or x != x for x, y in zip(a, b)
    )


def _said_again(arm: Any, packet: Packet) -> None:
    """Check that the robot side decodes its own encoding of a packet."""
    said = RobotMessage(packet.seqno, packet.tm_ms, packet.q, utilization=packet.utilization)
    heard = EgmCodec(arm).decode(RobotSideCodec(arm, "6.10").encode_robot(said))
    assert isinstance(heard, Packet), heard
    assert (heard.seqno, heard.tm_ms) == (packet.seqno, packet.tm_ms)
    np.testing.assert_allclose(heard.q, packet.q, **_CLOSE)


def egm_sensor(data: bytes) -> None:
    """Reply to the robot; the bridge must reproduce its references when encoding them."""
    arm = _arm(data[0] if data else 0)
    side = RobotSideCodec(arm)
    found = side.decode_sensor(data[1:])
    if isinstance(found, Drop) or found.q is None or not np.isfinite(found.q).all() or np.abs(found.q).max() > 1e300:
        return
    reference = Reference(found.q, None, None, found.seqno or 0, found.tm_ms or 0)
    again = side.decode_sensor(EgmCodec(arm).encode(reference))
    assert not isinstance(again, Drop), again
    np.testing.assert_allclose(again.q, found.q, **_CLOSE)


def egm_session(data: bytes) -> None:
    """Packets, each preceded by a two-byte port and a two-byte time."""
    session, ns = Session(EgmCodec(_arm(data[0] if data else 0))), 10**12
    for piece in pieces(data[1:]):
        if len(piece) >= 2:
            ns += 4_000_000 * piece[1] // 16
            sample = session.accept(Arrival(piece[2:], ("127.0.0.1", 6510 + piece[0] % 2), ns))
            assert sample is None or np.isfinite(sample.qd).all()
            session.replied(ns)
    session.end()


def labcomm(data: bytes) -> None:
    """Stream fed in one piece and in many: events, faults and re-encoded events must be equal; also read as a log."""
    cut, stream = 1 + (data[0] if data else 0), data[1:]
    whole, fault = _events(stream, len(stream) + 1)
    parts, same = _events(stream, cut)
    assert repr(whole) == repr(parts)
    assert (fault is None) == (same is None)
    assert fault is None or same is None or (str(fault), fault.offset) == (str(same), same.offset)
    dialect = _dialect(stream)
    if whole and dialect is not None:
        written = b"".join(write_packet(event, dialect) for event in whole)
        again, refused = _events(written, len(written) + 1)
        assert refused is None, refused
        assert repr(again) == repr(whole)
    if any(isinstance(event, Sample) for event in whole):
        _as_log(stream)


def _as_log(stream: bytes) -> None:
    path = Path(_FOLDER.name) / "stream"
    path.write_bytes(stream)
    for rate in (None, 250.0):
        with contextlib.suppress(ArmlabError):
            log.read_labcomm(path, rate=rate)


def _events(stream: bytes, size: int) -> tuple[list[Any], LabCommError | None]:
    decoder, found = Decoder(), []
    try:
        for start in range(0, len(stream), size):
            found += decoder.feed(stream[start : start + size])
        decoder.close()
    except LabCommError as error:
        return [*found, *error.events], error
    return found, None


def _dialect(stream: bytes) -> str | None:
    decoder = Decoder()
    with contextlib.suppress(LabCommError):
        decoder.feed(stream)
    return decoder.dialect


def _language(text: str) -> None:
    """Check that re-encoded declarations declare the same types."""
    try:
        found = parse_lc(text, "2014i")
        again = parse_lc(to_lc(found), "2014i")
    except LabCommError:
        return
    assert again == found


def definitions(data: bytes) -> None:
    """LabComm declarations, or the definition of a ROS message type followed by NUL and a CDR message."""
    text, _, raw = data.partition(b"\0\0")
    _language(text.decode(errors="replace"))
    name = "a/msg/B"
    encoding = "ros2idl" if text.startswith(b"module") else "ros2msg"
    try:
        types = cdr.definitions(name, text.decode(errors="replace"), encoding)
        if name in types:
            found = cdr.layout(raw, name, types)
            assert all(field.stop <= len(raw) for field in found.fields)
    except LogError:
        pass
