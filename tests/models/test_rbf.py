"""Friction over position and speed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.models import FrictionMap, RadialBasis, load, save


def basis(n: int = 2) -> RadialBasis:
    positions, speeds = np.linspace(-2, 2, 8), np.geomspace(0.05, 1.0, 5)
    return RadialBasis(*(np.tile(x, (n, 1)) for x in (positions, np.full(8, 0.5), speeds, np.gradient(speeds))))


def test_the_functions_sum_to_one_inside_and_outside() -> None:
    rng = np.random.default_rng(0)
    q, qd = rng.uniform(-3, 3, 500), rng.uniform(-2, 2, 500)
    phi = basis().functions(1, q, qd, rng.uniform(-1, 1, 500))
    np.testing.assert_allclose(phi.sum(axis=1), 1.0, rtol=0, atol=1e-12)
    assert phi.shape == (500, basis().size)
    assert np.isfinite(basis().functions(0, np.array([1e6]), np.array([-1e6]), np.array([-1.0]))).all()


def test_only_the_side_of_the_motion_counts_and_rest_blends_both() -> None:
    b = basis()
    forward, rest = (
        b.functions(0, np.array([0.3]), np.array([v]), np.array([s]))[0] for v, s in ((0.2, 1.0), (0.0, 0.0))
    )
    assert not forward[40:].any()
    np.testing.assert_allclose(rest[:40], rest[40:], rtol=0, atol=1e-15)


def test_outside_is_told() -> None:
    assert basis().outside([[0.0, 0.0], [2.5, 0.0]], [[0.0, 2.0], [0.1, -0.5]]).tolist() == [
        [False, True],
        [True, False],
    ]


def test_torque_is_functions_times_coefficients() -> None:
    rng = np.random.default_rng(1)
    b, k = basis(), rng.standard_normal((2, 2, 8, 5))
    q, qd, z = rng.uniform(-1, 1, (3, 60, 2))
    expected = np.stack([b.functions(i, q[:, i], qd[:, i], z[:, i]) @ k[i].ravel() for i in range(2)], axis=1)
    np.testing.assert_allclose(FrictionMap(b, k).torque(q, qd, z), expected, rtol=0, atol=1e-12)


def test_a_model_keeps_its_map(tmp_path, model) -> None:
    part = FrictionMap(basis(7), np.random.default_rng(0).standard_normal((7, 2, 8, 5)))
    more = replace(model, friction_map=part)
    again = load(save(more, tmp_path / "model.toml"))
    q, qd = np.random.default_rng(1).standard_normal((2, 40, 7))
    assert np.array_equal(again.torque(q, qd), more.torque(q, qd))
    with pytest.raises(ShapeError, match="map positions"):
        replace(model, friction_map=FrictionMap(basis(2), np.zeros((2, 2, 8, 5))))


def test_wrong_centres_are_refused() -> None:
    b = basis()
    with pytest.raises(ShapeError, match="speeds above 0"):
        replace(b, speeds=b.speeds - 0.05)
    with pytest.raises(ShapeError, match="positive widths"):
        replace(b, position_widths=0 * b.position_widths)
    with pytest.raises(ShapeError, match="shape"):
        replace(b, speeds=b.speeds[:1])
    with pytest.raises(ShapeError, match="coefficients"):
        FrictionMap(b, np.zeros((2, 2, 8, 4)))
