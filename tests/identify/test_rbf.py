"""Centres and regressor of friction over position and speed."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.identify import rbf_centres, rbf_regressor
from armlab.kernels import presliding


def motion(n: int = 2, N: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 40, N)[:, None]
    f = 1.0 + 0.37 * np.arange(n)
    return np.sin(f * t) + 0.5 * np.sin(2.3 * f * t), f * np.cos(f * t) + 1.15 * f * np.cos(2.3 * f * t)


def test_the_functions_sum_to_one_on_the_hull() -> None:
    q, qd = motion()
    basis = rbf_centres(q, qd)
    Y = rbf_regressor(q, qd, basis)
    moving = qd != 0
    np.testing.assert_allclose(Y.sum(axis=2)[moving], 1.0, rtol=0, atol=1e-12)
    assert Y.shape == (len(q), 2, 80)
    assert not basis.outside(q, qd).any()


def test_centres_are_mirrored_speeds_of_each_joint() -> None:
    q, qd = motion()
    basis = rbf_centres(q, qd * [1.0, 3.0])
    assert np.all(basis.speeds > 0)
    assert basis.speeds[1, -1] == pytest.approx(3 * np.abs(qd[:, 1]).max())
    np.testing.assert_allclose(rbf_centres(-q, -qd).speeds, rbf_centres(q, qd).speeds)
    constant = np.sign(qd)  # quantiles of a constant speed coincide
    assert np.all(np.diff(rbf_centres(q, constant).speeds) > 0)


def test_it_equals_the_ancestors_formula_between_the_centres() -> None:
    """Scattered centres on both sides of zero, functions of the other sign left out, divided by their sum."""
    q, qd = motion(1)
    basis = rbf_centres(q, qd)
    inside = np.flatnonzero(np.abs(qd[:, 0]) > basis.speeds[0, 0])[:500]
    x, v = q[inside, 0], qd[inside, 0]
    P, V = np.meshgrid(basis.positions[0], basis.speeds[0], indexing="ij")
    W, U = np.meshgrid(basis.position_widths[0], basis.speed_widths[0], indexing="ij")
    centres = np.concatenate([np.stack([P, s * V, W, U], axis=-1).reshape(-1, 4) for s in (1, -1)])
    phi = np.exp(
        -(((x[:, None] - centres[:, 0]) / centres[:, 2]) ** 2) - ((v[:, None] - centres[:, 1]) / centres[:, 3]) ** 2
    )
    phi *= np.sign(centres[:, 1]) == np.sign(v)[:, None]
    phi /= phi.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(rbf_regressor(q, qd, basis)[inside, 0], phi, rtol=0, atol=1e-6)


def test_a_map_of_coulomb_friction_over_position_is_recovered() -> None:
    q, qd = motion(1, 20000)
    z = presliding(q, np.array([1e-3]), np.array([0.0]))
    level = np.where(z > 0, 2.0 + 0.6 * np.sin(1.5 * q), 1.5 + 0.4 * np.cos(2 * q))
    y = (level * z + 0.05 * np.random.default_rng(0).standard_normal(q.shape))[:, 0]
    basis = rbf_centres(q, qd)
    Y = rbf_regressor(q, qd, basis, z)[:, 0]
    k = np.linalg.solve(Y.T @ Y + 1e-3 * np.trace(Y.T @ Y) / Y.shape[1] * np.eye(Y.shape[1]), Y.T @ y)
    moving = np.abs(z[:, 0]) > 0.99
    error = (Y @ k - (level * z)[:, 0])[moving]
    assert np.sqrt(np.mean(error**2)) < 0.05 * np.sqrt(np.mean((level * z) ** 2))


def test_bad_records_are_refused() -> None:
    q, qd = motion()
    basis = rbf_centres(q, qd)
    with pytest.raises(NotExcited, match="joint 2"):
        rbf_centres(q * [1, 0], qd * [1, 0])
    with pytest.raises(ShapeError, match="at least 2"):
        rbf_centres(q, qd, speeds=1)
    with pytest.raises(ShapeError, match="one shape"):
        rbf_centres(q, qd[:-1])
    with pytest.raises(ShapeError, match="2 joints"):
        rbf_regressor(q[:, :1], qd[:, :1], basis)
    with pytest.raises(ShapeError, match="finite q, qd and z"):
        rbf_regressor(q, qd, basis, z=np.full(q.shape, np.nan))
    q = q.copy()
    q[3, 0] = np.nan
    with pytest.raises(ShapeError, match="finite q"):
        rbf_regressor(q, qd, basis)
