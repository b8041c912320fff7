"""A row is read only with the sum of its bytes attached."""

from __future__ import annotations

from typing import Any, NamedTuple

from hypothesis import given
from hypothesis import strategies as st

from armlab.bridge.servers.row import LARGEST
from armlab.bridge.servers.zenoh import checksum, undamaged


class Bytes(NamedTuple):
    data: bytes

    def to_bytes(self) -> bytes:
        return self.data


class Sample(NamedTuple):
    payload: Bytes
    attachment: Any


def test_the_check_value_of_the_polynomial() -> None:
    """That of the catalogue of parametrised CRC algorithms: CRC-32 of "123456789", here little-endian."""
    assert checksum(b"123456789") == bytes.fromhex("2639f4cb")


@given(st.binary(min_size=1, max_size=400), st.data())
def test_a_row_with_another_message_in_it_is_none(row: bytes, draw: st.DataObject) -> None:
    """Up to 32 bits in a row are always noticed; here one byte."""
    at = draw.draw(st.integers(0, len(row) - 1))
    other = bytearray(row)
    other[at] ^= draw.draw(st.integers(1, 255))
    attached = Bytes(checksum(row))
    assert undamaged(Sample(Bytes(row), attached)) == row
    assert undamaged(Sample(Bytes(bytes(other)), attached)) is None


def test_a_row_without_a_sum_is_none() -> None:
    assert undamaged(Sample(Bytes(b"row"), None)) is None
    assert undamaged(Sample(Bytes(b"row"), Bytes(b""))) is None
    assert undamaged(Sample(Bytes(b"row"), Bytes(checksum(b"row") + b"\0"))) is None


def test_a_row_that_is_larger_than_rows_are_is_none() -> None:
    for row in (bytes(LARGEST), bytes(LARGEST + 1)):
        assert (undamaged(Sample(Bytes(row), Bytes(checksum(row)))) is None) == (len(row) > LARGEST)
