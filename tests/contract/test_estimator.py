"""The compiled estimator and presliding state are held to their NumPy specification."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest

from armlab.kernels import _reference
from armlab.log import Table
from armlab.models import TorqueModel

native = pytest.importorskip("armlab.kernels._native", reason="the extension is not built here", exc_type=ImportError)


def twins(model: TorqueModel) -> tuple[object, object]:
    """The same estimator in both backends."""
    made = []
    for module in (native, _reference):
        f, r, c = model.friction, model.ripple, model.covariance
        chain = module.Chain(model.frames, model.prismatic)
        rows = [f.viscous, f.coulomb_pos, f.coulomb_neg, f.offset, f.stribeck, f.stribeck_speed, f.delta, f.resolution]
        made.append(
            module.WrenchEstimator(
                chain,
                model.gravity,
                model.link_parameters,
                model.rotor,
                np.stack(rows),
                np.stack([r.cycles, r.cosine, r.sine]),
                np.stack([c.C0, c.Cinf, c.shape, np.arange(7) % 3]),
                np.array([400.0, 400, 400, 4, 4, 4]),
                10.0,
            )
        )
    return made[0], made[1]


def test_estimators_agree_to_1e_minus_12_of_their_scale(model: TorqueModel, excited: Table) -> None:
    log = excited.between(0.0, 3.0)
    dt = np.array(log.dt)
    dt[200] = 0.02  # a gap
    tau = np.array(log["tau"])
    tau[300, 2] = np.nan  # a broken sample
    compiled, plain = twins(model)
    for a, b in zip(compiled.run(log["q"], log["qd"], tau, dt), plain.run(log["q"], log["qd"], tau, dt)):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-11 * np.nanmax(np.abs(b)))
        assert np.isnan(a[300]).all()


def test_reset_forgets_everything(model: TorqueModel, excited: Table) -> None:
    log = excited.between(0.0, 1.0)
    for estimator in twins(model):
        first = estimator.run(log["q"], log["qd"], log["tau"], log.dt)
        estimator.reset()
        for a, b in zip(first, estimator.run(log["q"], log["qd"], log["tau"], log.dt)):
            assert np.array_equal(a, b)


def test_presliding_agrees() -> None:
    rng = np.random.default_rng(0)
    q = np.cumsum(rng.standard_normal((2000, 3)) * [1e-6, 1e-4, 1e-2], axis=0)
    q[500, 1] = np.nan
    delta, resolution = np.array([1e-4, 1e-3, 1e-2]), np.array([0.0, 1e-5, 1e-3])
    np.testing.assert_allclose(
        native.presliding(q, delta, resolution), _reference.presliding(q, delta, resolution), atol=1e-14
    )


@pytest.mark.parametrize("module", [native, _reference])
def test_presliding_of_nothing_is_nothing(module: object) -> None:
    assert module.presliding(np.zeros((0, 3)), np.ones(3), np.zeros(3)).shape == (0, 3)


def test_the_native_estimator_refuses_wrong_shapes(model: TorqueModel) -> None:
    compiled, _ = twins(model)
    errors = import_module("armlab.errors")
    with pytest.raises(errors.ShapeError, match="qd"):
        compiled.step(np.zeros(7), np.zeros(6), np.zeros(7), 0.004)
    with pytest.raises(errors.ShapeError, match="tau"):
        compiled.run(np.zeros((5, 7)), np.zeros((5, 7)), np.zeros((4, 7)), np.zeros(5))
