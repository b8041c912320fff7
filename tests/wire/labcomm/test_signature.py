"""Flat signatures: read back, and refused at the byte at fault."""

from __future__ import annotations

import pytest

from armlab.errors import LabCommError, UnknownName
from armlab.wire.labcomm import Limits, parse_lc
from armlab.wire.labcomm.dialects import dialect_named
from armlab.wire.labcomm.signature import FIRST_INDEX, SignatureWalk, parse_signature
from armlab.wire.labcomm.source import Source
from armlab.wire.labcomm.types import TypeRef


def test_a_robot_row_has_the_signature_of_the_format() -> None:
    (row,) = parse_lc("sample struct { int tm; double pos[7]; double vel[7]; double trq[7]; } robot_row;")
    raw = row.type.signature()
    assert raw.hex() == "110402746d2303706f731001072603" + "76656c1001072603" + "74727110010726"
    assert parse_signature(raw) == row.type
    assert len(raw) == 30


@pytest.mark.parametrize(
    ("raw", "offset", "what"),
    [
        ("", 0, "the rest"),
        ("10 01", 2, "the rest"),
        ("23 00", 1, "1 more"),
        ("30", 0, "type code"),
        ("40", 0, "type code"),
        ("10 00 23", 1, "1 to 16 dimensions"),
        ("10 11", 1, "1 to 16 dimensions"),
        ("10 01 00 11 00", 3, "void"),
        ("11 01 01 61 11 00", 4, "void"),
        ("11 02 01 61 23 01 61 23", 5, "different names"),
        ("10 02 87 68 87 68 21", 4, "product"),
        ("10 01 00" * 32 + "23", 96, "32 levels"),
        ("11 02 01 61" + "10 01 85 00 26" + "01 62 10 01 c0 00 26", 0, "bytes"),
    ],
)
def test_malformed_signatures_are_refused_at_their_byte(raw: str, offset: int, what: str) -> None:
    with pytest.raises(LabCommError, match=what) as caught:
        parse_signature(bytes.fromhex(raw), limits=Limits(packet=65_536, values=16_384, definitions=1, nodes=1))
    assert caught.value.offset == offset


def test_type_indices_are_for_type_defs_only() -> None:
    source = Source()
    source.add(b"\x40")
    walk = SignatureWalk(source, dialect_named("2014"), Limits.server(), 1, type_refs=True)
    with pytest.raises(StopIteration) as done:
        next(walk.tree(0))
    assert done.value.value == (TypeRef(FIRST_INDEX), 1)
    with pytest.raises(LabCommError):
        parse_signature(b"\x28", "2013")
    with pytest.raises(UnknownName):
        parse_signature(b"\x28", "2015")
