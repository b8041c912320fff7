"""Datagrams of EGM read and written by the compiled kernels are those of the reference, bit for bit."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from armlab.errors import ShapeError
from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

BACKENDS = [_native, _reference]
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


def reader(backend: Any, scalars: list[int] = PLAN[2], finite: Any = ((0, 2),)) -> Any:
    fixed = (0, None, 0, None, None, None, None, 0, -1, "word")
    scale = np.concatenate(([2.0, 1e-3, np.nan, 1.0, 3.0], np.ones(16)))
    return backend.EgmReader(Kind, fixed, PLAN[0], PLAN[1], scalars, scale, list(finite))


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


number = st.floats(allow_nan=True, allow_infinity=True)
integer = st.integers(0, 2**64 - 1)


@given(st.lists(number, min_size=13, max_size=13), st.lists(integer, min_size=6, max_size=6), st.booleans())
@example([1e308] * 5 + [0.0] * 8, [0] * 6, False)  # scaled, it is too large
def test_packets_of_numbers(numbers: list[float], integers: list[int], bare: bool) -> None:
    scalars = [0, -1, 2, -1, 7, -1] if bare else PLAN[2]
    alike(*(reader(backend, scalars).packet(numbers, integers) for backend in BACKENDS))


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_matrices_of_quaternions(quaternion: list[float]) -> None:
    ours, theirs = (reader(b).packet([0.0] * 6 + [1.0, 2.0, 3.0, *quaternion], [0] * 6) for b in BACKENDS)
    alike(ours, theirs)
    R = ours.T[:3, :3]
    assert np.isnan(R).all() or np.allclose(R @ R.T, np.eye(3), atol=1e-9)


@given(st.data())
def test_packets_of_datagrams(data: st.DataObject) -> None:
    mask = bytearray(b"\xff" * len(EXAMPLE))
    offsets = data.draw(st.lists(st.sampled_from([-1, *range(23, len(EXAMPLE) - 8)]), min_size=13, max_size=13))
    for at in offsets:
        mask[at : at + 8 if at >= 0 else at] = bytes(8 if at >= 0 else 0)
    for start, stop in SPANS:
        mask[start:stop] = b"\x80" * (stop - start)
    readers = [reader(backend) for backend in BACKENDS]
    for one in readers:
        assert one.read(EXAMPLE) is None  # nothing learnt
        one.learn(EXAMPLE, bytes(mask), offsets, SPANS)
    mutated = bytearray(EXAMPLE)
    for at in data.draw(st.lists(st.integers(0, len(EXAMPLE) - 1), max_size=4)):
        mutated[at] ^= data.draw(st.integers(0, 255)) & ~mask[at] | data.draw(st.sampled_from([0, 0, 0, 255]))
    alike(*(one.read(bytes(mutated)) for one in readers))
    alike(*(one.read(bytes(mutated[:-1])) for one in readers))


@given(
    st.lists(st.integers(-1, 100).filter(lambda at: at < 0 or at >= 30), max_size=8),
    st.integers(0, 2**70),
    st.integers(0, 300),
    st.randoms(use_true_random=False),
)
def test_replies(offsets: list[int], large: int, small: int, random: Any) -> None:
    values = np.array([random.gauss(0.0, 1.0) for _ in offsets] + [1.0, 2.0])
    writers = [
        b.EgmWriter(EXAMPLE, [*offsets, 30, -1], np.arange(1.0, len(offsets) + 3.0), [(0, 10), (10, 11)])
        for b in BACKENDS
    ]
    for integers in ((large, small), (2**63 + 5, small), (2**63, 5)):
        ours, theirs = (one.write((values[:1], values[1:]), integers) for one in writers)
        assert ours == theirs
    assert ours is not None


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_does_not_fit_is_refused(backend: Any) -> None:
    with pytest.raises(ShapeError, match=r"^Expected a named tuple, and fields"):
        reader(backend, [0, 1, 2, 3, 4, 99])
    with pytest.raises(ShapeError, match=r"^Expected a named tuple, and fields"):
        reader(backend, finite=[(0, 99)])
    one = reader(backend)
    with pytest.raises(ShapeError, match=r"^Expected 13 numbers and 6 integers, got 2 and 1"):
        one.packet([0.0] * 2, [0])
    for offsets, spans in (([0] * 12, SPANS), ([131] * 13, SPANS), ([0] * 13, [(0, 999)] * 6), ([-2] * 13, SPANS)):
        with pytest.raises(ShapeError, match=r"^Expected numbers that lie within the datagram"):
            one.learn(EXAMPLE, EXAMPLE, offsets, spans)
    with pytest.raises(ShapeError, match=r"^Expected numbers that lie within the datagram"):
        backend.EgmWriter(EXAMPLE, [131], np.ones(1), [])
    with pytest.raises(ShapeError):
        backend.EgmWriter(EXAMPLE, [0], np.ones(2), [])
    writer = backend.EgmWriter(EXAMPLE, [0, 8], np.ones(2), [(20, 21)])
    for arrays, integers in (((np.ones(1),), (1,)), ((np.ones(3),), (1,)), ((np.ones(2),), ())):
        with pytest.raises(ShapeError, match=r"^Expected 2 numbers and 1 integers"):
            writer.write(arrays, integers)
