"""What the functions of the Lie groups refuse, compiled and in NumPy, and what passes."""

from __future__ import annotations

import re
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

MODULES = pytest.mark.parametrize("module", [_native, _reference], ids=["native", "reference"])


def matrices(*changes: tuple[tuple[int, ...], float]) -> np.ndarray:
    return poses(*changes)[..., :3, :3]


def poses(*changes: tuple[tuple[int, ...], float]) -> np.ndarray:
    T = np.tile(np.eye(4), (5, 3, 1, 1))
    for index, value in changes:
        T[index] = value
    return T


EYES = np.tile(np.eye(3), (3, 1, 1))
NO_ROTATION = "Expected R{} to be a rotation within 1e-06, got {}. Project it first"
NOT_UNIT = "Expected {} of length 1 within 0.001 (wxyz), got length {}."
LAST_ROW = "Expected (0, 0, 0, 1) as the last row of T{}, got one off by {}."
REFUSED = [
    ("rotations", (np.zeros((2, 3)), "R_x"), "Expected R_x of shape (..., 3, 3), got (2, 3)."),
    ("rotations", ("north", "R"), "Expected R to be an array of real numbers, got str"),
    ("rotations", (1j * np.eye(3), "R"), "Expected R to be an array of real numbers, got "),
    ("rotations", (2 * np.eye(3), "R"), NO_ROTATION.format("", "max|R^T R - I| = 3")),
    ("rotations", (-np.eye(3), "R"), NO_ROTATION.format("", "determinant = -1")),
    ("rotations", (matrices(((3, 1, 0, 0), np.inf)), "R"), NO_ROTATION.format("[3, 1]", "max|R| = inf")),
    (
        "rotations",
        (matrices(((1, 1, 0, 1), np.nan), ((4, 2, 0, 1), 1.1e-6)), "R"),
        NO_ROTATION.format("[4, 2]", "max|R^T R - I| = 1.1e-06"),
    ),
    ("poses", (poses(((4, 0, 1, 1), 1.1)), "T"), "Expected the rotation of T[4, 0] to be a rotation within"),
    ("poses", (poses(((2, 2, 3, 1), 0.5)), "T"), LAST_ROW.format("[2, 2]", "0.5")),
    ("poses", (poses(((2, 1, 3, 3), np.nan)), "T"), LAST_ROW.format("[2, 1]", "nan")),
    ("se3_log", (np.eye(3),), "Expected T of shape (..., 4, 4), got (3, 3)."),
    ("se3_adjoint", (2 * np.eye(4),), "Expected the rotation of T_a_b to be a rotation"),
    ("se3_exp", (np.zeros(3),), "Expected xi of shape (..., 6), got (3,)."),
    ("so3_exp", (1.0,), "Expected w of shape (..., 3), got ()."),
    ("so3_angle", (np.eye(3), np.zeros((3, 3))), "Expected R_b to be a rotation"),
    (
        "so3_angle",
        (EYES, EYES[:2]),
        "Expected leading axes that broadcast, got R_a of shape (3, 3, 3), R_b of shape (2, 3, 3).",
    ),
    ("quaternion_to_matrix", ([[1, 0, 0, 0], [1, 0.1, 0, 0]],), NOT_UNIT.format("quaternion[1]", "1.00499")),
    ("quaternion_slerp", ([1, 0, 0, 0], [3, 0, 0, 0], 0.5), NOT_UNIT.format("b", "3")),
    ("quaternion_multiply", (np.zeros((2, 4)), np.zeros((3, 4))), "Expected leading axes that broadcast, got p of"),
]


@MODULES
@pytest.mark.parametrize(("name", "arguments", "sentence"), REFUSED)
def test_refusals(module: Any, name: str, arguments: tuple[Any, ...], sentence: str) -> None:
    with pytest.raises(ShapeError, match="^.*" + re.escape(sentence)):
        getattr(module, name)(*arguments)


@MODULES
def test_a_missing_number_passes_and_hides_nothing_else(module: Any) -> None:
    T = poses(((1, 1, 0, 1), np.nan), ((1, 1, 3, 1), np.nan), ((0, 2, 0, 3), np.nan))
    assert np.isnan(module.se3_inv(T)[1, 1]).any()
    assert np.isfinite(module.se3_inv(T)[2:]).all()


@pytest.mark.parametrize("name", ["so3_exp", "so3_left_jacobian"])
def test_far_turns_have_values(name: str) -> None:
    """Beyond the range of a square, lengths come from the C library."""
    w = np.array([[1e200, 0, 0], [3e-170, 4e-170, 0], [0, 0, -1e8], [0.1, 0.2, 0.3]])
    values = getattr(_native, name)(w)
    assert np.isfinite(values).all()
    np.testing.assert_allclose(values[1:], getattr(_reference, name)(w[1:]), rtol=0, atol=1e-8)
    assert np.isnan(_native.so3_exp([np.inf, 0, 0])).any()
