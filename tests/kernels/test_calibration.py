"""Residuals of the hand-eye equation, and the weight that hangs on a sensor, against their oracles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import kernels
from armlab.errors import ShapeError
from armlab.lie import so3

from .. import oracles


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
def test_hand_eye_rows_agree(batch: tuple[int, ...], apart: float) -> None:
    given = poses(batch, apart)
    before = [array.copy() for array in given]
    ours, wanted = (module.hand_eye_rows(*given) for module in (kernels, oracles))
    for array, was in zip(given, before, strict=True):
        np.testing.assert_array_equal(array, was)
    for mine, its, tail in zip(ours, wanted, ((6,), (6, 12)), strict=True):
        assert mine.shape == its.shape == (*batch, *tail)
        np.testing.assert_allclose(mine, its, rtol=0, atol=1e-12)
    if batch == (2, 40):
        one = [array[1, 7] if i < 4 else array for i, array in enumerate(given)]
        for mine, whole in zip(kernels.hand_eye_rows(*one), ours, strict=True):
            np.testing.assert_array_equal(mine, whole[1, 7])


def test_derivatives() -> None:
    *data, R_X, t_X, R_Y, t_Y = poses((4,), 0.3)
    J, h = kernels.hand_eye_rows(*data, R_X, t_X, R_Y, t_Y)[1], 1e-6

    def moved(x: np.ndarray) -> np.ndarray:
        return kernels.hand_eye_rows(*data, R_X @ so3.exp(x[3:6]), t_X + x[:3], R_Y @ so3.exp(x[9:]), t_Y + x[6:9])[0]

    for k, step in enumerate(h * np.eye(12)):
        np.testing.assert_allclose(J[..., k], (moved(step) - moved(-step)) / (2 * h), rtol=0, atol=1e-8)


def test_bad_shapes_are_refused() -> None:
    given = poses((4,), 0.1)
    for k, words in ((0, "R_A of shape"), (3, "t_B of shape"), (4, "R_X of shape"), (7, "t_Y of shape")):
        with pytest.raises(ShapeError, match=words):
            kernels.hand_eye_rows(*given[:k], given[k][..., :2], *given[k + 1 :])


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
def test_weights_agree(biased: bool, mass: float | None, weighted: bool, batch: tuple[int, ...], tilt: float) -> None:
    given = readings(1, batch, tilt=tilt)
    weight = np.random.default_rng(2).uniform(0.0, 3.0, 40) if weighted else None
    if weight is not None:
        weight[5:9] = 0.0
    before = {name: array.copy() for name, array in given.items()}
    ours, wanted = (
        module.turned_weight(**given, weight=weight, mass=mass, biased=biased) for module in (kernels, oracles)
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
            kernels.turned_weight(**one, weight=weight, mass=mass, biased=biased), ours, strict=True
        ):
            np.testing.assert_array_equal(mine, whole[1, 2])


def test_what_is_minimised() -> None:
    """No turn, mass or bias nearby is better, and the residuals are those of the result."""
    given = readings(3)
    weight = np.random.default_rng(4).uniform(0.5, 2.0, 40)
    R, bias, residuals, _, _, numbers = kernels.turned_weight(**given, weight=weight)

    def rest(turn: np.ndarray, m: float, b: np.ndarray) -> np.ndarray:
        return given["force"] - m * (PULL @ given["R_base_tool"]) @ turn - b

    def power(r: np.ndarray) -> float:
        return float(np.sum(weight[:, None] * r * r))

    np.testing.assert_allclose(residuals, rest(R, numbers[0], bias), rtol=0, atol=1e-13)
    assert power(residuals) == pytest.approx(numbers[2], rel=1e-12)
    for step in 1e-3 * np.vstack([np.eye(7), -np.eye(7)]):
        assert power(rest(R @ so3.exp(step[:3]), numbers[0] + step[3], bias + step[4:])) > numbers[2]


def test_samples_of_no_weight_do_not_count() -> None:
    given = readings(5)
    weight = np.ones(40)
    weight[7:] = 0.0
    spoilt = {**given, "force": np.where(weight[:, None] > 0, given["force"], 1e3)}
    few = {**given, "R_base_tool": given["R_base_tool"][:7], "force": given["force"][:7]}
    for mine, wanted in zip(kernels.turned_weight(**spoilt, weight=weight), kernels.turned_weight(**few), strict=True):
        np.testing.assert_allclose(mine[: len(wanted)], wanted, rtol=1e-9, atol=1e-9)


def test_weight_bad_shapes_are_refused() -> None:
    given = readings(6)
    for change, words in (
        ({"force": given["force"][:39]}, "R_base_tool of shape"),
        ({"force": given["force"][:, :2]}, "force of shape"),
        ({"force": 1.0}, "force of shape"),
        ({"pull": PULL[:2]}, "pull of shape"),
        ({"weight": np.ones(39)}, "weight of shape"),
    ):
        with pytest.raises(ShapeError, match=words):
            kernels.turned_weight(**{**given, **change})
