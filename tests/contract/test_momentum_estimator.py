"""The compiled momentum estimator is held to its NumPy specification."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import pytest

from armlab.kernels import _reference
from armlab.log import Table
from armlab.models import FORCE_RATES, PRIOR, TorqueModel

NAMES = ("F", "P", "observability", "error", "variance", "flags", "active")
POINT = np.array([0.02, -0.01, 0.1])
WAYS = {"observer": (False, False), "kf": (True, False), "kf with bias": (True, True)}

native = pytest.importorskip("armlab.kernels._native", reason="the extension is not built here", exc_type=ImportError)


def twins(model: TorqueModel, way: str, point: np.ndarray | None = None) -> tuple[Any, Any]:
    """The same estimator in both backends, with warm-up and every kind of covariance."""
    rate, prior = np.square(FORCE_RATES["normal"]), np.square(PRIOR)
    c = model.covariance
    warm_up = np.tile([[0.2], [-0.3], [60.0], [1.0], [0.1]], 7)
    made = []
    for module in (native, _reference):
        made.append(
            module.MomentumEstimator(
                module.Chain(model.frames, model.prismatic),
                model.gravity,
                model.link_parameters,
                model.rotor,
                module.Drive(model.friction.rows, model.ripple.rows, None, None, warm_up),
                np.linspace(0.95, 1.05, 7),
                0.03**2,
                np.stack([c.C0, c.Cinf, c.shape, np.arange(7) % 3]),
                prior,
                np.linspace(0.02, 0.05, 7),
                np.linspace(1e-3, 2e-3, 7),
                rate,
                np.linspace(0, 0.5, 6),
                30.0,
                *WAYS[way],
                point,
            )
        )
    return made[0], made[1]


@pytest.mark.parametrize("point", [None, POINT], ids=["wrench", "point"])
@pytest.mark.parametrize("way", sorted(WAYS))
def test_estimators_agree(model: TorqueModel, excited: Table, way: str, point: np.ndarray | None) -> None:
    """In motion, at rest, over a lost sample, over a gap, over samples that are broken, and after a tare."""
    log = excited.between(0.0, 0.36)
    q, qd, tau, dt = (np.array(a) for a in (log["q"], log["qd"], log["tau"], log.dt))
    dt[20], dt[35] = 0.008, 0.5
    tau[30, 2], tau[45, 1] = np.nan, 1e200
    q[55:], qd[55:], dt[55:] = q[55], 0.0, 0.016
    compiled, plain = twins(model, way, point)
    for part in (slice(0, 86), slice(86, 90)):
        outputs = (
            compiled.run(q[part], qd[part], tau[part], dt[part]),
            plain.run(q[part], qd[part], tau[part], dt[part]),
        )
        for name, a, b in zip(NAMES, *outputs):
            if name in ("flags", "active"):
                assert np.array_equal(a, b), name
                continue
            accuracy = 1e-12 if name == "variance" else 1e-10
            np.testing.assert_allclose(a, b, rtol=0.0, atol=accuracy * np.nanmax(np.abs(b)), err_msg=name)
        assert outputs[0][7] is outputs[1][7] is None
        if part.start == 0:
            assert np.isnan(outputs[0][0][[30, 45]]).all()
            assert np.isfinite(outputs[0][0][[29, 31, 46]]).all()
            assert compiled.tare() is plain.tare() is (way == "kf with bias")
    assert np.all((outputs[0][5] & 32 > 0) == (way == "kf with bias"))


@pytest.mark.parametrize("way", sorted(WAYS))
def test_step_returns_what_run_stacks_and_reset_forgets(model: TorqueModel, excited: Table, way: str) -> None:
    log = excited.between(0.0, 0.1)
    for estimator in twins(model, way):
        stacked = estimator.run(log["q"], log["qd"], log["tau"], log.dt)
        estimator.reset()
        for k in range(len(log)):
            found = estimator.step(log["q"][k], log["qd"][k], log["tau"][k], log.dt[k])
            for one, all_rows in zip(found[:7], stacked):
                assert np.array_equal(one, all_rows[k])
            assert found[7] is None
        empty = np.zeros((0, 7))
        assert [np.shape(a) for a in estimator.run(empty, empty, empty, np.zeros(0))[:2]] == [(0, 6), (0, 6, 6)]


def test_both_refuse_wrong_shapes(model: TorqueModel) -> None:
    errors = import_module("armlab.errors")
    for estimator in twins(model, "kf"):
        with pytest.raises(errors.ShapeError, match="qd"):
            estimator.step(np.zeros(7), np.zeros(6), np.zeros(7), 0.004)
        with pytest.raises(errors.ShapeError, match="tau"):
            estimator.run(np.zeros((5, 7)), np.zeros((5, 7)), np.zeros((4, 7)), np.zeros(5))
    names = (
        "gravity",
        "links",
        "rotor",
        "drive",
        "gains",
        "gain_variance",
        "covariance",
        "prior",
        "memory",
        "qd_noise",
        "rate",
        "leak",
    )
    for module in (native, _reference):
        good = dict(
            zip(names, ([0.0] * 3, np.zeros((7, 10)), np.ones(7), module.Drive(np.ones((10, 7)), np.ones((3, 7))),
                        np.ones(7), 0.0, np.ones((4, 7)), np.ones(6), np.ones(7), np.ones(7), np.ones(6), np.ones(6)))
        )  # fmt: skip
        chain = module.Chain(model.frames, model.prismatic)
        for name in (name for name in names if name != "gain_variance"):
            wrong = module.Drive(np.ones((10, 6)), np.ones((3, 6))) if name == "drive" else np.zeros(5)
            with pytest.raises(errors.ShapeError, match=name):
                module.MomentumEstimator(chain, *{**good, name: wrong}.values(), 30.0, True, False)
        with pytest.raises(errors.ShapeError, match="point"):
            module.MomentumEstimator(chain, *good.values(), 30.0, True, False, np.zeros(2))


def test_both_refuse_numbers_that_are_no_noise(model: TorqueModel) -> None:
    errors = import_module("armlab.errors")
    names = ("gains", "gain_variance", "covariance", "prior", "memory", "qd_noise", "rate", "leak", "gain")
    for module in (native, _reference):
        chain, drive = module.Chain(model.frames, model.prismatic), module.Drive(np.ones((10, 7)), np.ones((3, 7)))
        good = dict(zip(names, (np.ones(7), 1.0, np.ones((4, 7)), *(np.ones(k) for k in (6, 7, 7, 6, 6)), 30.0)))
        for name, wrong in ((name, number * good[name]) for name in names for number in (-1.0, np.nan, np.inf)):
            with pytest.raises(errors.ShapeError, match=f"^Expected finite {name}"):
                module.MomentumEstimator(
                    chain, [0.0] * 3, np.zeros((7, 10)), np.ones(7), drive, **{**good, name: wrong}, filters=True,
                    biased=False,
                )  # fmt: skip
