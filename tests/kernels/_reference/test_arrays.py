"""Checks of arguments in the reference kernels."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import read, result, same_shape


def test_read_converts_without_copying_what_fits() -> None:
    plain = np.zeros((2, 3))
    assert read(plain, "q", (3,)) is plain
    np.testing.assert_array_equal(read([[1, 2, 3]], "q", (3,)), [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("value", "exact", "sentence"),
    [
        (np.zeros(4), False, r"q of shape \(\.\.\., 3\), got \(4,\)\. Put the joints on the last axis"),
        (np.zeros((2, 3)), True, r"q of shape \(3,\), got \(2, 3\)\.$"),
        (np.float64(0.0), False, r"got \(\)"),
        ([1j, 0, 0], False, "does not convert to float64"),
        ([[1], [2, 3]], False, "does not convert to float64"),
    ],
)
def test_read_refuses(value: object, exact: bool, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        read(value, "q", (3,), exact)


def test_same_shape() -> None:
    same_shape(np.zeros((2, 3)), "qd", np.ones((2, 3)), "q")
    with pytest.raises(ShapeError, match=r"qd of the same shape as q, \(2, 3\), got \(3,\)"):
        same_shape(np.zeros(3), "qd", np.ones((2, 3)), "q")


def test_result_writes_into_out() -> None:
    value, out = np.arange(6.0).reshape(2, 3), np.empty((2, 3))
    assert result(value, None) is value
    assert result(value, out) is out
    np.testing.assert_array_equal(out, value)
    frozen = np.empty((2, 3))
    frozen.flags.writeable = False
    for wrong in (np.empty((3, 2)), np.empty((2, 3), dtype=int), np.empty((3, 2)).T, frozen, [1.0]):
        with pytest.raises(ShapeError, match="writable C-contiguous float64"):
            result(value, wrong)
