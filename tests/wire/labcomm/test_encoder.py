"""Packets of an encoder, and values that do not fit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.errors import LabCommError, UnknownName
from armlab.wire.labcomm import Decoder, Sample, parse_lc
from armlab.wire.labcomm.encoder import Encoder, write_packet
from armlab.wire.labcomm.types import Definition, SampleType, Unknown, Version

ROW = parse_lc("sample struct { int tm; double pos[7]; double vel[7]; double trq[7]; } robot_row;")[0]
VALUE = {"tm": 5, "pos": [0.5] * 7, "vel": [0.0] * 7, "trq": [-1.0] * 7}


def sample(text: str) -> SampleType:
    found = parse_lc(f"sample {text};")[0]
    assert isinstance(found, SampleType)
    return found


@pytest.mark.parametrize(
    ("dialect", "raw"),
    [
        ("2014v1", "010f0e" + b"LabComm2014.v1".hex() + "020940" + "05735f696e740123" + "400400000000"),
        ("2014", "010c0b" + b"LabComm2014".hex() + "020940" + "05735f696e740123" + "400400000000"),
        ("2014i", "010c0b" + b"LabComm2014".hex() + "020b40" + "010005735f696e740123" + "400400000000"),
        ("2013", "0b" + b"LabComm2013".hex() + "0240" + "05735f696e7423" + "4000000000"),
        ("2006", "0000000200000040" + "00000005735f696e7400000023" + "0000004000000000"),
    ],
)
def test_first_bytes_of_a_stream(dialect: str, raw: str) -> None:
    encoder, number = Encoder(dialect), sample("int s_int")
    assert (encoder.version() + encoder.define(number) + encoder.data(number, 0)).hex() == raw
    assert encoder.dialect == dialect


def test_a_robot_row_is_175_bytes() -> None:
    encoder = Encoder()
    assert len(encoder.define(ROW)) == 44
    packet = encoder.data(ROW, VALUE)
    assert len(packet) == 175
    assert packet[:3].hex() == "40812c"
    for kind in (tuple, np.array):
        assert (
            encoder.data(ROW, {name: kind(v) if name != "tm" else np.int32(v) for name, v in VALUE.items()}) == packet
        )


def test_one_index_per_type() -> None:
    encoder, number = Encoder(), sample("int n")
    first = encoder.define(number)
    assert encoder.define(SampleType("n", number.type, (("source", "x"),))) == first
    assert encoder.define(ROW)[2] == 0x41


def test_references_are_types_or_indices() -> None:
    encoder, ref, number = Encoder(), sample("sample r"), sample("int n")
    raw = encoder.version() + encoder.define(ref) + encoder.ref(number)
    raw += b"".join(encoder.data(ref, value) for value in (number, ROW, 0, encoder.ref_index(number)))
    decoder = Decoder()
    values = [event.value for event in decoder.feed(raw) if isinstance(event, Sample)]
    assert values == [0x40, 0, 0, 0x40]
    assert decoder.refs.get(0x40) == number
    with pytest.raises(LabCommError, match="references"):
        Encoder("2006").ref(number)


def test_type_bindings_are_sent_on_request() -> None:
    encoder = Encoder("2014", type_defs=True)
    assert encoder.define(sample("int n")).hex() == "020540016e0123" + "05024000"
    with pytest.raises(LabCommError, match="2014 or 2014i"):
        Encoder("2014v1", type_defs=True)


@pytest.mark.parametrize(
    ("text", "value", "message"),
    [
        ("int n", 1.5, "n: expected a value of type int, got 1.5"),
        ("int n", 2**31, "n: expected a value of type int, got 2147483648"),
        ("byte n", -1, "n: expected a value of type byte, got -1"),
        ("float n", 1e300, "n: expected a value of type float"),
        ("boolean n", "no", "n: expected True or False"),
        ("string n", b"raw", "n: expected a string, got"),
        ("string n", "a\0b", "n: expected a string without NUL"),
        ("string n", "\ud800", "n: expected a string that can be encoded as UTF-8"),
        ("double n[7]", [0.0] * 6, "n: expected 7 values, got 6"),
        ("double n[_]", 1.0, r"n: expected a list for double\[_\], got 1.0"),
        ("double n[_]", "12", "n: expected a list for"),
        ("int n[_,_]", [[1], [2, 3]], "n: expected rows of equal length, got 1 and 2 values"),
        ("int n[_,_]", [[1], [None]], r"n\[1\]\[0\]: expected a value of type int, got None"),
        ("int n[2,2]", np.zeros((2, 3), int), "n: expected 2 values, got 3"),
        ("void n", {"a": 1}, r"n: expected no fields, but also got a"),
        ("struct { int a; int b; } n", {"a": 1}, "n: expected the fields a, b, but b is missing"),
        ("struct { int a; int b; } n", {"a": 1, "b": 2, "c": 3}, "n: expected the fields a, b, but also got c"),
        ("struct { int a; int b; } n", 3, "n: expected a dict, got 3"),
        ("struct { string s; int a; double b[2]; } n", {"s": "", "a": 1, "b": [1.0]}, r"n\.b: expected 2 values"),
        (
            "struct { string s; int a; double b[2]; } n",
            {"s": "", "a": 1},
            "n: expected the fields s, a, b, but b is missing",
        ),
        (
            "struct { string s; int a; int b; } n",
            {"s": "", "a": 1, "c": 2},
            "n: expected the fields s, a, b, but b is missing",
        ),
        ("struct { int a; int b; string s; } n", [1, 2, ""], r"n: expected a dict, got \[1, 2, ''\]"),
        ("struct { struct { string s; } p[_]; } n", {"p": [{"s": "a"}, {"s": 1}]}, r"n.p\[1\].s: expected a string"),
    ],
)
def test_values_that_do_not_fit_say_where(text: str, value: Any, message: str) -> None:
    encoder, kind = Encoder(), sample(text)
    encoder.define(kind)
    with pytest.raises(LabCommError, match=f"^{message}") as caught:
        encoder.data(kind, value)
    assert str(caught.value).startswith(caught.value.path)


@pytest.mark.parametrize("value", [[0.0] * 6, [0.0] * 8, "1234567", dict.fromkeys(range(7)), np.zeros((7, 1)), None])
def test_a_row_of_the_wrong_form_is_refused(value: Any) -> None:
    encoder = Encoder()
    encoder.define(ROW)
    with pytest.raises(LabCommError, match=r"^robot_row\.pos"):
        encoder.data(ROW, {**VALUE, "pos": value})


def test_numpy_arrays_keep_sizes_that_lists_hide() -> None:
    encoder, kind = Encoder(), sample("int n[_,_]")
    encoder.define(kind)
    assert encoder.data(kind, np.zeros((0, 5), int)).hex() == "40020005"
    assert encoder.data(kind, []).hex() == "40020000"
    assert encoder.data(kind, [[], []]).hex() == "40020200"


def test_a_type_is_defined_before_its_values() -> None:
    with pytest.raises(LabCommError, match="define first"):
        Encoder().data(ROW, VALUE)
    with pytest.raises(UnknownName):
        Encoder("2012")
    with pytest.raises(LabCommError, match="a name encodable in UTF-8"):
        Encoder().define(SampleType("\ud800", ROW.type))


def test_write_packet_says_what_a_dialect_cannot() -> None:
    assert write_packet(Version("LabComm2014"), "2014old", 13)[1] == 13
    assert write_packet(Unknown(0x50, b"ab"), "2014") == b"\x50\x02ab"
    assert write_packet(Unknown(2**32 - 1, b""), "2014").hex() == "8fffffff7f00"
    with pytest.raises(LabCommError, match="from 0 to 4294967295"):
        write_packet(Unknown(2**32, b""), "2014")
    with pytest.raises(LabCommError, match="Unknown"):
        write_packet(Unknown(0x50, b"ab"), "2013")
    with pytest.raises(LabCommError, match="2006"):
        write_packet(Definition("ref", 0x40, "n", ROW.type), "2006")
    with pytest.raises(LabCommError, match=r"robot_row.pos: expected 7 values"):
        write_packet(Sample(0x40, "robot_row", {**VALUE, "pos": []}, ROW.type), "2014")
