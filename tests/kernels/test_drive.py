"""Torque of the drives against its oracle."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from armlab import kernels
from armlab.errors import ShapeError

from .. import oracles


def rows(n: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Friction and ripple with every term in use."""
    rng = np.random.default_rng(1)
    friction = np.vstack([rng.uniform(0.1, 2.0, (10, n)), np.linspace(0.3, 0.0, n)])
    friction[6], friction[7] = np.geomspace(1e-4, 1e-2, n), 1e-5
    friction[9] = np.where(np.arange(n) % 2, 0.05, 0.0)
    return friction, rng.uniform(0.1, 2.0, (3, n))


def parts(n: int = 3, sides: int = 2) -> tuple[object, ...]:
    """Ripple lines, friction map and warm-up with every term in use."""
    rng = np.random.default_rng(3)
    speeds = np.sort(rng.uniform(0.01, 2.0, (n, 8)), axis=1)
    joints = np.repeat(np.arange(0.0, n, 2), 3)  # every other joint has lines
    lines = (
        joints,
        rng.uniform(1, 200, len(joints)),
        speeds,
        np.full((n, 8), 0.2),
        rng.standard_normal((len(joints), sides, 8, 2)),
    )
    grid = np.sort(rng.uniform(-2, 2, (n, 5)), axis=1)
    table = grid, np.full((n, 5), 0.5), speeds[:, :4].copy(), np.full((n, 4), 0.3), rng.standard_normal((n, 2, 5, 4))
    warm_up = rng.uniform(0.1, 1.0, (5, n))
    warm_up[2] = np.where(np.arange(n) % 2, 0.0, 0.5)
    return lines, table, warm_up


def record(n: int, N: int = 600) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    q = np.cumsum(rng.standard_normal((N, n)) * 1e-3, axis=0)
    q[100:140] = q[100]
    return q, rng.standard_normal((N, n)), rng.standard_normal((N, n))


@pytest.mark.parametrize("sides", [1, 2])
@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (0,)])
def test_torque_agrees(batch: tuple[int, ...], sides: int) -> None:
    rng = np.random.default_rng(0)
    q, qd = rng.standard_normal((2, *batch, 3))
    z = rng.uniform(-1, 1, (*batch, 3))
    a, b = (module.Drive(*rows(), *parts(3, sides)).torque(q, qd, z) for module in (kernels, oracles))
    assert a.shape == (*batch, 3)
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    out = np.empty_like(a)
    assert kernels.Drive(*rows(), *parts(3, sides)).torque(q, qd, z, out=out) is out
    assert np.array_equal(out, a)


def test_model_torque_agrees(model: SimpleNamespace) -> None:
    q, qd, qdd = record(7, 200)
    qd[50, 2] = np.nan
    qdd[0, 0] = np.inf
    found = []
    for module in (oracles, kernels):
        chain, drive = module.Chain(model.frames, model.prismatic), module.Drive(*rows(7), *parts(7))
        arguments = chain, model.gravity, model.link_parameters, model.rotor, drive, q, qd, qdd, np.full(len(q), 0.004)
        found.append(module.model_torque(*arguments))
    out = np.empty_like(q)
    assert kernels.model_torque(*arguments, out=out) is out
    shared = np.zeros(q.size + 69)
    shared[:70] = model.link_parameters.ravel()
    links = shared[:70].reshape(7, 10)
    with pytest.raises(ShapeError, match="Expected out not to share memory with links"):
        kernels.model_torque(*arguments[:2], links, *arguments[3:], out=shared[69:].reshape(q.shape))
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-12 * np.nanmax(np.abs(found[0])))
    assert np.array_equal(np.flatnonzero(np.isnan(found[1]).any(axis=1)), [0, 50])


def test_warmth_runs_along_the_record_only_with_steps(model: SimpleNamespace) -> None:
    q, qd, qdd = record(7)
    for module in (kernels, oracles):
        chain = module.Chain(model.frames, model.prismatic)
        cold, warm = module.Drive(*rows(7)), module.Drive(*rows(7), warm_up=parts(7)[2])
        rigid = chain, model.gravity, model.link_parameters, model.rotor
        still = [module.model_torque(*rigid, drive, q, qd, qdd) for drive in (cold, warm)]
        moving = module.model_torque(*rigid, warm, q, qd, qdd, np.full(len(q), 0.004))
        assert np.array_equal(moving[0], still[1][0])
        assert not np.allclose(moving[1:], still[1][1:])


@pytest.mark.parametrize("x", [np.array([-1e3, -1.0, 0.0, 0.2, 1.0, 1e3]), np.zeros(0)])
def test_basis_weights_agree_and_sum_to_one(x: np.ndarray) -> None:
    centres, widths = np.array([-1.0, 0.0, 0.5, 2.0]), np.array([1.0, 0.01, 0.5, 0.1])
    a, b = (module.basis_weights(x, centres, widths) for module in (kernels, oracles))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    np.testing.assert_allclose(a.sum(axis=1), 1.0, rtol=0, atol=1e-15)
    assert a.shape == (len(x), 4)


def test_presliding_agrees() -> None:
    q = np.cumsum(np.random.default_rng(0).standard_normal((2000, 3)) * [1e-6, 1e-4, 1e-2], axis=0)
    q[500, 1] = np.nan
    delta, resolution = np.array([1e-4, 1e-3, 1e-2]), np.array([0.0, 1e-5, 1e-3])
    np.testing.assert_allclose(
        kernels.presliding(q, delta, resolution), oracles.presliding(q, delta, resolution), rtol=0, atol=1e-14
    )


def test_presliding_of_nothing_is_nothing() -> None:
    assert kernels.presliding(np.zeros((0, 3)), np.ones(3), np.zeros(3)).shape == (0, 3)


def test_wrong_shapes_are_refused(model: SimpleNamespace) -> None:
    friction, ripple = rows()
    with pytest.raises(ShapeError, match="friction"):
        kernels.Drive(friction[:8], ripple)
    with pytest.raises(ShapeError, match="ripple"):
        kernels.Drive(friction, ripple[:, :2])
    lines, table, warm_up = parts()
    backwards = (lines[0][::-1].copy(), *lines[1:])
    for wrong in (
        {"lines": lines[:3]},
        {"lines": backwards},
        {"map": (*table[:4], table[4][:2])},
        {"map": (np.zeros((3, 65)), *table[1:])},
        {"warm_up": warm_up[:4]},
    ):
        with pytest.raises(ShapeError):
            kernels.Drive(friction, ripple, **wrong)
    with pytest.raises(ShapeError, match="centres"):
        kernels.basis_weights(np.zeros(3), np.zeros(0), np.zeros(0))
    drive = kernels.Drive(friction, ripple)
    with pytest.raises(ShapeError, match="qd"):
        drive.torque(np.zeros(3), np.zeros(2), np.zeros(3))
    chain, zero = kernels.Chain(model.frames, model.prismatic), np.zeros((4, 7))
    with pytest.raises(ShapeError, match="drive of 7 joints"):
        kernels.model_torque(chain, model.gravity, model.link_parameters, model.rotor, drive, zero, zero, zero)
