"""Type trees: what they know of themselves, and what is no type."""

from __future__ import annotations

import pytest

from armlab.errors import LabCommError
from armlab.wire.labcomm import parse_lc
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
    containers,
    typename,
)


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


def test_types_compare_by_what_they_are() -> None:
    row = Struct((("tm", PRIMS["int"]), ("pos", Array((7,), PRIMS["double"]))))
    assert row == Struct((Field("tm", Prim("int")), Field("pos", Array((7,), Prim("double")))))
    assert SampleType("row", row).signature() == row.signature()
    assert (row.depth, row.nodes) == (3, 4)
    assert [typename(node) for node in (row, row.fields[1].type, VOID, TypeRef(64))] == [
        "struct",
        "double[7]",
        "struct",
        "type 64",
    ]
    assert containers((2, 3, 4)) == 9


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
