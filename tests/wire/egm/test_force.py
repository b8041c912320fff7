"""measuredForce in both layouts, bytes typed by hand."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.wire.egm.pose_force import NO_WRENCH, decode_force, encode_force, is_layout_of_rw7

FORCE = (1.0, -2.0, 3.5, 0.1, 0.2, -0.3)
DOUBLES = [struct.pack("<d", value) for value in FORCE]


@pytest.mark.parametrize(
    ("data", "is_rw7"),
    [
        (b"".join(b"\x09" + d for d in DOUBLES), False),
        (b"\x0a\x30" + b"".join(DOUBLES), False),
        (b"\x08\x01" + b"".join(b"\x11" + d for d in DOUBLES), True),
        (b"".join(b"\x11" + d for d in DOUBLES), True),
        (b"\x12\x30" + b"".join(DOUBLES), True),
        (b"".join(b"\x11" + d for d in DOUBLES) + b"\x08\x00", True),
    ],
    ids=["rw6 unpacked", "rw6 packed", "rw7", "rw7 without fcActive", "rw7 packed", "rw7 other order"],
)
def test_the_first_tag_tells_the_layout(data: bytes, is_rw7: bool) -> None:
    assert decode_force(data) == (FORCE, is_rw7)
    assert is_layout_of_rw7(data) == is_rw7


@pytest.mark.parametrize(
    "data", [b"", b"\x09", b"\xff\xff", b"\x09" + DOUBLES[0], b"\x1a\x00", b"\x0a\x7f"], ids=lambda data: data.hex()
)
def test_what_is_no_force_is_nan(data: bytes) -> None:
    assert decode_force(data) == (NO_WRENCH, False)
    assert np.isnan(NO_WRENCH).all()


def test_force_control_without_values_still_tells_the_version() -> None:
    assert decode_force(b"\x08\x00") == (NO_WRENCH, True)


@pytest.mark.parametrize("is_rw7", [False, True])
def test_round_trip(is_rw7: bool) -> None:
    assert decode_force(encode_force(np.array(FORCE), is_rw7)) == (FORCE, is_rw7)


@given(st.binary(max_size=80))
def test_never_raises(data: bytes) -> None:
    result: Any = decode_force(data)
    assert len(result[0]) == 6
