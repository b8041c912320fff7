"""Numbers in CDR messages are where rosbags puts them."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import LogError
from armlab.wire.cdr import NO_MEMBER, Field, Layout, bounded, definitions, layout, with_bytes

MIXED = """
uint8 flag
string name
float64 x
bool[3] bits
int16[] few
string[] names
Inner[] inner
float32 last
float64[4] fixed
int64 stamp
================================================================================
MSG: test_msgs/Inner
uint8 a
float64 b
"""


@pytest.fixture(scope="module")
def store():
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(MIXED, "test_msgs/msg/Mixed"))
    return store


def mixed(store, name: str, few: list[int], names: list[str], inner: list[float], little: bool) -> bytes:
    inner_type = store.types["test_msgs/msg/Inner"]
    message = store.types["test_msgs/msg/Mixed"](
        flag=7,
        name=name,
        x=1.5,
        bits=np.array([True, False, True]),
        few=np.array(few, dtype=np.int16),
        names=names,
        inner=[inner_type(a=3, b=value) for value in inner],
        last=2.5,
        fixed=np.array([1.0, 2.0, 3.0, 4.0]),
        stamp=-5,
    )
    return bytes(store.serialize_cdr(message, "test_msgs/msg/Mixed", little_endian=little))


@settings(max_examples=60)
@given(
    st.text(max_size=9),
    st.lists(st.integers(-100, 100), max_size=5),
    st.lists(st.text(max_size=4), max_size=3),
    st.lists(st.floats(allow_nan=False), max_size=3),
    st.booleans(),
)
def test_fields_are_where_rosbags_wrote_them(
    store, name: str, few: list[int], names: list[str], inner: list[float], little: bool
) -> None:
    raw = mixed(store, name, few, names, inner, little)
    found = layout(raw, "test_msgs/msg/Mixed", definitions("test_msgs/msg/Mixed", MIXED))
    assert isinstance(found, Layout)

    def numbers(path: str) -> list:
        field = found.field(path)
        assert isinstance(field, Field)
        return np.frombuffer(raw[field.start : field.stop], field.dtype).tolist()

    assert numbers("flag") == [7]
    assert numbers("x") == [1.5]
    assert numbers("bits") == [True, False, True]
    assert numbers("few") == few
    assert numbers("last") == [2.5]
    assert numbers("fixed") == [1.0, 2.0, 3.0, 4.0]
    assert numbers("stamp") == [-5]
    assert [numbers(f"inner[{i}].b")[0] for i in range(len(inner))] == inner
    assert found.texts == {"name": name, "names": tuple(names)}
    assert found.field("nothing") is None


@settings(max_examples=200)
@given(st.integers(0, 200), st.integers(0, 10_000), st.integers(0, 255))
def test_damaged_messages_fit_or_are_refused(store, cut: int, place: int, value: int) -> None:
    raw = bytearray(mixed(store, "joint", [1, 2], ["a", "bc"], [1.0], True))
    raw[place % len(raw)] = value
    try:
        found = layout(bytes(raw[: max(cut, 4)]), "test_msgs/msg/Mixed", definitions("test_msgs/msg/Mixed", MIXED))
    except LogError as error:
        assert str(error).endswith(".")  # noqa: PT017
    else:
        assert all(field.stop <= len(raw) for field in found.fields)


def test_foreign_bytes_and_texts_are_refused() -> None:
    types = definitions("test_msgs/msg/Mixed", MIXED)
    with pytest.raises(LogError, match="plain CDR"):
        layout(b"\x00\x03\x00\x00", "test_msgs/msg/Mixed", types)
    with pytest.raises(LogError, match="end of the message"):
        layout(b"\x00\x01\x00\x00\x07\x00\x00\x00" + struct.pack("<I", 2**31), "test_msgs/msg/Mixed", types)
    with pytest.raises(LogError, match="invalid text"):
        definitions("test_msgs/msg/Bad", "float64 [[[")
    with pytest.raises(LogError, match="invalid text") as told:
        definitions("test_msgs/msg/Bad", 100 * "float64 x\n" + "float64 [[[")
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 250


def nested(*fields: str) -> str:
    """Return the text of type M0 with this field, of its nested type M1 with the next field, and so on."""
    parts = [f"{'=' * 80}\nMSG: test_msgs/M{k}\n{text}" for k, text in enumerate(fields) if k]
    return "\n".join([fields[0], *parts])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        pytest.param(nested("M0 a\nM0 b"), "nested at most 32 levels deep", id="in itself"),
        pytest.param(
            nested(*(f"M{k + 1}[] a" for k in range(40)), "int8 x"), "nested at most 32 levels deep", id="deep"
        ),
        pytest.param(
            nested("M30 a\nM1 b", *(f"M{k + 1} a" for k in range(1, 60)), "int8 x"), "32 levels", id="deep from behind"
        ),
        pytest.param(
            nested(*(f"M{k + 1} {'a' * 250}" for k in range(4)), "int8 x"), "1000 characters", id="long names"
        ),
        pytest.param(nested("M1[] a", "int8[0] b"), "got 2 fields in 0 bytes", id="any number of nothing"),
        pytest.param(
            nested("M1[] a", "\n".join(["int8 f", *(f"int8[0] g{k}" for k in range(20))])),
            "22 fields in 1 bytes",
            id="few",
        ),
        pytest.param(
            nested("int8[-1] a"), "a of test_msgs/msg/M0 to have a length of at least 0", id="less than nothing"
        ),
        pytest.param(nested("M1[] a"), "M1 in the definition of test_msgs/msg/M0", id="no type"),
        pytest.param(
            nested(*(f"M{k + 1} a\nM{k + 1} b" for k in range(25)), "int8 x"), "at most 100000 fields", id="twice"
        ),
        pytest.param(
            nested(*(f"M{k + 1}[99] a" for k in range(20)), ""), "at most 100000 fields", id="arrays of nothing"
        ),
        pytest.param(nested(f"M1[{10**400}] a", "int8 x"), "at most 100000 fields", id="a long array"),
    ],
)
def test_types_without_bound_are_refused(text: str, told: str) -> None:
    with pytest.raises(LogError, match=told):
        definitions("test_msgs/msg/M0", text)


def test_a_message_of_many_fields_or_letters_without_a_byte_is_refused() -> None:
    name, long = "test_msgs/msg/M0", "b" * 700
    types = definitions(name, nested("M1[] a", f"int8 f\nint8[0] {long}1\nint8[0] {long}2"))
    few, many = (b"\0\1\0\0" + struct.pack("<I", count) + bytes(count) for count in (1, 1000))
    assert [field.count for field in layout(few, name, types).fields] == [1, 0, 0]
    with pytest.raises(
        LogError, match=r"Expected at most 16 fields per byte, got more in 1008 bytes up to a\[\d*\]\.b"
    ):
        layout(many, name, types)


def test_a_value_in_five_messages_fits() -> None:
    types = definitions("test_msgs/msg/M0", nested("M1[] a", *(f"M{k + 1} x" for k in range(1, 6)), "uint8 y"))
    raw = b"\0\1\0\0" + struct.pack("<I", 500) + bytes(500)
    assert len(layout(raw, "test_msgs/msg/M0", types).fields) == 500


def test_messages_without_fields_have_a_byte() -> None:
    text = nested("M1 e\nuint8 x\nM1[] several\nfloat64 y", "")
    types = definitions("test_msgs/msg/M0", text)
    assert with_bytes(types) == types
    raw = b"\0\1\0\0" + struct.pack("<BBxxI3B", 0, 7, 3, 0, 0, 0) + bytes(5) + struct.pack("<d", 2.5)
    found = layout(raw, "test_msgs/msg/M0", types)
    assert [one.path for one in found.fields if one.path.endswith(NO_MEMBER)] == [
        f"{where}.{NO_MEMBER}" for where in ("e", "several[0]", "several[1]", "several[2]")
    ]
    x, y = (next(one for one in found.fields if one.path == path) for path in "xy")
    assert raw[x.start] == 7
    assert np.frombuffer(raw[y.start : y.stop], y.dtype)[0] == 2.5


def test_the_most_fields_that_a_type_may_have() -> None:
    types = definitions(
        "test_msgs/msg/M0",
        nested("M1[300] a\nstring[] b\nuint8[1000000] picture", "float64[300] c\nM2 d\nM2[2] e", "int8 x"),
    )
    assert bounded("test_msgs/msg/M0", types) is types


def test_the_types_of_ros_are_bounded() -> None:
    from rosbags.typesys import Stores, get_typestore

    count = 0
    for kind in Stores:
        types = {name: fields for name, (_, fields) in get_typestore(kind).fielddefs.items()}
        for name in types:
            assert bounded(name, types) is types
            count += 1
    assert count > 1000
    rich = "\n".join(f"M{k}[] x{k}" for k in range(2, 9))
    deep = nested("M1[] a", rich, *("\n".join(f"float64 x{k}" for k in range(30)) for _ in range(7)))
    assert definitions("test_msgs/msg/M0", deep)
