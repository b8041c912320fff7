"""Text of JSON with numbers out of packed bytes (specification; the compiled twin is native/json_text.cpp)."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from armlab.errors import ShapeError

__all__ = ["JsonText"]

_FORMS = b"?bBhHiIqQfdt"


class JsonText:
    """A text with slots for numbers, which come from packed bytes; a number that is not finite is null.

    A real number has the fewest digits that tell it from all others, and a point or an exponent.

    Parameters
    ----------
    parts : of the text, before the first slot, between slots, and after the last.
    slots : (place, form) each: where the number begins in the bytes, and what it is, as `struct` calls it (one of
        ?bBhHiIqQfd, little-endian); t is an int64 of nanoseconds that is written as seconds.

    Raises
    ------
    ShapeError : parts and slots do not fit together, or there is no such form.
    """

    def __init__(self, parts: Sequence[bytes], slots: Sequence[tuple[int, bytes]]) -> None:
        if len(parts) != len(slots) + 1:
            raise ShapeError("Expected one part of text more than slots, got others.")
        if not all(0 <= at < 1 << 32 and len(form) == 1 and form in _FORMS for at, form in slots):
            raise ShapeError("Expected slots (place, form) with a form of ?bBhHiIqQfdt, got another.")
        self._parts = list(parts)
        self._slots = [(at, struct.Struct(b"<" + form.replace(b"t", b"q")), form == b"t") for at, form in slots]
        self._needed = max((at + form.size for at, form, _ in self._slots), default=0)

    def of(self, data: bytes) -> bytes:
        """Return the text with numbers.

        Parameters
        ----------
        data : bytes that hold them, with more after them or not.

        Raises
        ------
        ShapeError : fewer bytes than the places need.
        """
        if len(data) < self._needed:
            raise ShapeError(f"Expected at least {self._needed} bytes, got {len(data)}.")
        found = [self._parts[0]]
        for (at, form, is_time), after in zip(self._slots, self._parts[1:], strict=True):
            (value,) = form.unpack_from(data, at)
            found += [_text(1e-9 * value if is_time else value), after]
        return b"".join(found)


def _text(value: float | bool) -> bytes:
    if isinstance(value, bool):
        return b"true" if value else b"false"
    return repr(value).encode() if math.isfinite(value) else b"null"
