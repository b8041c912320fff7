"""The presets of the limits."""

from __future__ import annotations

from armlab.wire.labcomm import Decoder, Encoder, Limits, Sample, parse_lc


def test_presets() -> None:
    server, file = Limits.server(), Limits.file()
    assert (server.packet, server.values, server.definitions, server.nodes) == (65_536, 16_384, 1024, 65_536)
    assert (file.packet, file.values, file.definitions, file.nodes) == (2**24, 2**21, 4096, 2**20)
    assert (server.empty_rows, server.depth, server.name, server.dims, server.entries) == (256, 32, 255, 16, 64)


def test_a_file_may_hold_what_a_peer_may_not_send() -> None:
    (sample,) = parse_lc("sample float a[_];")
    encoder = Encoder()
    raw = encoder.version() + encoder.define(sample) + encoder.data(sample, [1.0] * 20_000)
    *_, event = Decoder(limits=Limits.file()).feed(raw)
    assert isinstance(event, Sample)
    assert len(event.value) == 20_000
