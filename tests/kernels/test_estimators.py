"""Contact wrench sample by sample, with accelerations against an oracle, by the momentum against laws."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from armlab import kernels
from armlab.errors import ShapeError
from armlab.kernels import momentum_step
from armlab.log import Table

from .. import oracles
from ..oracles.wrench import METHODS

NAMES = ("F", "P", "observability", "error", "variance", "flags", "active", "interval")


def twins(
    model: SimpleNamespace, method: int = 0, point: np.ndarray | None = None, extra: tuple[object, ...] = ()
) -> tuple[Any, Any]:
    """The same estimator compiled and as its oracle, with every kind of covariance."""
    c, bound = model.covariance, np.stack([model.bound.torque, model.bound.speed, model.bound.floor])
    covariance = np.stack([c.C0, c.Cinf, c.shape, np.arange(7) % 3])
    made = []
    for module in (kernels, oracles):
        drive = module.Drive(model.friction.rows, model.ripple.rows, *extra)
        rigid = module.Chain(model.frames, model.prismatic), model.gravity, model.link_parameters, model.rotor, drive
        gains = np.linspace(0.95, 1.05, 7), 0.03**2
        own = bound, np.array([400.0, 400, 400, 4, 4, 4]), 10.0, method, point
        made.append(module.WrenchEstimator(*rigid, *gains, covariance, *own))
    return made[0], made[1]


# Torque error and its variance to 1e-12 of their scale; what passes a solution of equations to 1e-11, without a prior
# to 1e-8; HiGHS, which the reference asks for intervals, is exact to 1e-7.
ACCURACY = {"map": 1e-11, "bounded": 1e-9, "interval": 1e-9, "ls": 1e-8, "lund": 1e-11}


@pytest.mark.parametrize("point", [None, np.array([0.02, -0.01, 0.1])], ids=["wrench", "point"])
@pytest.mark.parametrize("method", sorted(ACCURACY))
def test_estimators_agree(model: SimpleNamespace, excited: Table, method: str, point: np.ndarray | None) -> None:
    log = excited.between(0.0, 0.12 if method == "interval" else 0.36)
    long, gap, broken, huge = np.array([40, 48, 56, 72]) // (3 if method == "interval" else 1)
    dt, tau = np.array(log.dt), np.array(log["tau"])
    dt[long], dt[gap] = 0.02, 0.5
    tau[broken, 2] = np.nan
    tau[huge, 1] = 1e200  # one that would stay in the filter for ever
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
        assert np.isnan(a[[broken, huge]]).all()
        assert np.isfinite(a[huge + 1]).all()


@pytest.mark.parametrize("method", ["map", "bounded"])
def test_estimators_agree_on_every_part_of_the_drives(model: SimpleNamespace, excited: Table, method: str) -> None:
    log, rng = excited.between(0.0, 0.6), np.random.default_rng(0)
    speeds, widths = np.tile(np.linspace(0.1, 2.0, 8), (7, 1)), np.full((7, 8), 0.3)
    positions = np.tile(np.linspace(-2, 2, 5), (7, 1))
    lines = np.arange(7.0), rng.uniform(50, 200, 7), speeds, widths, rng.standard_normal((7, 2, 8, 2))
    table = positions, 0.5 + 0 * positions, speeds, widths, rng.standard_normal((7, 2, 5, 8))
    warm_up = np.array([[0.2], [-0.3], [0.5], [1.0], [0.1]]) * rng.uniform(0.9, 1.1, (5, 7))
    compiled, plain = twins(model, METHODS.index(method), extra=(lines, table, warm_up))
    a, b = (estimator.run(log["q"], log["qd"], log["tau"], log.dt) for estimator in (compiled, plain))
    np.testing.assert_allclose(a[3], b[3], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(a[4], b[4], rtol=1e-11)


@pytest.mark.parametrize("way", sorted(ACCURACY))
def test_step_returns_what_run_stacks_and_reset_forgets(model: SimpleNamespace, excited: Table, way: str) -> None:
    log = excited.between(0.0, 0.1)
    estimator = twins(model, METHODS.index(way))[0]
    stacked = estimator.run(log["q"], log["qd"], log["tau"], log.dt)
    estimator.reset()
    for k in range(len(log)):
        found = estimator.step(log["q"][k], log["qd"][k], log["tau"][k], log.dt[k])
        assert (found[7] is None) == (stacked[7] is None) == (way != "interval")
        for one, all_rows in zip(found, stacked, strict=True):
            assert one is None or np.array_equal(one, all_rows[k])
    empty = np.zeros((0, 7))
    assert [np.shape(a) for a in estimator.run(empty, empty, empty, np.zeros(0))[:2]] == [(0, 6), (0, 6, 6)]


def known(n: int = 7) -> dict[str, Any]:
    """What every estimator is given, of the right shapes."""
    drive = kernels.Drive(np.ones((10, n)), np.ones((3, n)))
    rigid = {"gravity": np.zeros(3), "links": np.zeros((7, 10)), "rotor": np.ones(7), "drive": drive}
    return rigid | {"gains": np.ones(7), "gain_variance": 1.0, "covariance": np.ones((4, 7))}


OWN: dict[str, tuple[type, dict[str, Any], dict[str, Any]]] = {
    "wrench": (kernels.WrenchEstimator, {"bound": np.ones((3, 7)), "prior": np.ones(6), "cutoff": 10.0}, {}),
    "momentum": (
        kernels.MomentumEstimator,
        dict(zip(("prior", "memory", "qd_noise", "rate", "leak"), (np.ones(k) for k in (6, 7, 7, 6, 6))))
        | {"gain": 30.0},
        {"filters": True, "biased": False},
    ),
}


@pytest.mark.parametrize("kind", OWN)
def test_wrong_parameters_are_refused(model: SimpleNamespace, kind: str) -> None:
    """Of another shape; and below zero or not finite where they are variances, gains or rates."""
    (make, own, flags), chain = OWN[kind], kernels.Chain(model.frames, model.prismatic)
    good = known() | own
    for name, value in good.items():
        wrong = known(6)["drive"] if name == "drive" else np.zeros(5)
        if np.ndim(value) or name == "drive":
            with pytest.raises(ShapeError, match=name):
                make(chain, **{**good, name: wrong}, **flags)
        for factor in (-1.0, np.nan, np.inf) if name not in ("gravity", "links", "rotor", "drive") else ():
            with pytest.raises(ShapeError, match=f"^Expected finite {name}"):
                make(chain, **{**good, name: factor * value}, **flags)
    for point in (np.zeros(2), [0.0, np.nan, 0.0]):
        with pytest.raises(ShapeError, match="point"):
            make(chain, **good, **flags, point=point)
    one, q = make(chain, **good, **flags), np.zeros(7)
    for change in ({"qd": np.zeros(6)}, {"tau": 0.0}, {"q": None}, {"qd": None}, {"tau": None}):
        with pytest.raises(ShapeError, match=f"^Expected {next(iter(change))} "):
            one.step(**{"q": q, "qd": q, "tau": q, "dt": 0.004, **change})
    with pytest.raises(ShapeError, match="tau"):
        one.run(np.zeros((5, 7)), np.zeros((5, 7)), np.zeros((4, 7)), np.zeros(5))


H = 0.004


def van_loan(G: np.ndarray, Qp: np.ndarray, q: np.ndarray, a: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise of a step by the block exponential (Van Loan 1978)."""
    n, m = G.shape
    A = np.block([[np.zeros((n, n)), G], [np.zeros((m, n)), -np.diag(a)]])
    Q = np.diag(np.r_[Qp, q])
    block = expm(np.block([[-A, Q], [np.zeros_like(A), A.T]]) * h)
    Phi = block[n + m :, n + m :].T
    return Phi, Phi @ block[: n + m, n + m :]


