"""`Decoder`, also with arbitrary bytes."""

from __future__ import annotations

import random
import struct
import time
import tracemalloc
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import LabCommError
from armlab.wire.labcomm import Decoder, Encoder, Limits, Sample, parse_lc, to_lc
from armlab.wire.labcomm.types import (
    DIALECTS,
    PRIMS,
    VOID,
    Array,
    Definition,
    Field,
    Prim,
    SampleType,
    Struct,
    Type,
    Unknown,
    Version,
)

NAMES = st.from_regex(r"\Af_[a-z0-9]{0,4}\Z")
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=6)
NUMBERS = {"byte": (0, 255), "short": (-(2**15), 2**15 - 1), "int": (-(2**31), 2**31 - 1), "sample": (0, 9)}


def trees(with_refs: bool, with_notes: bool) -> st.SearchStrategy[Type]:
    prims = st.sampled_from([prim for name, prim in PRIMS.items() if with_refs or name != "sample"])
    notes = st.sampled_from([(), (("unit", "rad"),)]) if with_notes else st.just(())

    def grow(inner: st.SearchStrategy[Type]) -> st.SearchStrategy[Type]:
        arrays = st.builds(Array, st.lists(st.integers(0, 3), min_size=1, max_size=3).map(tuple), inner)
        fields = st.lists(st.builds(Field, NAMES, inner, notes), min_size=1, max_size=4, unique_by=lambda f: f.name)
        return arrays | st.builds(Struct, fields.map(tuple))

    return st.just(VOID) | prims | grow(prims | grow(prims | grow(prims)))


def values(node: Type) -> st.SearchStrategy[Any]:
    if isinstance(node, Struct):
        return st.fixed_dictionaries({field.name: values(field.type) for field in node.fields})
    if isinstance(node, Array):
        return shapes(node.dims).flatmap(lambda sizes: nested(sizes, node.elem))
    name = node.name if isinstance(node, Prim) else ""
    if name in ("float", "double"):
        return st.floats(width=32 if name == "float" else 64)
    if name == "string":
        return TEXTS
    return st.booleans() if name == "boolean" else st.integers(*NUMBERS.get(name, (-(2**63), 2**63 - 1)))


def shapes(dims: tuple[int, ...]) -> st.SearchStrategy[tuple[int, ...]]:
    return st.tuples(*[st.just(size) if size else st.integers(0, 2) for size in dims])


def nested(sizes: tuple[int, ...], elem: Type) -> st.SearchStrategy[Any]:
    if not sizes:
        return values(elem)
    return st.lists(nested(sizes[1:], elem), min_size=sizes[0], max_size=sizes[0])


def bits(value: Any) -> Any:
    """Return a value with floats as their bits and rows of bytes as lists."""
    if isinstance(value, float):
        return struct.pack(">d", value)
    if isinstance(value, dict):
        return {name: bits(part) for name, part in value.items()}
    return [bits(part) for part in value] if isinstance(value, list | bytes) else value


@st.composite
def streams(draw: st.DrawFn) -> tuple[str, SampleType, Any]:
    dialect = draw(st.sampled_from([name for name in DIALECTS if name != "2014old"]))
    node = draw(trees(DIALECTS[dialect].references, DIALECTS[dialect].maps))
    return dialect, SampleType("it", node), draw(values(node))


@settings(max_examples=30)
@given(streams(), st.lists(st.integers(1, 30), max_size=8))
def test_decode_inverts_encode(stream: tuple[str, SampleType, Any], cuts: list[int]) -> None:
    dialect, sample, value = stream
    assert parse_lc(to_lc([sample]), dialect) == [sample]
    encoder = Encoder(dialect)
    raw = encoder.version() + encoder.define(sample) + encoder.data(sample, value) * 2
    decoder = Decoder()
    events = decoder.feed(raw)
    decoder.close()
    assert bits(events[-1].value) == bits(value)
    assert (decoder.dialect, decoder.samples) == (dialect, {0x40: sample})
    again, decoder, stops = [], Decoder(), [0, *accumulate(cuts), len(raw)]
    for start, stop in pairwise(stops):
        again += decoder.feed(raw[start:stop])
    assert [(type(e), bits(getattr(e, "value", None))) for e in again] == [
        (type(e), bits(getattr(e, "value", None))) for e in events
    ]


