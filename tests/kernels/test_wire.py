"""Datagrams, arguments of the EGM codec, messages of MCAP, records."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import kernels
from armlab.errors import ShapeError
from armlab.state import Command
from armlab.wire.egm import Drop, Packet, Reference


def test_egm_of_axes_that_are_none() -> None:
    """Reading and writing are compared with protobuf in tests/wire/egm."""
    for order, scale in (([0, 0], np.ones(2)), ([0, 2], np.ones(2)), ([0], np.ones(2))):
        with pytest.raises(ShapeError, match=r"each of \d axes once"):
            kernels.EgmMessages(Packet, Drop, order, scale, np.zeros(0), False)
    messages = kernels.EgmMessages(Packet, Drop, [0], np.ones(1), np.zeros(0), False)
    with pytest.raises(ShapeError):
        messages.write(Reference(np.zeros(2), None, None, 1, 2))


class Datagram(NamedTuple):
    data: bytes
    source: tuple[str, int]
    ns: int


@pytest.fixture
def pair() -> Iterator[tuple[Any, Any, tuple[str, int]]]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
        one.setblocking(False)
    sockets[1].setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
    sender, receiver = (kernels.Datagrams(one, Datagram) for one in sockets)
    yield sender, receiver, sockets[1].getsockname()
    for one in (sender, receiver):
        one.close()
        assert one.receive() is None
        assert one.errors  # a closed receiver must not read another socket's datagrams


def test_they_arrive_in_order_with_stamps(pair: Any) -> None:
    sender, receiver, address = pair
    assert receiver.receive() is None
    texts = [b"", b"one", bytes(range(256)) * 200, b"\0last"]
    before = time.monotonic_ns()
    for text in texts:
        assert sender.send(text, address)
    found = [receiver.receive() for _ in texts]
    after = time.monotonic_ns()
    assert [one.data for one in found] == texts
    for one in found:
        assert type(one) is Datagram
        assert one.source[0] == "127.0.0.1"
        assert before - 1_000_000 <= one.ns <= after
    assert receiver.receive() is None
    assert (sender.errors, receiver.errors) == (0, 0)
    assert sender.send(b"x", found[0].source)  # back to the sender, by its address
    assert sender.receive().data == b"x"


def test_errors_are_counted(pair: Any) -> None:
    sender, _, address = pair
    assert not sender.send(b"x" * 70_000, address)
    assert sender.errors == 1


def test_a_wait_ends_with_a_datagram_or_in_time() -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as two,
    ):
        one.bind(("127.0.0.1", 0))
        sockets = [two.fileno(), one.fileno()]
        for polled in (0, 10**18):
            end = time.monotonic_ns() + 2_000_000
            assert not kernels.await_datagram(sockets, polled, end)
            assert time.monotonic_ns() >= end
        two.sendto(b"x", one.getsockname())
        assert kernels.await_datagram(sockets, 10**18, 10**18)
        assert kernels.await_datagram(sockets, 0, 0)
        one.recv(1)
        threading.Timer(0.01, two.sendto, (b"y", one.getsockname())).start()
        assert kernels.await_datagram(sockets, 0, time.monotonic_ns() + 60 * 10**9), "other threads run meanwhile"


def test_slots_are_filled_as_by_the_constructor() -> None:
    slots = tuple(getattr(Command, name) for name in Command.__slots__)
    q = np.zeros(2)
    whole = Command(q, None, None, {"a": 1.0}, True)
    made = kernels.filled(Command, slots, tuple(slot.__get__(whole) for slot in slots))
    assert type(made) is Command
    assert made.q is q
    assert all(slot.__get__(made) is slot.__get__(whole) for slot in slots)
    for kind, of, values in ((1, slots, slots), (Command, slots, ()), (Command, (1,), (1,))):
        with pytest.raises(TypeError, match="slot"):
            kernels.filled(kind, of, values)


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


def copied(data: bytes | memoryview, first: list[int], count: list[int]) -> tuple[list[bool], list[np.ndarray]]:
    """Return which channels the backend has copied, and their rows."""
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
    fits = kernels.MessageCopier(told).copy(data, first, count)
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
def test_any_records_are_copied_whole_or_not_at_all(
    records: list[bytes], rest: bytes, first: int, count: list[int]
) -> None:
    """A channel fits when it has as many messages as expected, all like the example, and no earlier record is torn."""
    fits, arrays = copied(b"".join(records) + rest, [first, 0], count)
    for number, at, wanted, fit in zip(EXAMPLES, (first, 0), count, fits, strict=True):
        heads = [one for one in records if one[0] == 5 and len(one) >= 31 and one[9:11] == struct.pack("<H", number)]
        if fit:
            assert len(heads) == max(wanted, 0)
            rows, arrays = arrays[: 2 + len(PLACES[number])], arrays[2 + len(PLACES[number]) :]
            for row, one in enumerate(heads, at):
                assert (rows[0][row], rows[1][row]) == struct.unpack_from("<IQ", one, 11)
                for column, (a, b) in zip(rows[2:], PLACES[number], strict=True):
                    assert column[row].tobytes() == one[31 + a : 31 + b]
            others = [row for row in range(ROWS) if not at <= row < at + len(heads)]
            assert all((array[others] == 7).all() for array in rows)
        elif not rest:
            like = [len(one) == 31 + len(EXAMPLES[number]) for one in heads]
            same = [all(one[31 + a : 31 + b] == EXAMPLES[number][a:b] for a, b in FIXED[number]) for one in heads]
            assert wanted < 0 or len(heads) != wanted or not all(like) or not all(same)


def test_numbers_go_to_their_rows_and_nowhere_else() -> None:
    data = message(3, 1, like(3, b"abcdefgh" * 3)) + message(700, 5, like(700, b"wxyz")) + message(3, 2, like(3, b"A"))
    fits, (sequence, log_ns, whole, start, odd, *other) = copied(memoryview(data), [4, 0], [2, 1])
    assert fits == [True, True]
    assert sequence.tolist() == [7, 7, 7, 7, 1, 2, 7, 7]
    assert log_ns.tolist() == [7, 7, 7, 7, 10, 20, 7, 7]
    assert whole[4].tobytes() == b"abcdefgh" * 3
    assert start[4:6].tobytes() == b"abcdefghA" + bytes(7)
    assert odd[4].tobytes() == b"abc"
    assert (whole[[0, 1, 2, 3, 6, 7]] == 7).all()
    assert other[2][0].tobytes() == b"wxyz"


def test_a_channel_that_is_not_as_expected_is_told() -> None:
    one, other = message(3, 1, like(3, b"a")), message(700, 2, like(700, b"b"))
    assert copied(one + other, [0, 0], [1, 1])[0] == [True, True]
    assert copied(one + other, [0, 0], [2, 1])[0] == [False, True]  # fewer than expected
    assert copied(one + other, [0, 0], [1, 0])[0] == [True, False]  # more
    assert copied(one + other, [0, 0], [1, -1])[0] == [True, False]  # left out
    assert copied(one + message(700, 2, b"y" + bytes(4)), [0, 0], [1, 1])[0] == [True, False]  # other text
    assert copied(one + message(700, 2, b"x" + bytes(5)), [0, 0], [1, 1])[0] == [True, False]  # longer
    assert copied(one + other[:-1], [0, 0], [1, 1])[0] == [True, False]  # torn
    assert copied(one + record(5, other[9:20]), [0, 0], [1, 0])[0] == [True, True]  # too short for a message


def test_messages_what_does_not_fit_is_refused() -> None:
    def maker(places: list[tuple[int, int]], array: np.ndarray, fixed: list[tuple[int, int]] | None = None) -> Any:
        return kernels.MessageCopier(
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
