"""Mutated streams: only LabCommError comes out, soon, and without memory."""

from __future__ import annotations

import random
import time
import tracemalloc
from pathlib import Path

import pytest

from armlab.errors import LabCommError
from armlab.wire.labcomm import Decoder

SLOWEST = 5.0  # s of processor time per stream: one that a number in it makes long takes minutes, a slow machine 0.6
LARGEST = 16 * 2**20  # bytes


@pytest.fixture(scope="module")
def seeds(folder: Path) -> list[bytes]:
    found = [path.read_bytes() for path in sorted(folder.rglob("*.bin"))]
    return [raw for raw in found if 0 < len(raw) < 4000]


def mutated(rng: random.Random, seeds: list[bytes]) -> bytes:
    raw = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if not raw:
            break
        at, what = rng.randrange(len(raw)), rng.randrange(7)
        if what == 0:
            raw[at] = rng.randrange(256)
        elif what == 1:
            raw[at] ^= 1 << rng.randrange(8)
        elif what == 2:
            raw[at] = rng.choice((0x00, 0x01, 0x02, 0x10, 0x11, 0x27, 0x40, 0x7F, 0x80, 0xFF))
        elif what == 3:
            del raw[at : at + rng.randint(1, 8)]
        elif what == 4:
            raw[at:at] = rng.randbytes(rng.randint(1, 8))
        elif what == 5:
            other = rng.choice(seeds)
            raw[at:] = other[rng.randrange(len(other)) :]
        else:
            raw[at:at] = b"\xff\xff\xff\xff\x7f"
    return bytes(raw)


def fuzz(count: int, seed: int, seeds: list[bytes]) -> int:
    """Decode mutated streams; return how many were refused."""
    rng, refused = random.Random(seed), 0
    for _ in range(count):
        raw = mutated(rng, seeds)
        start = time.process_time()
        decoder, offset = Decoder(), 0
        try:
            cut = rng.randrange(len(raw) + 1)
            decoder.feed(raw[:cut])
            decoder.feed(raw[cut:])
            decoder.close()
        except LabCommError as error:
            refused += 1
            offset = error.offset
        assert offset is not None, raw.hex()
        assert 0 <= offset <= len(raw), raw.hex()
        assert time.process_time() - start < SLOWEST, raw.hex()
    return refused


def test_mutated_streams(seeds: list[bytes]) -> None:
    assert fuzz(20_000, 1, seeds) > 5_000


@pytest.mark.slow  # a quarter of a minute each, on a busy machine a whole one
@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_a_million_mutated_streams(seed: int, seeds: list[bytes]) -> None:
    """A million in four parts, which run beside each other; the target of fuzz/ looks for others."""
    assert fuzz(250_000, seed, seeds) > 60_000


def test_the_memory_of_a_hostile_stream(seeds: list[bytes]) -> None:
    """Mutants, and streams that announce as much as they may."""
    rng = random.Random(3)
    version = b"\x01\x0f\x0eLabComm2014.v1"
    hostile = [
        version + b"\x02\x09\x40\x01a\x05\x10\x02\x00\x00\x23" + b"\x40\x06\x82\x00\xff\x7f" + b"\0" * 2,
        version + b"\x02\x09\x40\x01a\x05\x10\x02\x00\x00\x27" + b"\x40\x83\xff\x7f\x81\x80\x00\x00" + b"\0" * 65_531,
        version + b"\x02\x07\x40\x01a\x04\x10\x01\x00\x27" + b"\x40\x83\xff\x7f\x83\xff\x7c" + b"\0" * 65_532,
        version + b"".join(b"\x02\x0b\xc0" + bytes([k >> 7 & 0x7F | 0x80, k & 0x7F]) + b"\0\x05" for k in range(1000)),
    ]
    tracemalloc.start()
    try:
        for raw in hostile + [mutated(rng, seeds) for _ in range(300)]:
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            decoder = Decoder()
            try:
                decoder.feed(raw)
                decoder.close()
            except LabCommError:
                pass
            _, peak = tracemalloc.get_traced_memory()
            assert peak - before < LARGEST, raw[:80].hex()
    finally:
        tracemalloc.stop()
