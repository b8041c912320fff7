"""The `.lc` language, and the declarations that come with armlab."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.errors import LabCommError, UnknownName
from armlab.wire.labcomm import idl
from armlab.wire.labcomm.idl import Typedef, parse_lc, to_lc
from armlab.wire.labcomm.types import PRIMS, VOID, Array, Field, SampleType, Struct


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
