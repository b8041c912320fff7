"""Sample-by-sample contact wrench from accelerations and from momentum: against the oracles, and laws."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from armlab import kernels, robots
from armlab.errors import ShapeError
from armlab.kernels import momentum_step, solve_wrench
from armlab.log import Table
from armlab.models.uncertainty import FORCE_RATES, PRIOR

from .. import oracles
from ..oracles.wrench import METHODS

NAMES = ("F", "P", "observability", "error", "variance", "flags", "active", "interval")


def both(model: SimpleNamespace, kind: str, extra: tuple[object, ...], own: tuple[object, ...]) -> tuple[Any, Any]:
    """An estimator, compiled and as its oracle, with every kind of covariance."""
    c, made = model.covariance, []
    for module in (kernels, oracles):
        chain = module.Chain(model.frames, model.prismatic)
        friction = replace(model.friction, load=np.linspace(0.0, 0.1, 7))
        drive = module.Drive(friction.rows, model.ripple.rows, *extra)
        covariance = np.stack([c.C0, c.Cinf, c.shape, np.arange(7) % 3, np.linspace(0.2, 0.0, 7)])
        rigid = chain, model.gravity, model.link_parameters, model.rotor, drive
        made.append(getattr(module, kind)(*rigid, np.linspace(0.95, 1.05, 7), 0.03**2, covariance, *own, *doubts()))
    return made[0], made[1]


def doubts() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Link, rotor and friction columns of every joint but the last, with their covariance and means."""
    rng, columns = np.random.default_rng(0), np.full((7, 12), -1.0)
    for i in range(6):
        links = np.sort(rng.choice(np.arange(10 * i, 70), 9 - i, replace=False))
        columns[i, : 12 - i] = [*links, 70 + i, *np.sort(rng.choice(np.arange(77, 84), 2, replace=False))]
    root = 0.1 * rng.standard_normal((7, 12, 12))
    return columns, root @ np.swapaxes(root, 1, 2), np.linspace(0.0, 0.1, 7)


def twins(
    model: SimpleNamespace, method: int = 0, point: np.ndarray | None = None, extra: tuple[object, ...] = ()
) -> tuple[Any, Any]:
    bound = np.stack([model.bound.torque, model.bound.speed, model.bound.floor])
    own = bound, np.array([400.0, 400, 400, 4, 4, 4]), 10.0, method, point
    return both(model, "WrenchEstimator", extra, own)


# Torque error and its variance agree to 1e-12 of their scale; results of a linear solve to 1e-11, without a prior to
# 1e-8; HiGHS, which the reference uses for intervals, is exact to 1e-7.
ACCURACY = {"map": 1e-11, "bounded": 1e-9, "interval": 1e-9, "ls": 1e-8, "lund": 1e-11, "ols": 1e-8}


@pytest.mark.parametrize("point", [None, np.array([0.02, -0.01, 0.1])], ids=["wrench", "point"])
@pytest.mark.parametrize("method", sorted(ACCURACY))
def test_estimators_agree(model: SimpleNamespace, excited: Table, method: str, point: np.ndarray | None) -> None:
    log = excited.between(0.0, 0.12 if method == "interval" else 0.36)
    long, gap, broken, huge = np.array([40, 48, 56, 72]) // (3 if method == "interval" else 1)
    dt, tau = np.array(log.dt), np.array(log["tau"])
    dt[long], dt[gap] = 0.02, 0.5
    tau[broken, 2] = np.nan
    tau[huge, 1] = 1e200  # this would stay in the filter permanently
    compiled, plain = twins(model, METHODS.index(method), point)
    arguments = log["q"], log["qd"], tau, dt
    outputs = compiled.run(*arguments), plain.run(*arguments)
    for name, a, b in zip(NAMES, *outputs):
        if name == "interval" and b is None:
            assert a is None
            continue
        if name in ("flags", "active"):
            infeasible = (outputs[0][5] & 8) > 0  # each then names joints from its own proof of infeasibility
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


ARGUMENTS = ("F", "P", "observability", "error", "variance", "flags", "active")
POINT = np.array([0.02, -0.01, 0.1])
WAYS = {"observer": (False, False), "kf": (True, False), "kf with bias": (True, True)}


def momentum_twins(model: SimpleNamespace, way: str, point: np.ndarray | None = None) -> tuple[Any, Any]:
    """A momentum estimator, compiled and as its oracle, with warm-up."""
    rate, prior = np.square(FORCE_RATES["normal"]), np.square(PRIOR)
    warm_up = np.tile([[0.2], [-0.3], [60.0], [1.0], [0.1]], 7)
    memory, qd_noise, leak = np.linspace(0.02, 0.05, 7), np.linspace(1e-3, 2e-3, 7), np.linspace(0, 0.5, 6)
    own = prior, memory, qd_noise, rate, leak, 30.0, *WAYS[way], point
    return both(model, "MomentumEstimator", (None, None, warm_up), own)