def stream(text: str, *rows: Any, dialect: str = "2014v1") -> bytes:
    (sample,) = parse_lc(text)
    encoder = Encoder(dialect, allow_nul=True)
    return encoder.version() + encoder.define(sample) + b"".join(encoder.data(sample, row) for row in rows)


def test_fields_that_are_read_together_keep_their_order_and_their_names() -> None:
    doubles = Array((2,), PRIMS["double"])
    names = {"": "string", "a": "short", "i": "int", "s": "string", "b": "long", "t": "string"}
    fields = [Field(name, PRIMS[kind]) for name, kind in names.items()]
    kind = SampleType("n", Struct((*fields, Field("c", doubles), Field("d", PRIMS["float"]))))
    value = {"": "y", "a": 2, "i": 1, "s": "x", "b": 3, "t": "", "c": [4.0, 5.0], "d": 6.0}
    encoder, decoder = Encoder(), Decoder()
    decoder.feed(encoder.version() + encoder.define(kind))
    packet = encoder.data(kind, value)
    assert packet[2:].hex(" ") == (
        "01 79 00 02 00 00 00 01 01 78 00 00 00 00 00 00 00 03 00 40 10 00 00 00 00 00 00 40 14 00 00 00 00 "
        "00 00 40 c0 00 00"
    )
    (event,) = decoder.feed(packet)
    assert isinstance(event, Sample)
    assert list(event.value.items()) == list(value.items())


def test_an_error_is_raised_again_and_keeps_the_events_before_it() -> None:
    raw = stream("sample int n;", 7)
    decoder = Decoder()
    with pytest.raises(LabCommError, match="at byte 31") as caught:
        decoder.feed(raw + b"\x40\x03abc")
    assert [type(event) for event in caught.value.events] == [Version, Definition, Sample]
    with pytest.raises(LabCommError) as again:
        decoder.feed(b"")
    assert again.value is caught.value
    decoder.close()


def test_the_end_within_a_packet_is_an_error() -> None:
    raw = stream("sample int n;", 7)
    decoder = Decoder()
    decoder.feed(raw[:-1])
    assert (decoder.pending, decoder.offset) == (5, len(raw) - 6)
    with pytest.raises(LabCommError, match="after 5 bytes") as caught:
        decoder.close()
    assert caught.value.offset == len(raw) - 6
    decoder = Decoder()
    decoder.feed(raw)
    decoder.close()
    with pytest.raises(LabCommError, match="after close"):
        decoder.feed(b"x")


def test_streams_without_version_need_a_dialect() -> None:
    with pytest.raises(LabCommError, match="a dialect for a stream"):
        Decoder(require_version=False)
    raw = stream("sample int n;", 7)[17:]
    with pytest.raises(LabCommError, match="VERSION of 2014v1"):
        Decoder("2014v1").feed(raw)
    *_, event = Decoder("2014v1", require_version=False).feed(raw)
    assert event == Sample(0x40, "n", 7, PRIMS["int"])


def test_a_given_dialect_is_the_only_one_taken() -> None:
    with pytest.raises(LabCommError, match=r"Expected LabComm2014 at byte 2"):
        Decoder("2014i").feed(stream("sample int n;", 7))
    events = Decoder("2014").feed(stream("sample int n;", 7, dialect="2014"))
    assert len(events) == 3


def test_data_of_an_undefined_index_is_skipped() -> None:
    raw = stream("sample int n;") + b"\x50\x02ab" + b"\x40\x04\0\0\0\1"
    assert Decoder().feed(raw)[-2:] == [Unknown(0x50, b"ab"), Sample(0x40, "n", 1, PRIMS["int"])]


