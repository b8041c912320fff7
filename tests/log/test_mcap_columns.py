"""Room for the messages of a file, and what it does not take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.log.mcap.decode import Room
from armlab.log.mcap.records import unpacked


@pytest.mark.parametrize("order", ["<", ">"])
def test_messages_go_to_where_they_stay(numbered, order: str) -> None:
    x = np.random.default_rng(0).normal(size=(100, 3))
    view, found = numbered.written([numbered.message(row, values.tolist(), order) for row, values in enumerate(x)])
    assert len(found.chunks) > 5
    room = Room(view, found.chunks, numbered.readers())
    rows = [room.copy(place, unpacked(view, chunk)) for place, chunk in reversed(list(enumerate(found.chunks)))]
    assert sorted(row for one in rows for row in one[1]) == list(range(100))
    assert all(len(one[2]) == 0 for one in rows)
    part = room.part(1, range(10, 90))
    assert part.sequence.tolist() == part.log_ns.tolist() == list(range(10, 90))
    ((rows, values),) = part.pieces
    assert rows.tolist() == list(range(len(part.sequence)))
    numbers = {run[0][0]: array for run, array in values.items()}
    assert np.array_equal(numbers["x"], x[10:90])
    assert numbers["a"][:, 0].tolist() == list(range(10, 90))
    assert numbers["b"].dtype == np.float32
    assert numbers["b"][:, 0].tolist() == [a / 2 for a in range(10, 90)]
    for array in numbers.values():
        assert not array.flags.writeable
        assert not isinstance(array.base, np.ndarray) or not array.base.flags.writeable
    assert len(room.part(2, range(0)).sequence) == 0


def test_other_layouts_are_not_taken(numbered) -> None:
    view, found = numbered.written([numbered.message(row, [1.0] * (4 if row == 60 else 3)) for row in range(100)])
    room = Room(view, found.chunks, numbered.readers())
    taken = [1 in room.copy(place, unpacked(view, chunk)) for place, chunk in enumerate(found.chunks)]
    assert taken.count(False) == 1


def test_an_index_that_cannot_be_true_takes_no_room(numbered) -> None:
    view, found = numbered.written([numbered.message(row, [1.0]) for row in range(100)])
    chunks = list(found.chunks)
    start, stop = chunks[2].indexes[1]
    chunks[2] = replace(chunks[2], indexes={1: (start, start + 16 * (chunks[2].size + 1))})
    chunks[3] = replace(chunks[3], indexes={1: (start, stop + 16)}, size=1 << 60)
    room = Room(view, chunks, numbered.readers())
    copied = [room.copy(place, unpacked(view, chunk)) for place, chunk in enumerate(found.chunks)]
    assert [1 in one for one in copied] == [True, True, False, False] + [True] * (len(chunks) - 4)
    rows = [len(one[1]) for one in copied if 1 in one]
    assert copied[-1][1].stop == sum(rows) + (stop - start) // 16 + 1


def test_the_first_message_that_can_be_read_tells_the_layout(numbered) -> None:
    view, found = numbered.written([numbered.message(row, [1.0]) for row in range(100)])
    chunks = [replace(found.chunks[0], crc=1), *found.chunks[1:]]
    room = Room(view, chunks, numbered.readers())
    assert 1 in room.copy(1, unpacked(view, chunks[1]))
    nonsense, found = numbered.written([b"\0\1\0\0\1"] * 3)
    room = Room(nonsense, found.chunks, numbered.readers())
    assert list(room.copy(0, unpacked(nonsense, found.chunks[0]))) == [2]


def test_a_file_without_chunks_has_no_room(numbered) -> None:
    view, _ = numbered.written([])
    Room(view, [], numbered.readers())
