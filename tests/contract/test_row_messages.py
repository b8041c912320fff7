"""Messages of rows by the compiled kernel and by the reference: the same bytes, and the same refusals."""

from __future__ import annotations

import struct
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

ARM = robots.load("yumi_left")
HEAD, SIZE, CLOCK, FRESH, Q, A, B = b"head", 184, 8, 16, 24, 80, 128
MESSAGE = bytes(range(100))
BOTH = [(Q, 7), (A, 6)]


def topics(backend: Any) -> list[tuple[Any, ...]]:
    """Numbers that are copied, a wrench of the first of two fields, a pose."""
    frames, prismatic = ARM.chain.frames, ARM.chain.prismatic
    chain = backend.Chain(frames, prismatic)
    copied = [None, (MESSAGE, 4, [(20, Q, 7)]), (MESSAGE[:70], 0, [(8, A, 6)]), (MESSAGE, 4, [(12, A, 3), (40, Q, 7)])]
    turned = [None, *[(MESSAGE, 4, [(17, at, 6)]) for at in (A, B, A)]]
    pose = [None, (MESSAGE, 4, [(30, 0, 7)])]
    return [
        (FRESH, BOTH, copied, 0, None, 0),
        (FRESH, [(A, 6), (B, 6)], turned, 1, chain, Q),
        (FRESH, [(Q, 7)], pose, 2, chain, Q),
    ]


@pytest.fixture(scope="module")
def makers() -> list[Any]:
    return [backend.RowMessages(HEAD, SIZE, CLOCK, topics(backend)) for backend in (_native, _reference)]


def drawn(rng: np.random.Generator) -> bytes:
    """Return a row in which fields are missing, some in part, and stamps are of any time."""
    numbers = rng.normal(size=20)
    for part in (slice(0, 7), slice(7, 13), slice(13, 19)):
        if rng.random() < 0.3:
            numbers[part] = rng.choice([np.nan, np.inf, 0.0])
        if rng.random() < 0.2:
            numbers[part.start] = np.nan
    stamp = int(rng.integers(-(1 << 62), 1 << 62)) >> int(rng.integers(0, 40))
    return HEAD + bytes(4) + struct.pack("<qq20d", stamp, rng.random() < 0.9, *numbers)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_random_rows_give_the_same_messages(makers: list[Any]) -> None:
    rng, made = np.random.default_rng(1), [0, 0, 0]
    for _ in range(300):
        row, wanted = drawn(rng), rng.permutation([0, 1, 2, 1]).tolist()
        native, reference = (maker.of_row(row, wanted) for maker in makers)
        assert [one is None for one in native] == [one is None for one in reference]
        for number, ours, theirs in zip(wanted, native, reference, strict=True):
            if ours is None:
                continue
            made[number] += 1
            if number == 0:
                assert ours == theirs
                continue
            start, stop = (17, 65) if number == 1 else (30, 86)
            assert (ours[:start], ours[stop:]) == (theirs[:start], theirs[stop:])
            values = [np.frombuffer(one, "<f8", (stop - start) // 8, start) for one in (ours, theirs)]
            np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-12)
    assert min(made) > 50


def test_the_templates_are_as_they_were(makers: list[Any]) -> None:
    row = drawn(np.random.default_rng(2))
    for maker in makers:
        first = maker.of_row(row, [0])
        maker.of_row(drawn(np.random.default_rng(3)), [0, 1, 2])
        assert maker.of_row(row, [0]) == first
        assert maker.of_row(row, []) == []


def test_others_than_rows_are_refused(makers: list[Any]) -> None:
    row = HEAD + bytes(SIZE - 4)
    for maker in makers:
        assert maker.of_row(row, [0, 1, 2]) == [None, None, None]
        for bad in (row[:-1], row + b"\0", b"HEAD" + row[4:], b""):
            with pytest.raises(
                ShapeError, match=f"^Expected a row of {SIZE} bytes of this schema, got {len(bad)} bytes"
            ):
                maker.of_row(bad, [0])
        for number in (-1, 3):
            with pytest.raises(ShapeError, match="Expected numbers of 3 topics, got"):
                maker.of_row(row, [number])


@pytest.mark.parametrize(
    "change",
    [
        {0: SIZE - 7}, {0: -1}, {1: [(Q, 7), (A, 14)]}, {1: [(Q, 7), (-8, 6)]}, {1: BOTH[:1]}, {2: [None] * 3}, {3: 3},
        {2: [None, None, None, (MESSAGE, 93, [])]}, {2: [None, None, None, (MESSAGE, -1, [])]},
        {2: [None, None, None, (MESSAGE, 0, [(93, Q, 1)])]}, {2: [None, None, None, (MESSAGE, 0, [(8, SIZE - 7, 1)])]},
        {2: [None, None, None, (MESSAGE, 0, [(8, Q, -1)])]},
    ],
)  # fmt: skip
def test_topics_that_contradict_themselves_are_refused(change: dict[int, Any]) -> None:
    for backend in (_native, _reference):
        topic = topics(backend)[0]
        wrong = tuple(change.get(k, value) for k, value in enumerate(topic))
        with pytest.raises(ShapeError, match="places are inside of rows and messages"):
            backend.RowMessages(HEAD, SIZE, CLOCK, [wrong])


def test_kinds_that_need_an_arm_are_checked() -> None:
    for backend in (_native, _reference):
        _, turned, pose = topics(backend)
        for wrong in (
            (*turned[:5], SIZE - 8),
            (*turned[:2], [None, None, None, (MESSAGE, 0, [(8, A, 5)])], *turned[3:]),
            (*pose[:2], [None, (MESSAGE, 0, [(8, 0, 6)])], *pose[3:]),
            (*pose[:2], [None, (MESSAGE, 0, [(48, 0, 7)])], *pose[3:]),
        ):
            with pytest.raises(ShapeError, match="places are inside of rows and messages"):
                backend.RowMessages(HEAD, SIZE, CLOCK, [wrong])
