"""The schema of rows: its text says all of it, and nothing else is taken for one."""

from __future__ import annotations

import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.servers.row import LARGEST, RowField, RowSchema
from armlab.errors import ConfigError, LinkError
from armlab.log import Column

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
BOTH = RowSchema.of([LEFT, RIGHT], {"force": {"wrench": Column((6,))}})


def test_the_schema_is_its_own_text() -> None:
    again = RowSchema.read(BOTH.text)
    assert (again.text, again.id, again.size) == (BOTH.text, BOTH.id, BOTH.size)
    assert json.loads(BOTH.text)["robots"] == ["yumi_left", "yumi_right"]
    field = again.fields["yumi_left.tau"]
    assert (field.unit, field.shape, field.labels[0]) == ("N m", (7,), LEFT.joint_names[0])
    assert all(field.offset % 8 == 0 for field in again.fields.values())
    assert RowSchema.of([LEFT]).id != BOTH.id


def test_rows_of_an_arm_have_its_fields() -> None:
    BOTH.require(LEFT)
    some = RowSchema(["ur5e"], [RowField("ur5e.q", "float64", (6,), "rad", "", (), "ur5e", 40)])
    arm = robots.load("ur5e")
    some.require(arm, whole=False)
    with pytest.raises(LinkError, match=r"Expected rows with ur5e.session_t, float64 of shape \(\), got none"):
        some.require(arm)
    for wrong in (("text", (6,)), ("float64", (7,)), ("int64", (6,))):
        other = RowSchema(["ur5e"], [RowField("ur5e.q", *wrong, "rad", "", (), "ur5e", 40)])
        with pytest.raises(LinkError, match=r"Use the same description of ur5e"):
            other.require(arm, whole=False)


def test_golden_text_and_id() -> None:
    """Other programs read rows by this text and know it by this id."""
    schema = RowSchema(["a"], [RowField("a.q", "float64", (2,), "rad", "", ("one", "two"), "a", 40)])
    expected = (
        b'{"fields":[{"frame":"","labels":["one","two"],"name":"a.q","offset":40,"shape":[2],"source":"a",'
        b'"type":"float64","unit":"rad"}],"robots":["a"],"version":1}'
    )
    assert schema.text == expected
    assert schema.id == hashlib.sha256(expected).digest()[:8] == bytes.fromhex("bee64d13376b7474")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ([RowField("a", "float32", (), "1", "", (), "a", 40)], "one after another"),
        ([RowField("a", "float64", (), "1", "", (), "a", 44)], "one after another"),
        ([RowField("a", "float64", (-1,), "1", "", (), "a", 40)], "one after another"),
        ([RowField("a", "float64", (2000,), "1", "", (), "a", 40)], "at most 8192"),
        (
            [RowField("a", "float64", (), "1", "", (), "a", 40), RowField("a", "int64", (), "1", "", (), "a", 48)],
            "once",
        ),
    ],
)
def test_wrong_schemas(fields: list[RowField], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        RowSchema(["a"], fields)


@pytest.mark.parametrize(
    "text", [b"", b"[]", b"{", b'{"version":1}', b"\xff", BOTH.text.replace(b'"version":1', b'"version":2')]
)
def test_wrong_texts(text: bytes) -> None:
    with pytest.raises(ConfigError):
        RowSchema.read(text)


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), min_size=1, max_size=4))
def test_mutated_schemas(changes: list[tuple[int, int]]) -> None:
    text = bytearray(BOTH.text)
    for place, value in changes:
        text[place % len(text)] = value
    try:
        schema = RowSchema.read(bytes(text))
    except ConfigError:
        return
    assert schema.size <= LARGEST
