"""Layouts of messages: found once, checked on whole blocks; their numbers are copied at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from armlab.log.column import refuse_ragged
from armlab.log.mcap.records import DAMAGE
from armlab.wire import cdr

_MAX_VARIANTS = 8  # layouts remembered per channel and length; text that differs in every message is read one by one

# Numbers of one type that follow each other in a message: (path, count) of each.
Run = tuple[tuple[str, int], ...]
Values = dict[Run, np.ndarray]
Piece = tuple[np.ndarray, Values]
"""Rows (k,) of messages, and their numbers (k, count)."""


@dataclass(slots=True)
class Variant:
    """Messages of one length with equal bytes in `fixed`: start, stop and type of the runs of their numbers."""

    first: np.ndarray
    fixed: list[tuple[int, int]]
    runs: dict[Run, tuple[int, int, str]]

    def numbers(self, block: np.ndarray) -> Values:
        """Return the numbers (k, count) of messages (k, length), in the machine's byte order."""
        found = {}
        for run, (start, stop, dtype) in self.runs.items():
            array = block[:, start:stop].copy().view(dtype)  # the block's memory is used again
            found[run] = array.astype(array.dtype.newbyteorder("="), copy=False)
        return found


@dataclass(slots=True)
class MessageReader:
    """What is wanted of one channel, all when None, and the layouts seen so far.

    `named` gives the numbers of a layout names that its texts tell: positions by joint, transforms by frame.
    """

    type: str
    types: cdr.Definitions
    wanted: frozenset[str] | None
    named: Callable[[cdr.Layout], Sequence[cdr.Field]] | None = None
    variants: dict[int, list[Variant]] = field(default_factory=dict)


@dataclass(slots=True)
class Read:
    """Messages without those that do not fit their type.

    `rows`: (k,) of all messages, in order; `pieces`: numbers, by layout, of rows of these; `bad`: how many do not fit;
    `reason`: why the first of them does not.
    """

    rows: np.ndarray
    pieces: list[Piece]
    bad: int
    reason: str


@dataclass(slots=True)
class _Bad:
    """Rows of messages that do not fit, and why the first does not: as many sentences as messages are too many."""

    rows: list[int] = field(default_factory=list)
    first: int = 0
    reason: str = ""

    def add(self, row: int, reason: str) -> None:
        if not self.rows or row < self.first:
            self.first, self.reason = row, reason
        self.rows.append(row)


def of_length(lengths: np.ndarray) -> list[np.ndarray]:
    """Return the rows (k,), in order, of the messages of each length."""
    order = np.argsort(lengths, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(lengths[order])) + 1) if len(order) else []


def read_blocks(count: int, blocks: Iterable[tuple[np.ndarray, np.ndarray]], reader: MessageReader) -> Read:
    """Read messages in blocks of one length each.

    A message is walked only where its layout is a new one or it fits none, so the time is bounded by the bytes.

    `blocks`: rows (k,) and bytes (k, length) of those of each length.
    """
    pieces: list[Piece] = []
    bad = _Bad()
    for rows, block in blocks:
        pieces += _read_block(block, rows, reader, bad)
    rows = np.arange(count)
    if bad.rows:
        rows = np.delete(rows, bad.rows)
        pieces = [(np.searchsorted(rows, piece), values) for piece, values in pieces]
    few = len(pieces) <= _MAX_VARIANTS
    return Read(rows, pieces if few else joined(pieces), len(bad.rows), bad.reason)


def _read_block(block: np.ndarray, rows: np.ndarray, reader: MessageReader, bad: _Bad) -> Iterator[Piece]:
    """Yield (rows, numbers) of messages of one length, layout by layout; what does not fit goes to `bad`."""
    known = reader.variants.setdefault(block.shape[1], [])
    for variant in list(known):
        same = _same(block, variant)
        if same.any():
            yield rows[same], variant.numbers(block[same] if not same.all() else block)
            block, rows = block[~same], rows[~same]
        if not len(block):
            return
    while len(block):
        try:
            variant = variant_of(block[0], reader)
        except DAMAGE as error:
            bad.add(int(rows[0]), str(error) or type(error).__name__)
            block, rows = block[1:], rows[1:]
            continue
        if len(known) < _MAX_VARIANTS:
            known.append(variant)
            same = _same(block, variant)
            yield rows[same], variant.numbers(block[same])
            block, rows = block[~same], rows[~same]
        else:  # one by one: all against all would be quadratic
            yield rows[:1], variant.numbers(block[:1])
            block, rows = block[1:], rows[1:]