@pytest.mark.parametrize("point", [None, POINT], ids=["wrench", "point"])
@pytest.mark.parametrize("way", sorted(WAYS))
def test_momentum_estimators_agree(model: SimpleNamespace, excited: Table, way: str, point: np.ndarray | None) -> None:
    """In motion, at rest, over a lost sample, over a gap, over invalid samples, and after a tare."""
    log = excited.between(0.0, 0.24)
    q, qd, tau, dt = (np.array(a) for a in (log["q"], log["qd"], log["tau"], log.dt))
    dt[12], dt[20] = 0.008, 0.5
    tau[18, 2], tau[27, 1] = np.nan, 1e200
    q[33:], qd[33:], dt[33:] = q[33], 0.0, 0.016
    compiled, plain = momentum_twins(model, way, point)
    for part in (slice(0, 56), slice(56, 60)):
        outputs = (
            compiled.run(q[part], qd[part], tau[part], dt[part]),
            plain.run(q[part], qd[part], tau[part], dt[part]),
        )
        for name, a, b in zip(ARGUMENTS, *outputs):
            if name in ("flags", "active"):
                assert np.array_equal(a, b), name
                continue
            accuracy = 1e-12 if name == "variance" else 1e-10
            np.testing.assert_allclose(a, b, rtol=0.0, atol=accuracy * np.nanmax(np.abs(b)), err_msg=name)
        assert outputs[0][7] is outputs[1][7] is None
        if part.start == 0:
            assert np.isnan(outputs[0][0][[18, 27]]).all()
            assert np.isfinite(outputs[0][0][[17, 19, 28]]).all()
            assert compiled.tare() is plain.tare() is (way == "kf with bias")
    assert np.all((outputs[0][5] & 32 > 0) == (way == "kf with bias"))


