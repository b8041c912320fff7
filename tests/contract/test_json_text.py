"""Texts of JSON by the compiled kernel and by the reference: the same values, and the same refusals."""

from __future__ import annotations

import json
import struct
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

BACKENDS = (_native, _reference)
FORMS = "bBhHiIqQfd"


def both(parts: list[bytes], slots: list[tuple[int, bytes]], data: bytes) -> list[bytes]:
    return [backend.JsonText(parts, slots).of(data) for backend in BACKENDS]


def test_golden_text() -> None:
    data = struct.pack("<dq?2d", -0.5, 1_700_000_000_250_000_000, True, np.nan, 3.0)
    slots = [(0, b"d"), (8, b"t"), (16, b"?"), (17, b"d"), (25, b"d")]
    for text in both([b'{"a":[', b",", b'],"b":', b',"c":[', b",", b"]}"], slots, data):
        assert text == b'{"a":[-0.5,1700000000.25],"b":true,"c":[null,3.0]}'
    assert both([b"{}"], [], b"") == [b"{}", b"{}"]


def test_random_bytes_are_the_same_values() -> None:
    """Every form, at any place, in any order, for any bits; reals keep all theirs, and stay reals."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        forms, data = rng.choice(list(FORMS + "t"), 12), rng.bytes(96)
        slots = [(int(at), str(form).encode()) for at, form in zip(rng.integers(0, 89, 12), forms, strict=True)]
        texts = both([b"[", *[b","] * 11, b"]"], slots, data)
        native, reference = (json.loads(text) for text in texts)
        assert native == reference
        assert [type(one) for one in native] == [type(one) for one in reference]
        for value, (at, form) in zip(native, slots, strict=True):
            (true,) = struct.unpack_from("<" + form.decode().replace("t", "q"), data, at)
            if form != b"t" and value is not None:
                assert struct.pack("<d", value) == struct.pack("<d", true)


@pytest.mark.parametrize("value", [0.0, -0.0, 1.0, 1e16, 1e22, 123456789.0, 5e-324, -2.2250738585072014e-308, 1e-5])
def test_reals_keep_their_bits_and_are_no_integers(value: float) -> None:
    for text in both([b"", b""], [(0, b"d")], struct.pack("<d", value)):
        found = json.loads(text)
        assert isinstance(found, float)
        assert struct.pack("<d", found) == struct.pack("<d", value)


@pytest.mark.parametrize("backend", BACKENDS)
def test_refusals(backend: Any) -> None:
    with pytest.raises(ShapeError, match="one part of text more than slots"):
        backend.JsonText([b""], [(0, b"d")])
    for slot in [(-1, b"d"), (1 << 32, b"d"), (0, b"x"), (0, b"dd"), (0, b"")]:
        with pytest.raises(ShapeError, match=r"Expected slots \(place, form\)"):
            backend.JsonText([b"", b""], [slot])
    with pytest.raises(ShapeError, match="Expected at least 12 bytes, got 11"):
        backend.JsonText([b"", b""], [(4, b"d")]).of(bytes(11))
