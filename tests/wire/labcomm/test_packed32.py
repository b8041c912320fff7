"""packed32: the table of the format, both ways, and what is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.errors import LabCommError
from armlab.wire.labcomm.dialects import decode_packed32, encode_packed32


@pytest.mark.parametrize(
    ("n", "raw"),
    [(0, "00"), (127, "7f"), (128, "8100"), (300, "822c"), (172, "812c"), (2**32 - 1, "8fffffff7f")],
)
def test_the_bytes_of_the_format(n: int, raw: str) -> None:
    assert encode_packed32(n).hex() == raw
    assert decode_packed32(bytes.fromhex(raw), 0) == (n, len(raw) // 2)


@given(st.integers(0, 2**32 - 1), st.binary(max_size=3), st.integers(0, 4))
def test_decode_inverts_encode(n: int, before: bytes, zeros: int) -> None:
    raw = encode_packed32(n)
    longer = b"\x80" * min(zeros, 5 - len(raw)) + raw
    assert decode_packed32(before + longer + b"x", len(before)) == (n, len(before) + len(longer))


@pytest.mark.parametrize("n", [-1, 2**32])
def test_numbers_out_of_range_are_refused(n: int) -> None:
    with pytest.raises(LabCommError, match="from 0 to"):
        encode_packed32(n)


@pytest.mark.parametrize("raw", ["", "81", "808080808001", "9080808000"])
def test_bytes_that_are_no_number_are_refused(raw: str) -> None:
    with pytest.raises(LabCommError, match="at byte 2") as caught:
        decode_packed32(b"\xff\xff" + bytes.fromhex(raw), 2)
    assert caught.value.offset == 2