@pytest.mark.parametrize("way", [*sorted(ACCURACY), *sorted(WAYS)])
def test_step_returns_what_run_stacks_and_reset_forgets(model: SimpleNamespace, excited: Table, way: str) -> None:
    log = excited.between(0.0, 0.1)
    estimator = momentum_twins(model, way)[0] if way in WAYS else twins(model, METHODS.index(way))[0]
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
    """Arguments common to all estimators, with the right shapes."""
    drive = kernels.Drive(np.full((11, n), 0.5), np.ones((3, n)))
    rigid = {"gravity": np.zeros(3), "links": np.zeros((7, 10)), "rotor": np.ones(7), "drive": drive}
    return rigid | {"gains": np.ones(7), "gain_variance": 1.0, "covariance": np.ones((5, 7))}


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
    """Wrong shapes; also negative or non-finite variances, gains or rates."""
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


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 6), (6, 6), (7, 6), (7, 13), (9, 15)])
def test_steps_agree(n: int, m: int) -> None:
    rng = np.random.default_rng(n + 100 * m)
    x, root = rng.standard_normal(n + m), rng.standard_normal((n + m, n + m))
    P, G = root @ root.T, rng.standard_normal((n, m))
    for _ in range(30):
        u, y, spread = *rng.standard_normal((2, n)), rng.standard_normal((n, n))
        a = np.where(rng.random(m) < 0.3, 0.0, rng.uniform(0, 30, m))
        arguments = (x, P, G, u, y, 1e-3 * spread @ spread.T, 0.004, rng.uniform(0.1, 1, n), rng.uniform(0.1, 1, m), a)
        ours, wanted = kernels.momentum_step(*arguments), oracles.momentum_step(*arguments)
        for a_, b in zip(ours, wanted):
            np.testing.assert_allclose(a_, b, rtol=0, atol=1e-12 * np.abs(b).max())
        x, P = wanted


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
    """An uninformative measurement leaves the prediction unchanged: transition and noise to 1e-12 of their scale."""
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
    quiet = oracles.momentum_step(x, 0 * P, G, u, moved[:n], np.eye(n) * 1e15, H, Qp, q, a)[1]
    np.testing.assert_allclose(quiet, Q, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("intensity", [2.0, 20.0, 200.0])
def test_held_torques_give_weighted_least_squares(intensity: float) -> None:
    """No leak, a constant torque error, velocity known: the steady wrench is prior-free least squares, weights 1/Qp.

    The velocity is known exactly, R = 0: with R = 1e-12 (N m s)^2 the wrench is off by 1e-6.
    """
    robot = robots.load("yumi_left")
    rng = np.random.default_rng(1)
    J = robot.chain.jacobian(robot.q_home)
    tau_e, Qp = rng.standard_normal(7), rng.uniform(0.5, 2, 7) * 1e-3
    x, P = np.zeros(13), np.diag(np.r_[np.zeros(7), [400.0] * 3, [4.0] * 3])
    p = np.zeros(7)
    for _ in range(1500):  # the slowest mode, of the smallest intensity, keeps 0.980 per step
        p = p + H * tau_e
        x, P = momentum_step(
            x, P, J.T, np.zeros(7), p, np.zeros((7, 7)), H, Qp, intensity**2 * np.array([1, 1, 1, 0.01, 0.01, 0.01]),
            np.zeros(6),
        )  # fmt: skip
    weighted = J / Qp
    expected = np.linalg.solve(weighted @ J.T, weighted @ tau_e)
    np.testing.assert_allclose(x[7:], expected, rtol=1e-8)


def test_a_wrench_held_over_one_step_is_the_static_estimate() -> None:
    """Momentum known, R -> 0, a fresh wrench N(0, C_F) acting during the step: MAP with C_tau = Qp / h, to 1e-9."""
    robot, rng = robots.load("yumi_left"), np.random.default_rng(4)
    prior, scale = np.r_[[400.0] * 3, [4.0] * 3], np.r_[[20.0] * 3, [2.0] * 3]
    for q in rng.uniform(robot.q_min, robot.q_max, (20, 7)):
        J, Qp = robot.chain.jacobian(q), rng.uniform(0.5, 2, 7) * 1e-3
        u, tau_e = rng.standard_normal((2, 7))
        p = H * (u + tau_e)
        x, P = momentum_step(
            np.zeros(13), np.diag(np.r_[np.zeros(7), np.ones(6)]), J.T * scale, u, p, np.zeros((7, 7)), H, Qp,
            np.zeros(6), np.zeros(6),
        )  # fmt: skip
        F, cov, *_ = solve_wrench(J, tau_e, Qp / H, np.zeros(7), prior, 0)
        np.testing.assert_allclose(scale * x[7:], F, rtol=0, atol=1e-9 * np.abs(F).max())
        np.testing.assert_allclose(np.outer(scale, scale) * P[7:, 7:], cov, rtol=0, atol=1e-9 * cov.max())


def test_external_torques_in_place_of_the_wrench_make_the_observer() -> None:
    """With G = 1 and the steady-state gain, ``z <- z + k ((p - p_before) - h (u + z))``, to 1e-9."""
    rng = np.random.default_rng(5)
    n, R = 3, np.zeros((3, 3))
    arguments = np.eye(n), H, np.full(n, 1e-2), np.full(n, 20.0), np.zeros(n)
    x, P = np.zeros(2 * n), np.eye(2 * n)

    def step(x: np.ndarray, P: np.ndarray, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        G, h, Qp, q, a = arguments
        return momentum_step(x, P, G, u, y, R, h, Qp, q, a)

    for _ in range(2000):
        x, P = step(x, P, np.zeros(n), np.zeros(n))
    gain = step(np.zeros(2 * n), P, np.zeros(n), np.ones(n))[0][n:]
    p, r = np.zeros(n), np.zeros(n)
    x = np.zeros(2 * n)
    for _ in range(200):
        u, y = rng.standard_normal((2, n))
        x, P = step(x, P, u, y)
        r, p = r + gain * ((y - p) - H * (u + r)), y
        np.testing.assert_allclose(x[n:], r, rtol=0, atol=1e-9 * np.abs(r).max())


def test_its_covariance_is_that_of_its_errors() -> None:
    """NEES of a random-walk wrench with the torque and velocity noise that the filter assumes: 0.95 to 1.05."""
    robot = robots.load("yumi_left")
    rng = np.random.default_rng(2)
    J = robot.chain.jacobian(robot.q_home)
    Qp, R, q = np.full(7, 4e-3), 1e-6 * np.eye(7), np.r_[np.full(3, 25.0), np.full(3, 0.25)]
    Phi, Q = van_loan(J.T, Qp, q, np.zeros(6), H)
    root, start = np.linalg.cholesky(Q + 1e-18 * np.eye(13)), np.r_[np.full(7, 1e-6), [400.0] * 3, [4.0] * 3]
    nees = []
    for _ in range(300):
        x, P, true = np.zeros(13), np.diag(start), np.sqrt(start) * rng.standard_normal(13)
        for k in range(1, 121):
            true = Phi @ true + root @ rng.standard_normal(13)
            y = true[:7] + 1e-3 * rng.standard_normal(7)
            x, P = momentum_step(x, P, J.T, np.zeros(7), y, R, H, Qp, q, np.zeros(6))
            if k % 60 == 0:
                error = x[7:] - true[7:]
                nees.append(error @ np.linalg.solve(P[7:, 7:], error) / 6)
    assert abs(np.mean(nees) - 1) < (0.05)


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
