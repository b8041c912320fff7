"""The compiled residuals of hand-eye calibration are those of the NumPy reference."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.kernels import _reference
from armlab.lie import so3

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

MODULES = pytest.mark.parametrize("module", [_native, _reference], ids=["native", "reference"])


def poses(batch: tuple[int, ...], apart: float) -> list[np.ndarray]:
    """R_A, t_A, R_B, t_B, then R_X, t_X, R_Y, t_Y; B is `apart` from Y^-1 A X by about so many radians and metres."""
    rng = np.random.default_rng(0)
    R_A, R_X, R_Y = (so3.exp(rng.uniform(-2, 2, (*shape, 3))) for shape in (batch, (), ()))
    t_A, t_X, t_Y = (rng.standard_normal((*shape, 3)) for shape in (batch, (), ()))
    R_B = R_Y.T @ R_A @ R_X @ so3.exp(apart * rng.standard_normal((*batch, 3)))
    t_B = (R_A @ t_X + t_A - t_Y) @ R_Y + apart * rng.standard_normal((*batch, 3))
    return [R_A, t_A, R_B, t_B, R_X, t_X, R_Y, t_Y]


@pytest.mark.parametrize("batch", [(), (3,), (5,), (2, 40), (0,)])
@pytest.mark.parametrize("apart", [0.0, 1e-9, 1e-3, 0.5])
def test_both_agree(batch: tuple[int, ...], apart: float) -> None:
    given = poses(batch, apart)
    before = [array.copy() for array in given]
    ours, wanted = (module.hand_eye_rows(*given) for module in (_native, _reference))
    for array, was in zip(given, before, strict=True):
        np.testing.assert_array_equal(array, was)
    for mine, its, tail in zip(ours, wanted, ((6,), (6, 12)), strict=True):
        assert mine.shape == its.shape == (*batch, *tail)
        np.testing.assert_allclose(mine, its, rtol=0, atol=1e-12)
    if batch == (2, 40):
        one = [array[1, 7] if i < 4 else array for i, array in enumerate(given)]
        for mine, whole in zip(_native.hand_eye_rows(*one), ours, strict=True):
            np.testing.assert_array_equal(mine, whole[1, 7])


@MODULES
def test_derivatives(module: Any) -> None:
    *data, R_X, t_X, R_Y, t_Y = poses((4,), 0.3)
    J, h = module.hand_eye_rows(*data, R_X, t_X, R_Y, t_Y)[1], 1e-6

    def moved(x: np.ndarray) -> np.ndarray:
        return module.hand_eye_rows(*data, R_X @ so3.exp(x[3:6]), t_X + x[:3], R_Y @ so3.exp(x[9:]), t_Y + x[6:9])[0]

    for k, step in enumerate(h * np.eye(12)):
        np.testing.assert_allclose(J[..., k], (moved(step) - moved(-step)) / (2 * h), rtol=0, atol=1e-8)


@MODULES
def test_bad_shapes_are_refused(module: Any) -> None:
    given = poses((4,), 0.1)
    for k, words in ((0, "R_A of shape"), (3, "t_B of shape"), (4, "R_X of shape"), (7, "t_Y of shape")):
        with pytest.raises(ShapeError, match=words):
            module.hand_eye_rows(*given[:k], given[k][..., :2], *given[k + 1 :])