def _same(block: np.ndarray, variant: Variant) -> np.ndarray:
    """Return the mask (k,) of messages whose bytes outside the numbers are those of the variant."""
    same = np.ones(len(block), dtype=bool)
    for start, stop in variant.fixed:
        equal = block[:, start:stop] == variant.first[start:stop]
        if not equal.all():
            same &= equal.all(axis=1)
    return same


def variant_of(first: np.ndarray, reader: MessageReader) -> Variant:
    """Walk one message: its bytes outside the numbers, and the wanted numbers as runs."""
    raw = first.tobytes()
    found = cdr.layout(raw, reader.type, reader.types)
    fixed, at = [], 0
    for start, stop in [*((f.start, f.stop) for f in found.fields), (len(raw), len(raw))]:
        if start > at:
            fixed.append((at, start))
        at = stop
    fields = reader.named(found) if reader.named else found.fields
    wanted = (f for f in fields if f.count and (reader.wanted is None or f.path in reader.wanted))
    return Variant(np.frombuffer(raw, dtype=np.uint8), fixed, dict(_runs(wanted)))


def _runs(fields: Iterable[cdr.Field]) -> Iterator[tuple[Run, tuple[int, int, str]]]:
    """Yield the numbers of one type that follow each other, with start, stop and type."""
    run: list[tuple[str, int]] = []
    start, stop, dtype = 0, 0, ""
    for one in fields:
        if run and (one.start != stop or one.dtype != dtype):
            yield tuple(run), (start, stop, dtype)
            run = []
        if not run:
            start, dtype = one.start, one.dtype
        run.append((one.path, one.count))
        stop = one.stop
    if run:
        yield tuple(run), (start, stop, dtype)


def joined(pieces: Iterable[Piece]) -> list[Piece]:
    """Return pieces with the same columns as one, in the order of the first of each."""
    alike: dict[tuple[Run, ...], list[Piece]] = {}
    for piece in pieces:
        alike.setdefault(tuple(piece[1]), []).append(piece)
    return [
        one[0]
        if len(one) == 1
        else (
            np.concatenate([rows for rows, _ in one]),
            {run: np.concatenate([values[run] for _, values in one]) for run in runs},
        )
        for runs, one in alike.items()
    ]


def assembled(count: int, pieces: Sequence[Piece]) -> Values:
    """Put the numbers of several layouts into their rows; NaN where a layout has none."""
    places = [_place(rows) for rows, _ in pieces]
    if len(pieces) == 1 and isinstance(places[0], slice):
        return pieces[0][1]
    if all(found.keys() == pieces[0][1].keys() for _, found in pieces):
        return {
            run: _filled(count, places, [found[run] for _, found in pieces]) for run in (pieces[0][1] if pieces else ())
        }
    parts: dict[str, tuple[list[np.ndarray | slice], list[np.ndarray]]] = {}
    for place, (_, found) in zip(places, pieces, strict=True):
        for path, array in split(found).items():
            there, arrays = parts.setdefault(path, ([], []))
            there.append(place)
            arrays.append(array)
    widths = {path: max(array.shape[1] for array in arrays) for path, (_, arrays) in parts.items()}
    refuse_ragged(count, widths, sum(array.size for _, arrays in parts.values() for array in arrays))
    return {((path, widths[path]),): _filled(count, *one) for path, one in parts.items()}


def _place(rows: np.ndarray) -> np.ndarray | slice:
    """Return rows as a slice where they follow each other, which is faster."""
    return slice(int(rows[0]), int(rows[0]) + len(rows)) if len(rows) and (np.diff(rows) == 1).all() else rows


def _filled(count: int, places: Sequence[np.ndarray | slice], arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays (k, width) in their rows of one (count, largest width), NaN elsewhere."""
    width = max(array.shape[1] for array in arrays)
    whole = sum(map(len, arrays)) == count and all(array.shape[1] == width for array in arrays)
    kind = np.result_type(*{array.dtype for array in arrays})  # counts with holes are real numbers already
    target = np.empty((count, width), kind) if whole else np.full((count, width), np.nan)
    for place, array in zip(places, arrays, strict=True):
        target[place, : array.shape[1]] = array
    return target


def split(values: Values) -> dict[str, np.ndarray]:
    """Return the numbers of each path from runs."""
    fields = {}
    for run, array in values.items():
        at = 0
        for path, count in run:
            fields[path] = array[:, at : at + count]
            at += count
    return fields
