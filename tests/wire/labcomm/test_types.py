"""Types, signatures, dialects and the .lc language of LabComm."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.errors import LabCommError, UnknownName
from armlab.wire.labcomm import Decoder, Encoder, Limits, Sample, idl, parse_lc
from armlab.wire.labcomm.decoder import FIRST_INDEX, SignatureWalk, parse_signature
from armlab.wire.labcomm.idl import Typedef, to_lc
from armlab.wire.labcomm.types import (
    PRIMS,
    VOID,
    Array,
    Field,
    Prim,
    SampleType,
    Struct,
    Type,
    TypeRef,
    dialect_named,
    encode_packed32,
)
from armlab.wire.labcomm.values import Source


def one(text: str) -> Type:
    return parse_lc(f"sample {text};")[0].type


@pytest.mark.parametrize(
    ("text", "fixed", "smallest", "smallest_2006", "values", "form"),
    [
        ("int a", 4, 4, 4, 1, ">i"),
        ("string a", None, 1, 4, 1, None),
        ("void a", 0, 0, 0, 1, ">"),
        ("double a[7]", 56, 56, 56, 8, ">7d"),
        ("int a[2,3]", 24, 24, 24, 9, ">6i"),
        ("int a[2][3]", 24, 24, 24, 9, ">6i"),
        ("int a[2,_]", None, 1, 4, 1, None),
        ("int a[_][_]", None, 1, 4, 1, None),
        ("string a[3]", None, 3, 12, 4, None),
        ("struct { int tm; double pos[7]; double vel[7]; double trq[7]; } a", 172, 172, 172, 26, ">i21d"),
        ("struct { boolean b; struct { byte x; byte y[3]; } c[2]; } a", 9, 9, 9, 15, ">?8B"),
    ],
)
def test_sizes(text: str, fixed: int | None, smallest: int, smallest_2006: int, values: int, form: str | None) -> None:
    node = one(text)
    assert (node.fixed_size, node.min_size(), node.min_size("2006")) == (fixed, smallest, smallest_2006)
    assert (node.values, node.struct_format) == (values, form)


def test_signatures_of_the_dialects() -> None:
    node = Struct((Field("val", PRIMS["int"], (("unit", "rad"),)),))
    assert node.signature().hex() == "11010376616c23"
    assert node.signature("2014i").hex() == "1101" + "02" + "00" + "0376616c" + "04756e6974" + "03726164" + "23"
    assert node.signature("2006").hex() == "00000011" + "00000001" + "00000003" + "76616c" + "00000023"
    with pytest.raises(LabCommError, match="reference"):
        PRIMS["sample"].signature("2013")


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


def test_a_robot_row_has_the_signature_of_the_format() -> None:
    (row,) = parse_lc("sample struct { int tm; double pos[7]; double vel[7]; double trq[7]; } robot_row;")
    raw = row.type.signature()
    assert raw.hex() == "110402746d2303706f731001072603" + "76656c1001072603" + "74727110010726"
    assert parse_signature(raw) == row.type
    assert len(raw) == 30


@pytest.mark.parametrize(
    ("raw", "offset", "what"),
    [
        ("", 0, "the rest"),
        ("10 01", 2, "the rest"),
        ("23 00", 1, "1 more"),
        ("30", 0, "type code"),
        ("40", 0, "type code"),
        ("10 00 23", 1, "1 to 16 dimensions"),
        ("10 11", 1, "1 to 16 dimensions"),
        ("10 01 00 11 00", 3, "void"),
        ("11 01 01 61 11 00", 4, "void"),
        ("11 02 01 61 23 01 61 23", 5, "different names"),
        ("10 02 87 68 87 68 21", 4, "product"),
        ("10 01 00" * 32 + "23", 96, "32 levels"),
        ("11 02 01 61" + "10 01 85 00 26" + "01 62 10 01 c0 00 26", 0, "bytes"),
    ],
)
def test_malformed_signatures_are_refused_at_their_byte(raw: str, offset: int, what: str) -> None:
    with pytest.raises(LabCommError, match=what) as caught:
        parse_signature(bytes.fromhex(raw), limits=Limits(packet=65_536, values=16_384, definitions=1, nodes=1))
    assert caught.value.offset == offset


def test_type_indices_are_for_type_defs_only() -> None:
    source = Source()
    source.add(b"\x40")
    walk = SignatureWalk(source, dialect_named("2014"), Limits.server(), 1, type_refs=True)
    with pytest.raises(StopIteration) as done:
        next(walk.tree(0))
    assert done.value.value == (TypeRef(FIRST_INDEX), 1)
    with pytest.raises(LabCommError):
        parse_signature(b"\x28", "2013")
    with pytest.raises(UnknownName):
        parse_signature(b"\x28", "2015")


def test_numbers_names_and_packets() -> None:
    new, notes, old = (dialect_named(name) for name in ("2014v1", "2014i", "2006"))
    assert new.number(300).hex() == "822c"
    assert old.number(300).hex() == "0000012c"
    assert new.label("val") == b"\3val"
    assert notes.label("val", (("foo", "bar"),)) == b"\x02\x00\x03val\x03foo\x03bar"
    assert new.packet(0x44, bytes(4)).hex() == "440400000000"
    assert new.packet(0x44, bytes(4), length=5).hex() == "440500000000"
    assert old.packet(0x44, bytes(4)).hex() == "0000004400000000"
    with pytest.raises(LabCommError, match="UTF-8"):
        new.label("\ud800")
    with pytest.raises(LabCommError, match="from 0 to"):
        old.number(2**32)


@pytest.mark.parametrize(
    ("n", "raw"),
    [(0, "00"), (127, "7f"), (128, "8100"), (300, "822c"), (172, "812c"), (2**32 - 1, "8fffffff7f")],
)
def test_the_bytes_of_the_format(n: int, raw: str) -> None:
    assert encode_packed32(n).hex() == raw


@pytest.mark.parametrize("n", [-1, 2**32])
def test_numbers_out_of_range_are_refused(n: int) -> None:
    with pytest.raises(LabCommError, match="from 0 to"):
        encode_packed32(n)


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
        ("sample\n  foo a;", 2, 3, "declared before"),
        ("sample int struct;", 1, 12, "a name"),
        ("sample int _;", 1, 12, "a name"),
        ("sample int a; typedef int a;", 1, 27, "not taken"),
        ("sample struct { } a;", 1, 17, "declared before"),
        ("sample struct { int a; int a; } b;", 1, 28, "not taken"),
        ("sample struct { void a; } b;", 1, 17, "with a value"),
        ("typedef void v; sample struct { v a; } b;", 1, 33, "with a value"),
        ("sample void a[3];", 1, 8, "with a value"),
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
    with pytest.raises(LabCommError, match="a name"):
        to_lc([SampleType("int", PRIMS["int"])])
    with pytest.raises(LabCommError, match="a note"):
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
    assert len(idl.samples("armlab")["fused_row"].signature()) == 91


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