def test_another_definition_of_an_index_replaces_the_first() -> None:
    raw = stream("sample int n;", 7) + b"\x02\x05\x40\x01s\x01\x27" + b"\x40\x03\x02hi"
    assert Decoder().feed(raw)[-1] == Sample(0x40, "s", "hi", PRIMS["string"])


@pytest.mark.parametrize(
    ("raw", "text"),
    [
        (b"\xed\xa0\xbe\xed\xb4\x96", "\U0001f916"),
        (b"a\xc0\x80b", "a\0b"),
        (b"\xff\xfe", "\udcff\udcfe"),
        (b"\xed\xa0\xbe", "\udced\udca0\udcbe"),
        ("å".encode(), "å"),
    ],
)
def test_strings_of_other_languages(raw: bytes, text: str) -> None:
    data = stream("sample string s;") + b"\x40" + bytes([len(raw) + 1, len(raw)]) + raw
    event = Decoder().feed(data)[-1]
    assert event == Sample(0x40, "s", text, PRIMS["string"])
    if "\udcff" in text or "\udced" in text:
        assert stream("sample string s;", text) == data, "escaped bytes are written as they were"


def test_values_of_a_packet_are_counted_together() -> None:
    text = "sample struct { int a[_]; int b[_]; } s;"
    limits = Limits(packet=65_536, values=100, definitions=4, nodes=100)
    row = {"a": [1] * 60, "b": [1] * 37}
    assert len(Decoder(limits=limits).feed(stream(text, row))) == 3
    with pytest.raises(LabCommError, match="at most 100 values"):
        Decoder(limits=limits).feed(stream(text, {"a": [1] * 60, "b": [1] * 38}))


@pytest.mark.parametrize("dialect", ["2013", "2006"])
def test_a_value_without_length_is_bounded(dialect: str) -> None:
    raw = stream("sample string s;", "x" * 70_000, dialect=dialect)
    decoder = Decoder()
    decoder.feed(raw[:16])
    with pytest.raises(LabCommError, match="ends within its packet"):
        decoder.feed(raw[16:100])
    assert decoder.pending < 100


def test_lengths_of_2014old_are_not_believed() -> None:
    raw = (
        b"\x01\x0d\x0bLabComm2014"
        + b"\x02\x08\x40\x01n\x04\x10\x01\x00\x23"
        + b"\x40\x09\x01\0\0\0\7"
        + b"\x40\x01\x00"
    )
    decoder = Decoder()
    assert [event.value for event in decoder.feed(raw) if isinstance(event, Sample)] == [[7], []]
    assert decoder.dialect == "2014old"


SLOWEST = 5.0  # s of processor time per stream: 0.6 on a slow machine, minutes if a number in the stream inflates it
LARGEST = 16 * 2**20  # bytes


@pytest.fixture(scope="module")
def seeds(folder: Path) -> list[bytes]:
    found = [path.read_bytes() for path in sorted(folder.rglob("*.bin"))]
    return [raw for raw in found if 0 < len(raw) < 4000]


def mutated(rng: random.Random, seeds: list[bytes]) -> bytes:
    raw = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at, other = rng.randrange(len(raw) + 1), rng.choice(seeds)
        changes = (
            (at + 1, rng.randbytes(1)),
            (at + 1, rng.choice((b"\x00", b"\x01", b"\x02", b"\x10", b"\x11", b"\x27", b"\x40", b"\x7f", b"\x80"))),
            (at + rng.randint(1, 8), b""),
            (at, rng.randbytes(rng.randint(1, 8))),
            (len(raw), other[rng.randrange(len(other)) :]),
            (at, b"\xff\xff\xff\xff\x7f"),
        )
        stop, new = rng.choice(changes)
        raw[at:stop] = new
    return bytes(raw)


def fuzz(count: int, seed: int, seeds: list[bytes]) -> int:
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
    assert fuzz(5_000, 1, seeds) > 1_250


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_many_mutated_streams(seed: int, seeds: list[bytes]) -> None:
    assert fuzz(60_000, seed, seeds) > 14_300


def test_the_memory_of_a_hostile_stream(seeds: list[bytes]) -> None:
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
