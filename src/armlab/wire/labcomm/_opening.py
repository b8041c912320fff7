"""The beginning of a stream: which dialect it is, and VERSION."""

from __future__ import annotations

from collections.abc import Generator, Set
from typing import NamedTuple

from armlab.errors import LabCommError
from armlab.wire.labcomm._source import Source, number
from armlab.wire.labcomm.dialects import DIALECTS, Dialect
from armlab.wire.labcomm.encoder import VERSION
from armlab.wire.labcomm.events import Version
from armlab.wire.labcomm.limits import Limits

__all__ = ["HEADER", "Opening", "opening", "version"]

HEADER = 10
"""Bytes of a tag and a length at most."""

_FIRST = {0x00: DIALECTS["2006"], 0x01: DIALECTS["2014"], 0x0B: DIALECTS["2013"]}


class Opening(NamedTuple):
    """The dialect, whether it may still be 2014i instead of 2014, and what was announced."""

    dialect: Dialect
    is_undecided: bool
    events: list[Version]


def opening(
    source: Source, given: Dialect | None, require_version: bool, limits: Limits
) -> Generator[None, None, Opening]:
    """Walk over the announcement, if there is one."""
    yield from source.need(1)
    first = source.buf[0]
    guess = _FIRST.get(first) if given is None else given
    if guess is None:
        raise _bad(0, "the beginning of a LabComm stream (00, 01 or 0b)", f"{first:02x}")
    announces = {"2013": 0x0B, "2006": first}.get(guess.name, VERSION)
    if first != announces and require_version:
        raise _bad(0, f"the VERSION of {guess.name}", f"{first:02x}")
    if first != announces or guess.name == "2006":
        return Opening(guess, False, [])
    if guess.name == "2013":
        yield from source.need(12)
        if source.slice(1, 12) != guess.version.encode():
            raise _bad(0, guess.version, repr(source.slice(1, 12)))
        source.at = 12
        return Opening(guess, False, [Version(guess.version)])
    every = {dialect.version for dialect in DIALECTS.values() if dialect.lengths}
    text, extra = yield from version(source, every if given is None else {guess.version}, limits)
    if given is None and text == DIALECTS["2014v1"].version:
        guess = DIALECTS["2014v1"]
    if guess.name == "2014" and extra:
        guess = DIALECTS["2014old"]
    return Opening(guess, given is None and guess.name == "2014", [Version(text)])


def version(source: Source, wanted: Set[str], limits: Limits) -> Generator[None, None, tuple[str, int]]:
    """Walk over VERSION: its text, and by how much (0 or 1) the declared length is too large."""
    end = source.at + 2 * HEADER + limits.packet
    _, where = yield from number(source, source.at, end, wide=False)
    declared, begin = yield from number(source, where, end, wide=False)
    size, pos = yield from number(source, begin, end, wide=False)
    if size > limits.version:
        raise _bad(begin, f"a VERSION of at most {limits.version} bytes", f"{size} bytes")
    stop = pos + size
    yield from source.need(stop)
    text = source.slice(pos, stop).decode("ascii", "replace")
    if text not in wanted:
        raise _bad(begin, " or ".join(sorted(wanted)), repr(text))
    extra = declared - (stop - begin)
    if extra not in (0, 1):
        raise _bad(where, f"a length of {stop - begin}", str(declared))
    source.at = stop
    return text, extra


def _bad(offset: int, expected: str, got: str) -> LabCommError:
    return LabCommError(f"Expected {expected} at byte {offset}, got {got}.", offset)
