"""The compiled fit of a turned weight gives what the NumPy reference gives."""

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
PULL = np.array([1.0, -2.0, -9.5])


def readings(seed: int, batch: tuple[int, ...] = (), N: int = 40, tilt: float = 3.0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    R = so3.exp(rng.uniform(-tilt, tilt, (*batch, N, 3)))
    force = 1.3 * (PULL @ R) @ so3.exp(rng.standard_normal(3)) + rng.standard_normal(3)
    return {"R_base_tool": R, "force": force + 0.1 * rng.standard_normal(force.shape), "pull": PULL}


@pytest.mark.parametrize("biased", [True, False])
@pytest.mark.parametrize("mass", [None, 1.3])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("batch", [(), (2, 3)])
@pytest.mark.parametrize("tilt", [3.0, 0.3])
def test_both_agree(biased: bool, mass: float | None, weighted: bool, batch: tuple[int, ...], tilt: float) -> None:
    given = readings(1, batch, tilt=tilt)
    weight = np.random.default_rng(2).uniform(0.0, 3.0, 40) if weighted else None
    if weight is not None:
        weight[5:9] = 0.0
    before = {name: array.copy() for name, array in given.items()}
    ours, wanted = (
        module.turned_weight(**given, weight=weight, mass=mass, biased=biased) for module in (_native, _reference)
    )
    for name, array in before.items():
        np.testing.assert_array_equal(given[name], array)
    for mine, its in zip(ours, wanted, strict=True):
        assert mine.shape == its.shape
        np.testing.assert_allclose(mine, its, rtol=0, atol=1e-12 * max(np.abs(its).max(), 1.0))
    assert ours[3].shape == (*batch, *2 * (3 + (mass is None) + 3 * biased,))
    if batch:
        one = {**given, "R_base_tool": given["R_base_tool"][1, 2], "force": given["force"][1, 2]}
        for mine, whole in zip(
            _native.turned_weight(**one, weight=weight, mass=mass, biased=biased), ours, strict=True
        ):
            np.testing.assert_array_equal(mine, whole[1, 2])


@MODULES
def test_what_is_minimised(module: Any) -> None:
    """No turn, mass or bias nearby is better, and the residuals are those of the result."""
    given = readings(3)
    weight = np.random.default_rng(4).uniform(0.5, 2.0, 40)
    R, bias, residuals, _, _, numbers = module.turned_weight(**given, weight=weight)

    def rest(turn: np.ndarray, m: float, b: np.ndarray) -> np.ndarray:
        return given["force"] - m * (PULL @ given["R_base_tool"]) @ turn - b

    def power(r: np.ndarray) -> float:
        return float(np.sum(weight[:, None] * r * r))

    np.testing.assert_allclose(residuals, rest(R, numbers[0], bias), rtol=0, atol=1e-13)
    assert power(residuals) == pytest.approx(numbers[2], rel=1e-12)
    for step in 1e-3 * np.vstack([np.eye(7), -np.eye(7)]):
        assert power(rest(R @ so3.exp(step[:3]), numbers[0] + step[3], bias + step[4:])) > numbers[2]


@MODULES
def test_samples_of_no_weight_do_not_count(module: Any) -> None:
    given = readings(5)
    weight = np.ones(40)
    weight[7:] = 0.0
    spoilt = {**given, "force": np.where(weight[:, None] > 0, given["force"], 1e3)}
    few = {**given, "R_base_tool": given["R_base_tool"][:7], "force": given["force"][:7]}
    for mine, wanted in zip(module.turned_weight(**spoilt, weight=weight), module.turned_weight(**few), strict=True):
        np.testing.assert_allclose(mine[: len(wanted)], wanted, rtol=1e-9, atol=1e-9)


@MODULES
def test_bad_shapes_are_refused(module: Any) -> None:
    given = readings(6)
    for change, words in (
        ({"force": given["force"][:39]}, "R_base_tool of shape"),
        ({"force": given["force"][:, :2]}, "force of shape"),
        ({"force": 1.0}, "force of shape"),
        ({"pull": PULL[:2]}, "pull of shape"),
        ({"weight": np.ones(39)}, "weight of shape"),
    ):
        with pytest.raises(ShapeError, match=words):
            module.turned_weight(**{**given, **change})
