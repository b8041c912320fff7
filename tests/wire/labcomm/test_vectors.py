"""Streams of the C, Java, C# and Python libraries: read as their manifest says, written again byte for byte."""

from __future__ import annotations

import random
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from armlab.errors import LabCommError
from armlab.wire.labcomm import Decoder, Encoder, Sample, parse_lc
from armlab.wire.labcomm.encoder import write_packet
from armlab.wire.labcomm.types import (
    Array,
    Binding,
    Definition,
    Event,
    Other,
    Pragma,
    Prim,
    SampleType,
    Type,
    TypeRef,
    Unknown,
    Version,
)

DIALECTS = ["2014v1", "2014", "2014i", "2014old", "2013", "2006"]
KINDS = {"sample": "sample_def", "ref": "sample_ref", "type": "type_def"}
NAMES = {Version: "version", Binding: "type_binding", Pragma: "pragma", Other: "other", Sample: "sample"}


def tree(node: Type) -> Any:
    if isinstance(node, Prim):
        return node.name
    if isinstance(node, TypeRef):
        return ["typeref", node.index]
    if isinstance(node, Array):
        return ["array", list(node.dims), tree(node.elem)]
    fields = [[f.name, tree(f.type), *([dict(f.notes)] if f.notes else [])] for f in node.fields]
    return ["struct", fields]


def plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, list):
        return [plain(one) for one in value]
    if isinstance(value, dict):
        return [(name, plain(one)) for name, one in value.items()]
    if isinstance(value, float):
        return repr(value).strip("'")
    return value


def expected(value: Any, like: Any) -> Any:
    if isinstance(like, dict):
        return [(name, expected(value[name], one)) for name, one in like.items()]
    if isinstance(like, list | bytes):
        return [expected(a, b) for a, b in zip(value, like, strict=True)]
    return (value if isinstance(value, str) else repr(float(value))) if isinstance(like, float) else value


def kind(event: Event) -> str:
    if isinstance(event, Definition):
        return KINDS[event.kind]
    return "sample" if isinstance(event, Unknown) else NAMES[type(event)]


def agrees(event: Event, packet: dict[str, Any]) -> None:
    assert kind(event) == packet["kind"]
    if isinstance(event, Version):
        assert event.text == packet["text"]
    elif isinstance(event, Definition):
        assert (event.index, event.name, tree(event.type)) == (packet["index"], packet["name"], packet["type"])
    elif isinstance(event, Binding):
        assert event == (packet["sample_index"], packet["type_index"])
    elif isinstance(event, Sample):
        assert (event.index, event.name) == (packet["tag"], packet["name"])
        assert plain(event.value) == expected(packet["value"], event.value)


def pieces(raw: bytes, seed: int) -> list[bytes]:
    rng, cuts = random.Random(seed), [0]
    while cuts[-1] < len(raw):
        cuts.append(cuts[-1] + rng.randint(1, 40))
    return [raw[a:b] for a, b in pairwise(cuts)]


def events_of(parts: list[bytes], decoder: Decoder | None = None) -> tuple[list[Event], int | None]:
    decoder, events = decoder or Decoder(), []
    try:
        for part in parts:
            events += decoder.feed(part)
        decoder.close()
    except LabCommError as error:
        return events + error.events, error.offset
    return events, None


@pytest.mark.parametrize("dialect", DIALECTS)
def test_streams_are_read_and_written_as_the_manifest_says(
    dialect: str, manifest: dict[str, Any], folder: Path
) -> None:
    vectors = [one for one in manifest["vectors"] if one["dialect"] == dialect]
    assert len(vectors) >= 20
    for vector in vectors:
        raw, decoder = (folder / vector["file"]).read_bytes(), Decoder()
        events, offset = events_of([raw], decoder)
        assert offset is None, vector["file"]
        again = b""
        for event, packet in zip(events, vector["packets"], strict=True):
            agrees(event, packet)
            again += write_packet(event, dialect, packet.get("length") if dialect == "2014old" else None)
        assert (again == raw) == (vector["reencode"] == "exact"), vector["file"]
        assert again == raw or "java" in vector["file"]
        undecided = {"2006": None, "2014i": "2014"}.get(dialect, dialect) if vector["case"] == "empty" else dialect
        assert decoder.dialect == undecided, vector["file"]
        if "nan" not in repr(events):
            assert events_of([raw[k : k + 1] for k in range(len(raw))])[0] == events, vector["file"]
            assert events_of(pieces(raw, len(raw)))[0] == events, vector["file"]
        if vector["reencode"] == "exact":
            encoded_again(events, vector["packets"], dialect)


def encoded_again(events: list[Event], packets: list[dict[str, Any]], dialect: str) -> None:
    encoder = Encoder(dialect, allow_nul=True)
    for event, packet in zip(events, packets, strict=True):
        if isinstance(event, Definition) and event.kind == "sample":
            encoder.define(SampleType(event.name, event.type))
            assert event.type.signature(dialect).hex() == packet["signature_hex"]
        elif isinstance(event, Sample):
            data = encoder.data(SampleType(event.name, event.type), event.value)
            assert data.endswith(bytes.fromhex(packet["payload_hex"]))


def test_edge_streams(manifest: dict[str, Any], folder: Path) -> None:
    for entry in manifest["edge_streams"]:
        raw, expect = (folder / entry["file"]).read_bytes(), entry["expect"]
        events, offset = events_of([raw])
        assert [kind(event) for event in events] == expect["events"], entry["file"]
        assert offset == expect.get("error_offset"), entry["file"]
        assert rows(events) == expect["rows_tm"], entry["file"]
        others = [e.value for e in events if isinstance(e, Sample) and not isinstance(e.value, dict)]
        assert others == expect["other_values"], entry["file"]
        if "with_require_version_false" in expect:
            events, offset = events_of([raw], Decoder(entry["dialect"], require_version=False))
            assert (rows(events), offset) == (expect["with_require_version_false"]["rows_tm"], None)


def rows(events: list[Event]) -> list[int]:
    return [e.value["tm"] for e in events if isinstance(e, Sample) and isinstance(e.value, dict)]


def test_bad_streams_are_refused_where_the_fault_is(manifest: dict[str, Any], folder: Path) -> None:
    for entry in manifest["bad_streams"]:
        raw = (folder / entry["file"]).read_bytes()
        for parts in ([raw], [raw[k : k + 1] for k in range(len(raw))], pieces(raw, 3)):
            events, offset = events_of(parts)
            assert (offset, len(events)) == (entry["error_offset"], entry["events_before"]), entry["file"]


def test_the_idl_gives_the_trees_of_the_vectors(manifest: dict[str, Any], folder: Path) -> None:
    declared = {}
    for name in ("vectors", "armlab", "extctrl", "intentions"):
        for one in parse_lc((folder / "idl" / f"{name}.lc").read_text(encoding="utf-8"), "2014i"):
            declared[one.name] = one.type
    seen = set()
    for vector in manifest["vectors"]:
        if vector["case"].startswith("tcp_client"):
            continue  # a command_row without trq
        for packet in vector["packets"]:
            if packet["kind"] in ("sample_def", "sample_ref") and packet["name"] in declared:
                node = declared[packet["name"]]
                seen.add(packet["name"])
                assert tree(node) == packet["type"], vector["file"]
                assert node.signature(vector["dialect"]).hex() == packet["signature_hex"], vector["file"]
    assert len(seen) > 30