@given(st.integers(0, 2**32), st.sampled_from([0.0, 1e-9, 1e-3, 0.5, 4.9, 5.1, 80.0, 900.0]), st.booleans())
@settings(max_examples=60)
def test_a_step_without_information_is_van_loans(seed: int, leak: float, mixed: bool) -> None:
    """A measurement that says nothing leaves the prediction: transition and noise to 1e-12 of their scale."""
    rng = np.random.default_rng(seed)
    n, m = 4, 3
    G, Qp, q = rng.standard_normal((n, m)), rng.uniform(0.1, 1, n), rng.uniform(0.1, 1, m)
    a = np.where(rng.random(m) < 0.5, 0.0, leak) if mixed else np.full(m, leak)
    x, root = rng.standard_normal(n + m), rng.standard_normal((n + m, n + m))
    P, u = root @ root.T, rng.standard_normal(n)
    Phi, Q = van_loan(G, Qp, q, a, H)
    moved = Phi @ x
    moved[:n] += H * u
    new_x, new_P = momentum_step(x, P, G, u, moved[:n], np.eye(n) * 1e15, H, Qp, q, a)
    np.testing.assert_allclose(new_x, moved, rtol=0, atol=1e-12 * np.abs(moved).max())
    np.testing.assert_allclose(new_P, Phi @ P @ Phi.T + Q, rtol=0, atol=1e-12 * np.abs(new_P).max())
    quiet = momentum_step(x, 0 * P, G, u, moved[:n], np.eye(n) * 1e15, H, Qp, q, a)[1]
    np.testing.assert_allclose(quiet, Q, rtol=1e-9, atol=1e-18)


def test_the_covariance_stays_symmetric_and_positive() -> None:
    rng = np.random.default_rng(3)
    x, P = np.zeros(13), np.diag(np.r_[np.full(7, 1e-8), [400.0] * 3, [4.0] * 3])
    for _ in range(5_000):
        G = rng.standard_normal((7, 6))
        x, P = momentum_step(
            x, P, G, rng.standard_normal(7), rng.standard_normal(7), 1e-10 * np.eye(7), H, np.full(7, 1e-3),
            np.full(6, 25.0), np.full(6, 0.5),
        )  # fmt: skip
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() > 0


def test_wrong_shapes_and_no_noise_are_refused() -> None:
    good = {
        "x": np.zeros(3), "P": np.zeros((3, 3)), "G": np.ones((2, 1)), "u": np.zeros(2), "y": np.zeros(2),
        "R": np.zeros((2, 2)), "h": H, "Qp": np.zeros(2), "q": np.zeros(1), "a": np.zeros(1),
    }  # fmt: skip
    with pytest.raises(ShapeError, match="positive covariance"):
        momentum_step(**good)
    for name in ("x", "P", "u", "y", "R", "Qp", "q", "a"):
        with pytest.raises(ShapeError, match=name):
            momentum_step(**{**good, name: np.zeros(9)})
        with pytest.raises(ShapeError, match=f"^Expected {name} to be an array of real numbers, got NoneType"):
            momentum_step(**{**good, name: None})
