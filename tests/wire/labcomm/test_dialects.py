"""What differs between the dialects."""

from __future__ import annotations

import pytest

from armlab.errors import LabCommError, UnknownName
from armlab.wire.labcomm.dialects import DIALECTS, Dialect, dialect_named


def test_six_dialects() -> None:
    assert list(DIALECTS) == ["2014v1", "2014", "2014i", "2014old", "2013", "2006"]
    assert dialect_named("2013") == Dialect("2013", "LabComm2013", lengths=False, references=False)
    with pytest.raises(UnknownName, match="2014v1"):
        dialect_named("2014v2")


def test_numbers_names_and_packets() -> None:
    new, notes, old = (dialect_named(name) for name in ("2014v1", "2014i", "2006"))
    assert new.number(300).hex() == "822c"
    assert old.number(300).hex() == "0000012c"
    assert new.label("val") == b"\3val"
    assert notes.label("val", (("foo", "bar"),)) == b"\x02\x00\x03val\x03foo\x03bar"
    assert new.packet(0x44, bytes(4)).hex() == "440400000000"
    assert new.packet(0x44, bytes(4), length=5).hex() == "440500000000"
    assert old.packet(0x44, bytes(4)).hex() == "0000004400000000"
    with pytest.raises(LabCommError, match="UTF-8"):
        new.label("\ud800")
    with pytest.raises(LabCommError, match="from 0 to"):
        old.number(2**32)
