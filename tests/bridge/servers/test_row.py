"""Rows as bytes: a lossless round trip, and no other bytes are accepted as a row."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.inputs.fusion import Held
from armlab.bridge.servers.row import (
    LARGEST,
    MAGIC,
    MONO,
    WALL,
    Pace,
    Row,
    RowField,
    RowSchema,
    RowWriter,
    beginning,
    clock_ms,
    places,
    read_head,
    read_row,
)
from armlab.errors import ConfigError, LinkError, ShapeError, UnknownName
from armlab.log import Column, Tick
from armlab.state import Command, State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
BOTH = RowSchema.of([LEFT, RIGHT], {"force": {"wrench": Column((6,))}})
J = np.arange(7.0)


def state(robot: str = "yumi_left", **more: Any) -> State:
    return State(1.5, 0.004, J, 2 * J, 3 * J, robot=robot, seq=9, motors=1, q_ext=np.array([0.5]), **more)


def tick(k: int = 0, **more: Any) -> Tick:
    return Tick(k, k, 10**18 + k, 10**18 + 4_000_000 * k, 10**18 + 4_000_000 * k + 300, 100, **more)


def test_what_goes_in_comes_out() -> None:
    writer = RowWriter(BOTH)
    command = Command(J + 1, record={"wrench_hat": np.arange(6.0), "other": 1.0})
    data = writer.row(state(), command, tick(3, q_sent=J + 2, clamped=J.astype(np.uint8)), 77, "labcomm a")
    assert len(data) == BOTH.size <= LARGEST
    assert len(data) % 8 == 0
    row = read_row(BOTH, data)
    assert isinstance(row, Row)
    assert (row.seq, row.mono_ns, row.wall_ns) == (1, 77, 10**18 + 3)
    values = row.values
    for name, expected in {
        "q": J, "qd": 2 * J, "tau": 3 * J, "q_ref": J + 1, "q_sent": J + 2, "clamped": J, "wrench_hat": np.arange(6.0),
        "session_t": 1.5, "dt": 0.004, "seq": 9, "tick": 3, "motors": 1, "fresh": 1, "age": 0.0, "late": 0,
    }.items():  # fmt: skip
        np.testing.assert_array_equal(values[f"yumi_left.{name}"], expected, err_msg=name)
    assert values["yumi_left.commander"] == "labcomm a"
    np.testing.assert_array_equal(values["yumi_left.q_ext"], [0.5, *[np.nan] * 5])
    for name in ("yumi_left.qd_ref", "yumi_left.wrench", "yumi_left.T_frame_tool", "yumi_right.q", "force.wrench"):
        assert np.isnan(values[name]).all()
    assert np.isinf(values["yumi_right.age"])
    assert np.isinf(values["force.age"])


def test_the_other_arm_keeps_its_values_and_gets_older() -> None:
    writer = RowWriter(BOTH)
    writer.row(state("yumi_right"), None, tick(0), 0)
    values = read_row(BOTH, writer.row(replace(state(), q=J + 1), None, tick(2), 1)).values
    np.testing.assert_array_equal(values["yumi_right.q"], J)
    assert values["yumi_right.age"] == pytest.approx(0.008)
    assert (values["yumi_right.fresh"], values["yumi_left.fresh"]) == (0, 1)


def test_sources_are_in_the_row() -> None:
    wrench = np.arange(6.0)
    held = Held({"wrench": np.full(6, np.nan)}, {"wrench": wrench}, 0.5, False, True)
    values = read_row(BOTH, RowWriter(BOTH).row(state(sources={"force": held}), None, tick(), 0)).values
    np.testing.assert_array_equal(values["force.wrench"], wrench)
    assert values["force.age"] == 0.5


def test_odd_commands_leave_holes() -> None:
    writer = RowWriter(BOTH)
    odd = Command(np.zeros(3), qd="up", record={"wrench_hat": 1.0})  # type: ignore[arg-type]
    values = read_row(BOTH, writer.row(state(), odd, tick(), 0, "é" * 100)).values
    assert np.isnan(values["yumi_left.q_ref"]).all()
    assert np.isnan(values["yumi_left.qd_ref"]).all()
    assert len(values["yumi_left.commander"].encode()) <= 48
    with pytest.raises(UnknownName, match="robot of these rows"):
        writer.row(state("ur5e"), None, tick(), 0)


@pytest.mark.parametrize(("name", "size"), [("q_sent", 1), ("qd_sent", 5), ("tau_sent", 56), ("clamped", 56)])
def test_ticks_of_another_size_are_refused(name: str, size: int) -> None:
    with pytest.raises(ShapeError, match=f"^Expected 7 values in {name}, got {size}\\.$"):
        RowWriter(BOTH).row(state(), None, tick(**{name: np.zeros(size)}), 0)


@pytest.mark.parametrize("error", [MemoryError, KeyboardInterrupt, OverflowError])
def test_errors_that_no_value_causes_are_raised(error: type[BaseException]) -> None:
    class Values:
        def __array__(self, *_: Any, **__: Any) -> np.ndarray:
            raise error

    with pytest.raises(error):
        RowWriter(BOTH).row(state(), Command(Values()), tick(), 0)  # type: ignore[arg-type]


ROW = RowWriter(BOTH).row(state(), None, tick(), 5)


@given(st.binary(max_size=200))
def test_noise_is_no_row(noise: bytes) -> None:
    for data in (noise, MAGIC + noise, ROW[: len(noise)], ROW[:16] + noise):
        with pytest.raises(LinkError):
            read_row(BOTH, data)


@given(st.lists(st.tuples(st.integers(0, len(ROW) - 1), st.integers(0, 255)), min_size=1, max_size=8))
def test_mutated_rows(changes: list[tuple[int, int]]) -> None:
    data = bytearray(ROW)
    for place, value in changes:
        data[place] = value
    try:
        row = read_row(BOTH, bytes(data))
    except LinkError:
        assert bytes(data[:16]) != ROW[:16]
    else:
        assert row.values.keys() == BOTH.fields.keys()


def test_places_are_where_the_values_are() -> None:
    data = RowWriter(BOTH).row(state("yumi_right"), None, tick(3), 77)
    row = read_row(BOTH, data)
    for source in ("yumi_right", "force"):
        found = places(BOTH, source)
        names = {name for name, field in BOTH.fields.items() if field.source == source and field.type != "text"}
        assert {f"{source}.{name}" for name in found} == names
        for name, (form, offset) in found.items():
            np.testing.assert_array_equal(form.unpack_from(data, offset), np.ravel(row.values[f"{source}.{name}"]))


def test_the_head_of_a_row() -> None:
    data = RowWriter(BOTH).row(state(), None, tick(3), 77)
    assert read_head(BOTH, data) == (1, 77, 10**18 + 3)
    assert [int.from_bytes(data[at : at + 8], "little") for at in (MONO, WALL)] == [77, 10**18 + 3]
    assert data.startswith(beginning(BOTH))
    assert beginning(RowSchema.of([LEFT])) != beginning(BOTH)
    with pytest.raises(LinkError, match="with a stated size of"):
        read_head(BOTH, data + bytes(8))


def test_the_clock_of_a_robot_or_of_its_session() -> None:
    assert (clock_ms(2_500_000, 9.0), clock_ms(0, 1.5), clock_ms(-1, 9.0)) == (2, 1500, -1)
    assert {clock_ms(0, time) for time in (np.nan, np.inf, 1.7e308)} == {None}


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
        ([RowField("a", "float32", (), "1", "", (), "a", 40)], "contiguous fields"),
        ([RowField("a", "float64", (), "1", "", (), "a", 44)], "contiguous fields"),
        ([RowField("a", "float64", (-1,), "1", "", (), "a", 40)], "contiguous fields"),
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


def test_each_arm_has_its_rate_whoever_comes_first() -> None:
    pace, got = Pace(0.1), {"left": 0, "right": 0}
    for k in range(2500):  # 10 s of two arms at 250 Hz, the right one just after the left
        for arm, after in (("left", 0.0), ("right", 1e-4)):
            got[arm] += pace.takes([arm], 0.004 * k + after)
    assert np.allclose(list(got.values()), 100, atol=2)


def test_a_row_that_is_fresh_for_both_counts_for_both() -> None:
    pace = Pace(1.0)
    assert pace.takes(["left", "right"], 5.0)
    assert not pace.takes(["left", "right"], 5.5)
    assert not pace.takes([], 7.0)
    assert pace.takes(["right"], 6.0)
    assert pace.takes(["left", "right"], 6.1)
    every = Pace(0.0)
    assert all(every.takes(["left"], now) for now in (1.0, 1.0, 1.5))
