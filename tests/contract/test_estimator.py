"""The compiled estimator is held to their NumPy specification."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest

from armlab.kernels import _reference
from armlab.kernels._reference.wrench import METHODS
from armlab.log import Table
from armlab.models import TorqueModel

NAMES = ("F", "P", "observability", "error", "variance", "flags", "active", "interval")

native = pytest.importorskip("armlab.kernels._native", reason="the extension is not built here", exc_type=ImportError)


def twins(
    model: TorqueModel, method: int = 0, point: np.ndarray | None = None, extra: tuple[object, ...] = ()
) -> tuple[object, object]:
    """The same estimator in both backends."""
    made = []
    for module in (native, _reference):
        c = model.covariance
        chain = module.Chain(model.frames, model.prismatic)
        made.append(
            module.WrenchEstimator(
                chain,
                model.gravity,
                model.link_parameters,
                model.rotor,
                module.Drive(model.friction.rows, model.ripple.rows, *extra),
                np.linspace(0.95, 1.05, 7),
                0.03**2,
                np.stack([c.C0, c.Cinf, c.shape, np.arange(7) % 3]),
                np.stack([model.bound.torque, model.bound.speed, model.bound.floor]),
                np.array([400.0, 400, 400, 4, 4, 4]),
                10.0,
                method,
                point,
            )
        )
    return made[0], made[1]


# Torque error and its variance to 1e-12 of their scale; what passes a solution of equations to 1e-11, without a prior
# to 1e-8; HiGHS, which the reference asks for intervals, is exact to 1e-7.
ACCURACY = {"map": 1e-11, "bounded": 1e-9, "interval": 1e-9, "ls": 1e-8, "lund": 1e-11}


@pytest.mark.parametrize("point", [None, np.array([0.02, -0.01, 0.1])], ids=["wrench", "point"])
@pytest.mark.parametrize("method", sorted(ACCURACY))
def test_estimators_agree(model: TorqueModel, excited: Table, method: str, point: np.ndarray | None) -> None:
    log = excited.between(0.0, 0.4 if method == "interval" else 0.5)
    dt = np.array(log.dt)
    dt[50] = 0.02  # a long step
    dt[60] = 0.5  # a gap
    tau = np.array(log["tau"])
    tau[70, 2] = np.nan  # a broken sample
    tau[90, 1] = 1e200  # one that would stay in the filter for ever
    compiled, plain = twins(model, METHODS.index(method), point)
    arguments = log["q"], log["qd"], tau, dt
    outputs = compiled.run(*arguments), plain.run(*arguments)
    for name, a, b in zip(NAMES, *outputs):
        if name == "interval" and b is None:
            assert a is None
            continue
        if name in ("flags", "active"):
            infeasible = (outputs[0][5] & 8) > 0  # then each names joints by its own proof of the contradiction
            assert np.array_equal(a[~infeasible], b[~infeasible]), name
            continue
        accuracy = {"error": 1e-12, "variance": 1e-12, "interval": 1e-7}.get(name, ACCURACY[method])
        np.testing.assert_allclose(a, b, rtol=0.0, atol=accuracy * max(np.nanmax(np.abs(b)), 1e-3), err_msg=name)
        assert np.isnan(a[[70, 90]]).all()
        assert np.isfinite(a[91]).all()


@pytest.mark.parametrize("method", ["map", "bounded"])
def test_estimators_agree_on_every_part_of_the_drives(model: TorqueModel, excited: Table, method: str) -> None:
    log, rng = excited.between(0.0, 0.6), np.random.default_rng(0)
    speeds, widths = np.tile(np.linspace(0.1, 2.0, 8), (7, 1)), np.full((7, 8), 0.3)
    positions = np.tile(np.linspace(-2, 2, 5), (7, 1))
    lines = np.arange(7.0), rng.uniform(50, 200, 7), speeds, widths, rng.standard_normal((7, 2, 8, 2))
    table = positions, 0.5 + 0 * positions, speeds, widths, rng.standard_normal((7, 2, 5, 8))
    compiled, plain = twins(model, METHODS.index(method), extra=(lines, table, rng.uniform(0.1, 0.5, (5, 7))))
    a, b = (estimator.run(log["q"], log["qd"], log["tau"], log.dt) for estimator in (compiled, plain))
    np.testing.assert_allclose(a[3], b[3], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(a[4], b[4], rtol=1e-11)


@pytest.mark.parametrize("method", sorted(ACCURACY))
def test_step_returns_what_run_stacks(model: TorqueModel, excited: Table, method: str) -> None:
    log = excited.between(0.0, 0.1)
    for estimator in twins(model, METHODS.index(method)):
        stacked = estimator.run(log["q"], log["qd"], log["tau"], log.dt)
        estimator.reset()
        for k in range(len(log)):
            for one, all_rows in zip(estimator.step(log["q"][k], log["qd"][k], log["tau"][k], log.dt[k]), stacked):
                assert (one is None and all_rows is None) or np.array_equal(one, all_rows[k])


def test_reset_forgets_everything(model: TorqueModel, excited: Table) -> None:
    log = excited.between(0.0, 0.2)
    for estimator in twins(model):
        first = estimator.run(log["q"], log["qd"], log["tau"], log.dt)
        estimator.reset()
        for a, b in zip(first[:7], estimator.run(log["q"], log["qd"], log["tau"], log.dt)[:7]):
            assert np.array_equal(a, b)


def test_both_refuse_wrong_shapes(model: TorqueModel) -> None:
    errors = import_module("armlab.errors")
    for estimator in twins(model):
        with pytest.raises(errors.ShapeError, match="qd"):
            estimator.step(np.zeros(7), np.zeros(6), np.zeros(7), 0.004)
        with pytest.raises(errors.ShapeError, match="tau"):
            estimator.step(np.zeros(7), np.zeros(7), 0.0, 0.004)
        for name in ("q", "qd", "tau"):
            with pytest.raises(errors.ShapeError, match=f"^Expected {name} to be an array of real numbers, got None"):
                estimator.step(**{"q": np.zeros(7), "qd": np.zeros(7), "tau": np.zeros(7), "dt": 0.004, name: None})
        with pytest.raises(errors.ShapeError, match="tau"):
            estimator.run(np.zeros((5, 7)), np.zeros((5, 7)), np.zeros((4, 7)), np.zeros(5))
    for module in (native, _reference):
        chain = module.Chain(model.frames, model.prismatic)
        with pytest.raises(errors.ShapeError, match="drive of 7 joints"):
            module.WrenchEstimator(
                chain, model.gravity, model.link_parameters, model.rotor,
                module.Drive(np.ones((10, 6)), np.ones((3, 6))), np.ones(7), 0.0, np.ones((4, 7)), np.ones((3, 7)),
                np.ones(6), 10.0,
            )  # fmt: skip


def test_both_refuse_numbers_that_are_no_variances(model: TorqueModel) -> None:
    errors = import_module("armlab.errors")
    names = ("gains", "gain_variance", "covariance", "bound", "prior", "cutoff")
    for module in (native, _reference):
        chain, drive = module.Chain(model.frames, model.prismatic), module.Drive(np.ones((10, 7)), np.ones((3, 7)))
        good = dict(zip(names, (np.ones(7), 1.0, np.ones((4, 7)), np.ones((3, 7)), np.ones(6), 10.0)))
        for name, wrong in ((name, number * good[name]) for name in names for number in (-1.0, np.nan, np.inf)):
            with pytest.raises(errors.ShapeError, match=f"^Expected finite {name}"):
                module.WrenchEstimator(chain, [0.0] * 3, np.zeros((7, 10)), np.ones(7), drive, **{**good, name: wrong})
        with pytest.raises(errors.ShapeError, match="finite point"):
            module.WrenchEstimator(
                chain, [0.0] * 3, np.zeros((7, 10)), np.ones(7), drive, **good, point=[0.0, np.nan, 0.0]
            )
