"""MAT files of version 5: the arrays that SciPy reads; damaged files give arrays or a sentence."""

from __future__ import annotations

import contextlib
import struct
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from armlab.errors import LogError
from armlab.log.file_formats.mat import variables_in


def saved(variables: dict[str, Any], packed: bool) -> bytes:
    file = BytesIO()
    savemat(file, variables, do_compression=packed)
    return file.getvalue()


@pytest.mark.parametrize("packed", [False, True])
def test_arrays_as_scipy_reads_them(packed: bool) -> None:
    arrays = {
        "few": np.array([[1, 2, 3]], np.int16),
        "deep": np.arange(24.0).reshape(2, 3, 4),
        "none": np.zeros((0, 3)),
        "flags": np.array([[True], [False]]),
        "large": np.array([[2**63]], np.uint64),
        "single": np.array([[0.1]], np.float32),
    }
    data = saved(arrays, packed)
    found, wanted = variables_in(data), loadmat(BytesIO(data))
    assert set(found) == set(arrays)
    for name, array in found.items():
        assert array is not None
        assert array.dtype == wanted[name].dtype
        np.testing.assert_array_equal(array, wanted[name])


def test_a_file_of_a_big_endian_computer() -> None:
    flags, sizes = struct.pack(">IIII", 6, 8, 6, 0), struct.pack(">IIii", 5, 8, 2, 1)
    body = flags + sizes + struct.pack(">HH4s", 1, 1, b"t") + struct.pack(">IIdd", 9, 16, 1.0, 2.0)
    data = b"MATLAB 5.0".ljust(124) + b"\1\0MI" + struct.pack(">II", 14, len(body)) + body
    np.testing.assert_array_equal(variables_in(data)["t"], [[1.0], [2.0]])


def test_texts_cells_and_what_is_neither() -> None:
    cells = np.array([["a"], ["grå"], [""]], dtype=object)
    mixed = np.array([[1.0], ["b"]], dtype=object)
    found = variables_in(saved({"text": "grå", "cells": cells, "mixed": mixed, "s": {"a": 1}, "z": 1j}, packed=False))
    assert {k: None if v is None else v.tolist() for k, v in found.items()} == {
        "text": [["grå"]],
        "cells": [["a"], ["grå"], [""]],
        "mixed": None,
        "s": None,
        "z": None,
    }


def test_a_bomb_is_refused_by_the_size_that_it_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.mat._UNPACKED", 1000)
    monkeypatch.setattr("armlab.log.file_formats.mat._RATIO", 2)
    data = saved({"t": np.zeros(1000)}, packed=True)
    with pytest.raises(LogError, match="Expected variables of at most 1000 bytes in a file of this size, got 8"):
        variables_in(data)


@pytest.mark.parametrize("count", [200, pytest.param(2000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("packed", [False, True])
def test_wrong_bytes(packed: bool, count: int) -> None:
    """SciPy's reader ends the process on 3 % of those that are not packed."""
    cells = np.array([["a"], ["grå"], [""]], dtype=object)
    variables = {"t": np.arange(20.0), "text": "hello", "cells": cells, "s": {"a": 1.0}, "z": np.array([1j])}
    data = saved(variables, packed)
    rng = np.random.default_rng(0)
    for _ in range(count):
        spoilt = np.frombuffer(data, dtype=np.uint8).copy()
        places = rng.integers(124, len(data), rng.integers(1, 6))
        spoilt[places] = rng.choice(np.array([0, 1, 127, 128, 255, rng.integers(256)]), len(places))
        with contextlib.suppress(LogError, ValueError, OverflowError):
            variables_in(spoilt.tobytes())
