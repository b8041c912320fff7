"""Messages of any layout in the records of some chunks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armlab.log.mcap.decode import Part, decode_chunks, decode_messages, walked
from armlab.log.mcap.message_layouts import assembled, split
from armlab.log.mcap.records import Chunk, unpacked


def layouts(numbered) -> tuple[memoryview, list[tuple[Chunk, bytes]]]:
    """Return a file of messages with one, two and three numbers, and its chunks, unpacked."""
    view, found = numbered.written([numbered.message(row, [float(row)] * (1 + row % 3)) for row in range(30)])
    return view, [(chunk, unpacked(view, chunk)) for chunk in found.chunks]


def test_messages_of_all_chunks_keep_their_rows(numbered) -> None:
    view, chunks = layouts(numbered)
    for indexed in (True, False):
        parts = decode_chunks(view, chunks, numbered.readers(), indexed)
        assert parts[1].bad == 0
        assert parts[1].sequence.tolist() == parts[1].log_ns.tolist() == list(range(30))
        fields = split(assembled(30, parts[1].pieces))
        assert fields["a"][:, 0].tolist() == list(range(30))
        assert np.isfinite(fields["x"]).sum(axis=1).tolist() == [1, 2, 3] * 10
        assert len(parts[2].sequence) == 0


def test_a_wrong_index_is_not_believed(numbered) -> None:
    view, chunks = layouts(numbered)
    (first, data), other = chunks[:2]
    start, stop = first.indexes[1]
    for wrong in ((start + 8, stop + 8), (7, 7 + stop - start)):
        parts = decode_chunks(view, [(replace(first, indexes={1: wrong}), data), other], numbered.readers(), True)
        whole = decode_chunks(view, chunks[:2], numbered.readers(), True)
        assert np.array_equal(parts[1].sequence, whole[1].sequence)


def test_messages_that_do_not_fit_their_type_are_left_out_alone(numbered) -> None:
    bad = b"\0\1\0\0\1"
    view, found = numbered.written([bad if row % 7 == 2 else numbered.message(row, [0.0]) for row in range(30)])
    chunks = [(chunk, unpacked(view, chunk)) for chunk in found.chunks]
    for indexed in (True, False):
        part = decode_chunks(view, chunks, numbered.readers(), indexed)[1]
        assert part.sequence.tolist() == part.log_ns.tolist() == [row for row in range(30) if row % 7 != 2]
        assert split(assembled(len(part.sequence), part.pieces))["a"][:, 0].tolist() == part.sequence.tolist()
        assert part.bad == 4
        assert part.reason.startswith("Expected 1 numbers of type int32 in a, got the end")


def test_messages_are_found_by_walking(numbered) -> None:
    _, chunks = layouts(numbered)
    data = chunks[0][1]
    offsets = walked(data, [1, 2])
    assert len(offsets[2]) == 0
    part = decode_messages(np.frombuffer(data, np.uint8), offsets[1], numbered.readers()[1])
    assert isinstance(part, Part)
    assert part.sequence.tolist() == list(range(len(offsets[1])))
