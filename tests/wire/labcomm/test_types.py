"""Types, malformed signatures and the .lc language of LabComm."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.errors import LabCommError, UnknownName
from armlab.wire.labcomm import Decoder, Encoder, Limits, Sample, idl, parse_lc
from armlab.wire.labcomm.idl import Typedef, to_lc
from armlab.wire.labcomm.types import PRIMS, VOID, Array, Field, Prim, SampleType, Struct, Type


def test_what_is_no_type_is_refused() -> None:
    for make in (
        lambda: Prim("uint"),
        lambda: Array((), PRIMS["int"]),
        lambda: Array((1,) * 17, PRIMS["int"]),
        lambda: Array((-1,), PRIMS["int"]),
        lambda: Array((3,), VOID),
        lambda: Struct((Field("a", VOID),)),
        lambda: Struct((Field("a", PRIMS["int"]), Field("a", PRIMS["int"]))),
    ):
        with pytest.raises(LabCommError, match=r"^Expected .*\.$"):
            make()
    node: Type = PRIMS["int"]
    for _ in range(31):
        node = Array((0,), node)
    with pytest.raises(LabCommError, match="32 levels"):
        Array((0,), node)


@pytest.mark.parametrize(
    ("raw", "offset", "what"),
    [
        ("", -1, "a complete signature"),
        ("10 01", -1, "a complete signature"),
        ("23 00", -1, "ends 1 bytes earlier"),
        ("30", 0, "type code"),
        ("40", 0, "type code"),
        ("10 00 23", 1, "1 to 16 dimensions"),
        ("10 11", 1, "1 to 16 dimensions"),
        ("10 01 00 11 00", 3, "void"),
        ("11 01 01 61 11 00", 4, "void"),
        ("11 02 01 61 23 01 61 23", 5, "distinct field names"),
        ("10 02 87 68 87 68 21", 4, "product"),
        ("10 01 00" * 32 + "23", 96, "32 levels"),
        ("11 02 01 61" + "10 01 85 00 26" + "01 62 10 01 c0 00 26", 0, "bytes"),
    ],
)
def test_malformed_signatures_are_refused_at_their_byte(raw: str, offset: int, what: str) -> None:
    signature = bytes.fromhex(raw)
    packet = bytes([2, 4 + len(signature), 0x40, 1, 0x6E, len(signature)]) + signature
    with pytest.raises(LabCommError, match=what) as caught:
        Decoder("2014v1", require_version=False).feed(packet)
    assert caught.value.offset == 6 + offset


def test_old_dialects_have_no_references_to_samples() -> None:
    with pytest.raises(LabCommError, match="a type code"):
        Decoder("2013", require_version=False).feed(b"\x02\x40\x01n\x28")
    with pytest.raises(LabCommError, match="a reference to a sample"):
        Encoder("2013").define(SampleType("n", PRIMS["sample"]))


def test_declarations() -> None:
    text = """// a comment
    typedef double vec[3]; /* and
    another */ sample struct { vec a; int n[2][_], m[4]; } bad;"""
    with pytest.raises(LabCommError, match="line 3"):
        parse_lc(text)
    got = parse_lc("typedef int n[_]; sample n x[3]; sample sample r; sample void v;")
    assert got == [
        Typedef("n", Array((0,), PRIMS["int"])),
        SampleType("x", Array((3,), Array((0,), PRIMS["int"]))),
        SampleType("r", PRIMS["sample"]),
        SampleType("v", VOID),
    ]
    assert parse_lc("  // nothing") == []


def test_notes_are_of_2014i() -> None:
    text = 'sample (source:bridge) "docs" struct { (unit:rad)(b:"two words") double q; "docs" int n; } s;'
    (sample,) = parse_lc(text, "2014i")
    fields = (Field("q", PRIMS["double"], (("b", '"two words"'), ("unit", "rad"))), Field("n", PRIMS["int"]))
    assert sample == SampleType("s", Struct(fields), (("source", "bridge"),))
    assert parse_lc(to_lc([sample]), "2014i") == [sample]
    with pytest.raises(LabCommError, match="no notes"):
        parse_lc(text)


def test_what_is_printed_is_read_again() -> None:
    text = "typedef struct {\n  int a[2, _];\n  struct {\n    string s;\n  } b[_][3];\n} t;\nsample void v;\n"
    assert to_lc(parse_lc(text)) == text


@pytest.mark.parametrize(
    ("text", "line", "column", "what"),
    [
        ("int a;", 1, 1, "typedef"),
        ("sample int", 1, 11, "a name"),
        ("sample int a", 1, 13, '";"'),
        ("sample\n  foo a;", 2, 3, "previously declared"),
        ("sample int struct;", 1, 12, "a name"),
        ("sample int _;", 1, 12, "a name"),
        ("sample int a; typedef int a;", 1, 27, "an unused"),
        ("sample struct { } a;", 1, 17, "previously declared"),
        ("sample struct { int a; int a; } b;", 1, 28, "an unused"),
        ("sample struct { void a; } b;", 1, 17, "a non-void type"),
        ("typedef void v; sample struct { v a; } b;", 1, 33, "a non-void type"),
        ("sample void a[3];", 1, 8, "a non-void type"),
        ("sample int a[0];", 1, 14, "a size"),
        ("sample int a[007];", 1, 14, "a name, a number"),
        ("sample int a[4294967296];", 1, 14, "a size"),
        ("sample int a[3;", 1, 15, '"]"'),
        ("sample int a; ?", 1, 15, "a name, a number"),
        ("sample int a; /* open", 1, 15, "a name, a number"),
        ("typedef (a:b) int a;", 1, 9, "no notes"),
        ("sample " + "struct { " * 33 + "int a;", 1, 8 + 32 * 9, "32 levels"),
        ("sample int a" + "[1]" * 33 + ";", 1, 8, "32 levels"),
    ],
)
def test_errors_have_line_and_column(text: str, line: int, column: int, what: str) -> None:
    with pytest.raises(LabCommError, match=what) as caught:
        parse_lc(text)
    assert (caught.value.line, caught.value.column) == (line, column)


def test_what_cannot_be_read_or_printed() -> None:
    with pytest.raises(LabCommError, match="1048576"):
        parse_lc(" " * (2**20 + 1))
    with pytest.raises(LabCommError, match="a type of LabComm 2013"):
        parse_lc("sample sample r;", "2013")
    with pytest.raises(LabCommError, match="without notes"):
        parse_lc("typedef (a:b) int x;", "2014i")
    with pytest.raises(LabCommError, match=r"\.lc name"):
        to_lc([SampleType("int", PRIMS["int"])])
    with pytest.raises(LabCommError, match=r"\.lc note"):
        to_lc([SampleType("n", PRIMS["int"], (("a", "two words"),))])


def test_files() -> None:
    assert idl.FILES == ("armlab", "extctrl")
    assert set(idl.samples("armlab")) == {"robot_row", "command_row", "fused_row", "stop"}
    assert "force_torque_net" in idl.text("extctrl")
    with pytest.raises(UnknownName, match="extctrl"):
        idl.samples("orca")


@pytest.mark.parametrize("name", ["armlab", "extctrl"])
def test_signatures_are_those_of_the_vectors(name: str, folder: Path) -> None:
    ours = idl.samples(name)
    theirs = parse_lc((folder / "idl" / f"{name}.lc").read_text(encoding="utf-8"))
    both = [one for one in theirs if one.name in ours]
    assert len(both) == 3
    for one in both:
        assert one.type == ours[one.name].type
    assert len(idl.samples("armlab")["fused_row"].type.signature()) == 91


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
