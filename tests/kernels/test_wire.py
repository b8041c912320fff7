"""Datagrams, EGM, texts of JSON, messages of MCAP, records."""

from __future__ import annotations

import gc
import socket
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import FrozenInstanceError, dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from armlab import kernels, lie
from armlab.errors import ShapeError

PLAN = ([(3, 0, 2), (4, 2, 5)], 5, [0, 1, 2, 6, 7, 8])  # of `Kind`: 3 + 2 values, then utilization and pose
SPANS = [(0, 2), (2, 4), (4, 9), (9, 12), (12, 22), (22, 23)]
EXAMPLE = bytes(range(1, 129)) + bytes(10)


class Kind(NamedTuple):
    seqno: int
    tm: Any
    ns: int
    q: Any
    rest: Any
    T: Any
    utilization: Any
    mono: int
    depth: int
    word: str


def reader(scalars: list[int] = PLAN[2], finite: Any = ((0, 2),)) -> Any:
    fixed = (0, None, 0, None, None, None, None, 0, -1, "word")
    scale = np.concatenate(([2.0, 1e-3, np.nan, 1.0, 3.0], np.ones(16)))
    return kernels.EgmReader(Kind, fixed, PLAN[0], PLAN[1], scalars, scale, list(finite))


def alike(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if a is None:
        return
    assert type(a) is Kind
    for x, y in zip(a, b, strict=True):
        assert type(x) is type(y)
        np.testing.assert_array_equal(x, y, strict=isinstance(y, np.ndarray))
    for array in (a.q, a.rest, a.T):
        assert not array.flags.writeable


def expected(numbers: list[float], integers: list[int], scalars: list[int] = PLAN[2]) -> Any:
    """The packet of numbers, written down again."""
    if not all(abs(x) <= 1e9 for x in numbers[:2]):
        return None
    with np.errstate(all="ignore"):
        scaled = np.array(numbers[:5]) * [2.0, 1e-3, np.nan, 1.0, 3.0]
    seqno, tm, seconds, microseconds, mono, depth = (value % 2**64 for value in integers)
    ns = seconds * 10**9 + microseconds * 1000 if seconds < 9 * 10**9 and microseconds < 10**9 else 0
    made: list[Any] = [0, None, 0, scaled[:2], scaled[2:], transform(*numbers[6:]), None, 0, -1, "word"]
    for field, value in zip(scalars, (seqno % 2**32, tm % 2**32, ns, numbers[5], mono, depth % 2**32), strict=True):
        if field >= 0:
            made[field] = value
    for array in made[3:6]:
        array.flags.writeable = False
    return Kind(*made)


def transform(x: float, y: float, z: float, a: float, b: float, c: float, d: float) -> np.ndarray:
    """The matrix of a position [mm] and a quaternion."""
    with np.errstate(all="ignore"):
        norm = a * a + b * b + c * c + d * d
    if not 1e-12 < norm < 1e12:
        return np.full((4, 4), np.nan)
    s = 2.0 / norm
    ab, ac, ad, bc, bd, cd = s * a * b, s * a * c, s * a * d, s * b * c, s * b * d, s * c * d
    b2, c2, d2 = s * b * b, s * c * c, s * d * d
    rows = ((1.0 - c2 - d2, bc - ad, bd + ac), (bc + ad, 1.0 - b2 - d2, cd - ab), (bd - ac, cd + ab, 1.0 - b2 - c2))
    return np.array([[*row, 1e-3 * p] for row, p in zip(rows, (x, y, z), strict=True)] + [[0.0, 0.0, 0.0, 1.0]])


number = st.floats(allow_nan=True, allow_infinity=True)
integer = st.integers(0, 2**64 - 1)


@given(st.lists(number, min_size=13, max_size=13), st.lists(integer, min_size=6, max_size=6), st.booleans())
@example([1e308] * 5 + [0.0] * 8, [0] * 6, False)  # scaled, it is too large
def test_packets_of_numbers(numbers: list[float], integers: list[int], bare: bool) -> None:
    scalars = [0, -1, 2, -1, 7, -1] if bare else PLAN[2]
    alike(reader(scalars).packet(numbers, integers), expected(numbers, integers, scalars))


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_matrices_of_quaternions(quaternion: list[float]) -> None:
    T = reader().packet([0.0] * 6 + [1.0, 2.0, 3.0, *quaternion], [0] * 6).T
    if np.linalg.norm(quaternion) < 1e-6:
        assert np.isnan(T).all() or np.linalg.norm(quaternion) > 0.99e-6
    else:
        R = lie.quaternion.to_matrix(np.array(quaternion) / np.linalg.norm(quaternion))
        np.testing.assert_allclose(T[:3, :3], R, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(T[:3, 3], [1e-3, 2e-3, 3e-3])


@given(st.data())
def test_packets_of_datagrams(data: st.DataObject) -> None:
    mask = bytearray(b"\xff" * len(EXAMPLE))
    offsets = data.draw(st.lists(st.sampled_from([-1, *range(23, len(EXAMPLE) - 8)]), min_size=13, max_size=13))
    for at in offsets:
        mask[at : at + 8 if at >= 0 else at] = bytes(8 if at >= 0 else 0)
    for start, stop in SPANS:
        mask[start:stop] = b"\x80" * (stop - start)
    one = reader()
    assert one.read(EXAMPLE) is None  # nothing learnt
    one.learn(EXAMPLE, bytes(mask), offsets, SPANS)
    mutated = bytearray(EXAMPLE)
    for at in data.draw(st.lists(st.integers(0, len(EXAMPLE) - 1), max_size=4)):
        mutated[at] ^= data.draw(st.integers(0, 255)) & ~mask[at] | data.draw(st.sampled_from([0, 0, 0, 255]))
    is_like = all((a ^ b) & same == 0 for a, b, same in zip(mutated, EXAMPLE, mask, strict=True))
    numbers = [struct.unpack_from("<d", mutated, at)[0] if at >= 0 else 0.0 for at in offsets]
    integers = [sum((byte & 127) << 7 * k for k, byte in enumerate(mutated[a:b])) for a, b in SPANS]
    alike(one.read(bytes(mutated)), expected(numbers, integers) if is_like else None)
    assert one.read(bytes(mutated[:-1])) is None


@given(
    st.lists(st.integers(-1, 100).filter(lambda at: at < 0 or at >= 30), max_size=8),
    st.integers(0, 2**70),
    st.integers(0, 300),
    st.randoms(use_true_random=False),
)
def test_replies(offsets: list[int], large: int, small: int, random: Any) -> None:
    values = np.array([random.gauss(0.0, 1.0) for _ in offsets] + [1.0, 2.0])
    offsets, divisors = [*offsets, 30, -1], np.arange(1.0, len(offsets) + 3.0)
    writer = kernels.EgmWriter(EXAMPLE, offsets, divisors, [(0, 10), (10, 11)])
    for integers in ((large, small), (2**63 + 5, small), (2**63, 5)):
        wanted = bytearray(EXAMPLE)
        for at, value in zip(offsets, values / divisors, strict=True):
            if at >= 0:
                struct.pack_into("<d", wanted, at, value)
        first = integers[0] % 2**64
        wanted[:10] = [first >> 7 * k & 127 | (128 if k < 9 else 0) for k in range(10)]
        wanted[10] = integers[1] & 127
        found = writer.write((values[:1], values[1:]), integers)
        assert found == (bytes(wanted) if first >= 2**63 and integers[1] < 128 else None)
    assert found is not None


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"^Expected a named tuple, and fields"):
        reader([0, 1, 2, 3, 4, 99])
    with pytest.raises(ShapeError, match=r"^Expected a named tuple, and fields"):
        reader(finite=[(0, 99)])
    one = reader()
    with pytest.raises(ShapeError, match=r"^Expected 13 numbers and 6 integers, got 2 and 1"):
        one.packet([0.0] * 2, [0])
    for offsets, spans in (([0] * 12, SPANS), ([131] * 13, SPANS), ([0] * 13, [(0, 999)] * 6), ([-2] * 13, SPANS)):
        with pytest.raises(ShapeError, match=r"^Expected numbers that lie within the datagram"):
            one.learn(EXAMPLE, EXAMPLE, offsets, spans)
    with pytest.raises(ShapeError, match=r"^Expected numbers that lie within the datagram"):
        kernels.EgmWriter(EXAMPLE, [131], np.ones(1), [])
    with pytest.raises(ShapeError):
        kernels.EgmWriter(EXAMPLE, [0], np.ones(2), [])
    writer = kernels.EgmWriter(EXAMPLE, [0, 8], np.ones(2), [(20, 21)])
    for arrays, integers in (((np.ones(1),), (1,)), ((np.ones(3),), (1,)), ((np.ones(2),), ())):
        with pytest.raises(ShapeError, match=r"^Expected 2 numbers and 1 integers"):
            writer.write(arrays, integers)


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
        assert one.errors  # a closed one reads nobody else's datagrams


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
    """A channel fits when it has as many messages as expected, all like the example, and nothing is torn before."""
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


@dataclass(frozen=True, slots=True)
class Slotted:
    a: Any
    b: Any = 2
    c: Any = 3


def test_a_record_is_as_if_made_by_its_class() -> None:
    maker = kernels.RecordMaker(Slotted, ("c", "a", "b"))
    text = "".join(["te", "xt"])
    before = sys.getrefcount(text)
    made = maker.make((text, None, [1]))
    assert made == Slotted(None, [1], "text")
    assert type(made) is Slotted
    assert sys.getrefcount(text) == before + 1
    assert gc.is_tracked(made)
    with pytest.raises(FrozenInstanceError):
        made.a = 1
    del made
    assert sys.getrefcount(text) == before
    assert not hasattr(kernels.RecordMaker(Slotted, ("a",)).make((1,)), "b")


def test_records_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"^Expected slots of the class, got d\.$"):
        kernels.RecordMaker(Slotted, ("a", "d"))
    with pytest.raises(ShapeError, match=r"^Expected one value for each of 1 slots, got 2\.$"):
        kernels.RecordMaker(Slotted, ("a",)).make((1, 2))
