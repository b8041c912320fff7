"""Messages copied out of a chunk by the compiled kernel and by the reference."""

from __future__ import annotations

import struct
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.errors import ShapeError
from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

EXAMPLES = {3: b"name" + bytes(24) + b"\1\2", 700: b"x" + bytes(4)}
FIXED = {3: [(0, 4), (28, 30)], 700: [(0, 1)]}
PLACES = {3: [(4, 28), (4, 12), (20, 23)], 700: [(1, 5)]}
ROWS = 8


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def message(number: int, row: int, body: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", number, row, 10 * row, 11 * row) + body)


def like(number: int, values: bytes) -> bytes:
    """Return a message like the example with other numbers."""
    raw = bytearray(EXAMPLES[number])
    start, stop = PLACES[number][0]
    raw[start:stop] = values.ljust(stop - start, b"\0")[: stop - start]
    return bytes(raw)


def copied(
    backend: Any, data: bytes | memoryview, first: list[int], count: list[int]
) -> tuple[list[bool], list[np.ndarray]]:
    """Return which channels the backend has copied, and the rows of those."""
    arrays = {
        number: [
            np.full(ROWS, 7, "<u4"),
            np.full(ROWS, 7, "<i8"),
            *(np.full((ROWS, b - a), 7, np.uint8) for a, b in PLACES[number]),
        ]
        for number in EXAMPLES
    }
    told = [
        (number, EXAMPLES[number], FIXED[number], PLACES[number], sequence, log_ns, columns)
        for number, (sequence, log_ns, *columns) in arrays.items()
    ]
    fits = backend.MessageCopier(told).copy(data, first, count)
    return fits, [array for one, fit in zip(arrays.values(), fits, strict=True) if fit for array in one]


MESSAGES = st.one_of(
    st.builds(
        lambda number, row, values: message(number, row, like(number, values)),
        st.sampled_from([3, 700]),
        st.integers(0, 9),
        st.binary(max_size=24),
    ),
    st.builds(message, st.sampled_from([3, 700, 4]), st.integers(0, 9), st.binary(max_size=30)),
    st.builds(record, st.sampled_from([4, 5, 200]), st.binary(max_size=30)),
)


@given(
    st.lists(MESSAGES, max_size=8),
    st.binary(max_size=12),
    st.integers(0, 3),
    st.lists(st.integers(-1, 5), min_size=2, max_size=2),
)
def test_backends_copy_the_same(records: list[bytes], rest: bytes, first: int, count: list[int]) -> None:
    data = b"".join(records) + rest
    ours, theirs = (copied(backend, data, [first, 0], count) for backend in (_native, _reference))
    assert ours[0] == theirs[0]
    for one, other in zip(ours[1], theirs[1], strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("backend", [_native, _reference])
def test_numbers_go_to_their_rows_and_nowhere_else(backend: Any) -> None:
    data = message(3, 1, like(3, b"abcdefgh" * 3)) + message(700, 5, like(700, b"wxyz")) + message(3, 2, like(3, b"A"))
    fits, (sequence, log_ns, whole, start, odd, *other) = copied(backend, memoryview(data), [4, 0], [2, 1])
    assert fits == [True, True]
    assert sequence.tolist() == [7, 7, 7, 7, 1, 2, 7, 7]
    assert log_ns.tolist() == [7, 7, 7, 7, 10, 20, 7, 7]
    assert whole[4].tobytes() == b"abcdefgh" * 3
    assert start[4:6].tobytes() == b"abcdefghA" + bytes(7)
    assert odd[4].tobytes() == b"abc"
    assert (whole[[0, 1, 2, 3, 6, 7]] == 7).all()
    assert other[2][0].tobytes() == b"wxyz"


@pytest.mark.parametrize("backend", [_native, _reference])
def test_a_channel_that_is_not_as_expected_is_told(backend: Any) -> None:
    one, other = message(3, 1, like(3, b"a")), message(700, 2, like(700, b"b"))
    assert copied(backend, one + other, [0, 0], [1, 1])[0] == [True, True]
    assert copied(backend, one + other, [0, 0], [2, 1])[0] == [False, True]  # fewer than expected
    assert copied(backend, one + other, [0, 0], [1, 0])[0] == [True, False]  # more
    assert copied(backend, one + other, [0, 0], [1, -1])[0] == [True, False]  # left out
    assert copied(backend, one + message(700, 2, b"y" + bytes(4)), [0, 0], [1, 1])[0] == [True, False]  # other text
    assert copied(backend, one + message(700, 2, b"x" + bytes(5)), [0, 0], [1, 1])[0] == [True, False]  # longer
    assert copied(backend, one + other[:-1], [0, 0], [1, 1])[0] == [True, False]  # torn
    assert copied(backend, one + record(5, other[9:20]), [0, 0], [1, 0])[0] == [True, True]  # too short for a message


@pytest.mark.parametrize("backend", [_native, _reference])
def test_what_does_not_fit_is_refused(backend: Any) -> None:
    def maker(places: list[tuple[int, int]], array: np.ndarray, fixed: list[tuple[int, int]] | None = None) -> Any:
        return backend.MessageCopier(
            [(1, bytes(8), fixed or [], places, np.zeros(2, "<u4"), np.zeros(2, "<i8"), [array])]
        )

    copier = maker([(0, 8)], np.zeros(2))
    with pytest.raises(ShapeError, match=r"^Expected rows from 0 to 2, got 2 from 1\.$"):
        copier.copy(b"", [1], [2])
    with pytest.raises(ShapeError, match="Expected rows from 0 to 2, got 0 from -1"):
        copier.copy(b"", [-1], [0])
    with pytest.raises(ShapeError, match="a first row and a count for each of 1 channels"):
        copier.copy(b"", [0], [])
    for places in ([(0, 9)], [(-1, 4)], [(4, 3)]):
        with pytest.raises(ShapeError, match="Expected places in a message of 8 bytes, got "):
            maker(places, np.zeros(2))
        with pytest.raises(ShapeError, match="Expected places in a message of 8 bytes, got "):
            maker([(0, 8)], np.zeros(2), places)
    with pytest.raises(ShapeError, match="an array for each of 0 places, got 1"):
        maker([], np.zeros(2))
    fixed = np.zeros(2)
    fixed.flags.writeable = False
    for array in (fixed, np.zeros(3), np.zeros(4)[::2], np.zeros((2, 2)), np.zeros((1, 2)), np.zeros(2, "<f4")):
        with pytest.raises(ShapeError, match="Expected writable arrays with a row of 8 bytes for every message, got"):
            maker([(0, 8)], array)
