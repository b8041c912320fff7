"""Layouts found once, checked on blocks."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import LogError
from armlab.log.mcap.message_layouts import (
    MessageReader,
    Piece,
    Read,
    Values,
    Variant,
    assembled,
    joined,
    of_length,
    read_blocks,
    split,
    variant_of,
)
from armlab.wire.cdr import definitions

TEXT = "uint32 a\nuint32 b\nstring word\nfloat64[] x"


def message(a: int, b: int, word: bytes, x: list[float]) -> bytes:
    raw = b"\0\1\0\0" + struct.pack("<IIi", a, b, len(word)) + word
    raw += b"\0" * (-(len(raw) - 4) % 4) + struct.pack("<I", len(x))
    return raw + b"\0" * (-(len(raw) - 4) % 8) + struct.pack(f"<{len(x)}d", *x)


def reader(*paths: str) -> MessageReader:
    return MessageReader("t/msg/T", definitions("t/msg/T", TEXT), frozenset(paths))


def test_numbers_that_follow_each_other_are_one_run() -> None:
    found = reader("a", "b", "x")
    block = np.frombuffer(message(1, 2, b"ab\0", [3.0, 4.0]), np.uint8)[None]
    read = read_blocks(1, [(np.array([0]), block)], found)
    assert isinstance(read, Read)
    assert read.rows.tolist() == [0]
    ((rows, values),) = read.pieces
    assert rows.tolist() == [0]
    assert list(values) == [(("a", 1), ("b", 1)), (("x", 2),)]
    fields = split(values)
    assert fields["b"].tolist() == [[2]]
    assert fields["x"].tolist() == [[3.0, 4.0]]
    (variant,) = found.variants[block.shape[1]]
    assert isinstance(variant, Variant)


def test_a_layout_is_the_places_of_numbers_and_of_what_all_have() -> None:
    raw = message(1, 2, b"ab\0", [3.0, 4.0])
    found = variant_of(np.frombuffer(raw, np.uint8), reader("a", "x"))
    assert found.runs == {(("a", 1),): (4, 8, "<u4"), (("x", 2),): (len(raw) - 16, len(raw), "<f8")}
    assert found.fixed == [(0, 4), (12, len(raw) - 16)]  # b is a number, though not wanted
    assert found.first.tobytes() == raw


def test_rows_go_to_their_own_layout() -> None:
    raw = [message(i, 0, word, [float(i)]) for i, word in enumerate([b"ab\0", b"cd\0", b"ab\0", b"ef\0"])]
    block = np.frombuffer(b"".join(raw), np.uint8).reshape(4, -1)
    found = reader("x")
    read = read_blocks(4, [(np.arange(4), block)], found)
    assert [rows.tolist() for rows, _ in read.pieces] == [[0, 2], [1], [3]]
    values = split(assembled(4, read.pieces))
    assert values["x"].ravel().tolist() == [0.0, 1.0, 2.0, 3.0]
    assert len(found.variants[block.shape[1]]) == 3


def test_the_rows_of_each_length_are_in_order() -> None:
    assert [rows.tolist() for rows in of_length(np.array([5, 3, 5, 0, 3]))] == [[3], [1, 4], [0, 2]]
    assert of_length(np.zeros(0, dtype=np.int64)) == []


def read_all(raws: list[bytes], found: MessageReader) -> Read:
    same = of_length(np.array([len(raw) for raw in raws]))
    together = (np.frombuffer(b"".join(raws[k] for k in rows), np.uint8).reshape(len(rows), -1) for rows in same)
    return read_blocks(len(raws), zip(same, together, strict=True), found)


@settings(max_examples=200)
@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 2), st.booleans()), max_size=40))
def test_messages_that_do_not_fit_are_left_out_alone(made: list[tuple[int, int, bool]]) -> None:
    """Of more layouts than are remembered, of several lengths, before and behind messages of their layout."""
    raws, whole = [], []
    for k, (word, count, is_bad) in enumerate(made):
        raw = message(k, word, b"%02d\0" % word, [float(k)] * count)
        raws.append(raw.replace(b"%02d\0" % word, b"\xff\0\0") if is_bad else raw)
        whole += [] if is_bad else [k]
    read = read_all(raws, reader("a", "x"))
    assert read.rows.tolist() == whole
    assert read.bad == len(made) - len(whole)
    assert ("do not fit" in read.reason) == bool(read.bad)
    fields = split(assembled(len(whole), read.pieces))
    assert fields.get("a", np.zeros((0, 1))).ravel().tolist() == whole
    if "x" in fields:
        assert [row[~np.isnan(row)].tolist() for row in fields["x"]] == [[float(k)] * made[k][1] for k in whole]


def test_one_long_message_does_not_ask_for_memory_in_all_rows() -> None:
    read = read_all([message(k, 0, b"", [1.0] * (1 if k else 100_000)) for k in range(3000)], reader("a", "x"))
    assert len(read.pieces) == 2
    with pytest.raises(LogError) as told:
        assembled(3000, read.pieces)
    assert str(told.value) == (
        "Expected values that are alike, got 3000 rows with 105999 numbers, up to 100000 in x: 2 name(s) that "
        "would take 300003000 cells."
    )


def test_pieces_of_the_same_columns_are_joined() -> None:
    x, xy = (("x", 1),), (("x", 1), ("y", 1))
    pieces: list[Piece] = [
        (np.array([3]), {x: np.array([[3.0]])}),
        (np.array([0, 2]), {xy: np.array([[0.0, 1.0], [2.0, 3.0]])}),
        (np.array([1]), {x: np.array([[1.0]])}),
    ]
    one, two = joined(pieces)
    assert one[0].tolist() == [3, 1]
    assert one[1][x].tolist() == [[3.0], [1.0]]
    assert two[1] is pieces[1][1]
    values = split(assembled(4, [one, two]))
    assert values["x"].ravel().tolist() == [0.0, 1.0, 2.0, 3.0]
    np.testing.assert_array_equal(values["y"].ravel(), [1.0, np.nan, 3.0, np.nan])


def test_a_message_of_many_parts_takes_time_in_proportion() -> None:
    """Copying the names so far for each number took an hour here."""
    text = "In[] points\n" + "=" * 80 + "\nMSG: t/In\nfloat64 x\nfloat64 y"
    found = MessageReader("t/msg/T", definitions("t/msg/T", text), None)
    raw = b"\0\1\0\0" + struct.pack("<Ixxxx", 20_000) + bytes(16 * 20_000)
    (run,) = variant_of(np.frombuffer(raw, np.uint8), found).runs
    assert len(run) == 40_000


def test_as_many_columns_as_messages_are_read_or_refused_at_once() -> None:
    """Each message with a column of its own: looking for each in each would take hours."""
    pieces: list[tuple[np.ndarray, Values]] = [
        (np.array([k]), {((f"x{k}", 1),): np.array([[float(k)]])}) for k in range(20_000)
    ]
    with pytest.raises(LogError, match="got 20000 rows with 20000 numbers, up to 1 in x0: 20000 name"):
        assembled(20_000, pieces)
    values = split(assembled(2000, pieces[:2000]))
    assert len(values) == 2000
    assert np.isfinite(values["x7"][:, 0]).nonzero()[0].tolist() == [7]


def test_what_a_layout_does_not_have_is_nan() -> None:
    pieces: list[tuple[np.ndarray, Values]] = [
        (np.array([0, 2]), {(("x", 2),): np.ones((2, 2))}),
        (np.array([1]), {(("y", 1),): np.array([[5]])}),
    ]
    values = split(assembled(3, pieces))
    assert np.isnan(values["x"][1]).all()
    assert values["y"][1, 0] == 5.0
    assert np.isnan(values["y"][[0, 2]]).all()


def test_counts_with_holes_in_one_piece_stay_missing_where_another_piece_has_none() -> None:
    """A whole piece of integers before one of reals with NaN: NaN must not become an integer."""
    path = "clamped"
    whole, holed = np.array([[1], [2]], dtype=np.uint8), np.array([[np.nan], [4.0]])
    pieces = [(np.array([0, 1]), {((path, 1),): whole}), (np.array([2, 3]), {((path, 1),): holed})]
    np.testing.assert_array_equal(split(assembled(4, pieces))[path][:, 0], [1.0, 2.0, np.nan, 4.0])
