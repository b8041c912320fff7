"""Fits of movement primitives: accuracy, laws of the methods, covariance, noise, and several demonstrations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.errors import ConfigError, ShapeError
from armlab.estimation import Experiment, Gauge, check_estimator
from armlab.lie import so3
from armlab.motion import Dmp, fit_dmp
from armlab.motion.primitive.fit import METHODS

U = np.linspace(0, 1, 1001)
S = 10 * U**3 - 15 * U**4 + 6 * U**5
RAMP = np.concatenate([np.zeros(10), np.linspace(0, 2, 1000), np.full(500, 2.0)])
Motion = tuple[np.ndarray, np.ndarray]


def demo(name: str) -> Motion:
    """Minimum jerk, a letter of two strokes, the ramp of the ancestor."""
    if name == "min-jerk":
        return U, S[:, None]
    if name == "letter":
        x = 0.10 * np.cos(2.8 * np.pi * S) - 0.02 * np.sin(6 * np.pi * S) + 0.06 * S
        y = 0.12 * np.sin(2.8 * np.pi * S + 0.4) + 0.03 * np.cos(4 * np.pi * S) - 0.05 * S
        return U, np.stack([x, y], axis=1)
    y = np.stack([RAMP, RAMP / 2], axis=1)
    noise = np.random.default_rng(0).normal(size=y.shape) * 1e-3 if name == "noisy ramp" else 0.0
    return np.linspace(0, 10, 1510), y + noise


def rmse(dmp: Dmp, name: str) -> float:
    t, y = demo(name.removeprefix("noisy "))
    return float(np.sqrt(((dmp.rollout(t).y - y) ** 2).mean()))


NAMES = ["min-jerk", "letter", "ramp", "noisy ramp"]
BARS = {  # pinned ends: 50 and 15 kernels; free ends: 50 and 15; default: 50
    "min-jerk": (2.2e-6, 7.5e-5, 1.6e-6, 6.3e-5, 3.0e-6),
    "letter": (2.5e-7, 6.7e-4, 2.0e-7, 6.3e-4, 2.0e-6),
    "ramp": (3.8e-4, 2.2e-3, 3.6e-4, 2.0e-3, 3.8e-4),
    "noisy ramp": (4.3e-4, 2.2e-3, 4.1e-4, 2.0e-3, 4.3e-4),
}


@pytest.mark.parametrize("name", NAMES)
def test_accuracy_and_rest_at_the_goal(name: str) -> None:
    settings: tuple[dict[str, Any], ...] = (
        {"hold": 0.0},
        {"hold": 0.0, "n_basis": 15},
        {"hold": 0.0, "pin": ()},
        {"hold": 0.0, "pin": (), "n_basis": 15},
        {},
    )
    found = [fit_dmp(*demo(name), **options).value for options in settings]
    errors, bars = [rmse(dmp, name) for dmp in found], np.array(BARS[name]) * [1, 1, 1.05, 1.05, 1]
    assert (errors <= bars).all(), (errors, bars)
    t, dmp = demo(name)[0], found[-1]
    after = dmp.rollout(np.linspace(0, 4 * t[-1], 4000))
    assert abs(after.y - dmp.g)[after.t > t[-1]].max() <= 1.5e-3, "it stays at the goal"
    assert abs(after.y[-1] - dmp.g).max() < 1e-6


def test_start_with_velocity() -> None:
    t = np.linspace(0, 1, 1001)
    y = np.sin(0.45 * np.pi * t + 0.3)[:, None]
    dmp = fit_dmp(t, y, hold=0.0).value
    assert np.sqrt(((dmp.rollout(t).y - y) ** 2).mean()) <= 1e-6
    np.testing.assert_allclose(dmp.v0, 0.45 * np.pi * np.cos(0.3), rtol=5e-3)


def test_no_displacement() -> None:
    t = np.linspace(0, 1, 1001)
    y = np.stack([np.sin(np.pi * t) ** 2, np.full(1001, 0.7), 1e-3 * t + np.sin(np.pi * t) ** 2], axis=1)
    dmp = fit_dmp(t, y, hold=0.0).value  # it turns back with acceleration
    assert np.sqrt(((dmp.rollout(t).y - y) ** 2).mean()) <= 5e-6
    assert dmp.unscaled == (0, 1, 2)
    for method in METHODS:
        assert np.abs(fit_dmp(t, y, method=method).value.weights).max() < 1e3
    report = fit_dmp(t, y).report()
    assert "hardly moved: 0, 1, 2" in report
    assert "RMSE of the motion" in report


@pytest.mark.parametrize(("n_basis", "jerk", "ramp"), [(15, 1.1e-5, 3.4e-3), (50, 1e-7, 5.2e-4)])
def test_time_phase(n_basis: int, jerk: float, ramp: float) -> None:
    for name, bar in (("min-jerk", jerk), ("ramp", ramp)):
        t, y = demo(name)
        dmp = fit_dmp(t, y[:, :1], n_basis=n_basis, schedule="time", hold=0.0).value
        assert np.sqrt(((dmp.rollout(t).y - y[:, :1]) ** 2).mean()) <= bar


def test_position_phase() -> None:
    t, y = demo("ramp")
    y = y[:, :1]
    errors = []
    for method in ("acceleration", "trajectory"):
        fit = fit_dmp(t, y, n_basis=15, schedule="position", method=method)
        errors.append(float(np.sqrt(((fit.value.rollout(t).y - y) ** 2).mean())))
        assert np.isfinite(fit.cov).all()
    assert errors[0] <= 3.6e-3
    assert errors[1] <= 3.1e-3


@pytest.mark.parametrize("schedule", ["canonical", "time", "position"])
@pytest.mark.parametrize("convention", ["lund", "ijspeert"])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_follows(schedule: str, convention: str, method: str) -> None:
    t = np.linspace(0, 2, 101)
    u = t / 2
    y = np.stack([u**2 * (3 - 2 * u), -0.3 * u**2 * (3 - 2 * u)], axis=1)
    fit = fit_dmp(t, y, schedule=schedule, convention=convention, method=method, n_basis=20)
    run = fit.value.rollout(t)
    assert abs(run.y - y).max() < {"trajectory": 2e-3, "acceleration": 6e-3, "lwr": 3e-2}[method]
    shifted = fit_dmp(t + 5, y, schedule=schedule, convention=convention, method=method, n_basis=20).value
    np.testing.assert_allclose(shifted.rollout(t + 5).y, run.y, atol=1e-9)


def test_the_report_says_when_the_noise_cannot_be_told() -> None:
    t = np.linspace(0.0, 1.0, 20)
    few, enough = (fit_dmp(t, t**2 * (3 - 2 * t), n_basis=n).report() for n in (50, 10))
    assert "20 samples for 51 unknowns: the noise is not identifiable" in few
    assert "not told" not in enough


@pytest.mark.parametrize("schedule", ["canonical", "time"])
@pytest.mark.parametrize("n_basis", [3, 50, pytest.param(1000, marks=pytest.mark.slow)])
def test_three_samples_and_a_constant_are_enough(schedule: str, n_basis: int) -> None:
    for y in (np.array([0.0, 0.4, 1.0]), np.full(3, 2.0)):
        fit = fit_dmp([0.0, 0.3, 1.0], y, schedule=schedule, n_basis=n_basis)
        run = fit.value.rollout(np.array([0.0, 0.3, 1.0, 100.0]))
        assert np.isfinite(run.y).all()
        assert np.isfinite(fit.cov).all()
        assert fit.excitation.rank <= fit.excitation.expected


def test_uneven_times_weights_and_smoothed_derivatives() -> None:
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0, 1, 400))
    y = np.interp(t, U, S)[:, None]
    assert (
        np.sqrt(((fit_dmp(t, y).value.rollout(U).y - np.interp(U, t - t[0], y[:, 0])[:, None])[:900] ** 2).mean())
        < 1e-3
    )
    spoilt, weights = S[:, None].copy(), np.ones(1001)
    spoilt[400:420], weights[400:420] = 5.0, 0.0
    assert rmse(fit_dmp(U, spoilt, sample_weights=weights).value, "min-jerk") < 1e-5
    noisy = S[:, None] + rng.normal(size=(1001, 1)) * 1e-3
    rough, smooth = (fit_dmp(U, noisy, method="acceleration", bandwidth=b).sigma[0] for b in (None, 15.0))
    assert smooth < rough / 10


@pytest.mark.parametrize("ridge", [0.0, 1e-3, 10.0])
@pytest.mark.parametrize("method", ["acceleration", "lwr"])
def test_noise_is_that_of_the_residuals(method: str, ridge: float) -> None:
    t, y = demo("noisy ramp")
    weights = np.random.default_rng(4).uniform(0.5, 1.5, len(t))
    fit = fit_dmp(t, y, method=method, ridge=ridge, n_basis=20, sample_weights=weights)
    squares = weights / weights.mean() @ fit.residuals**2
    np.testing.assert_allclose(fit.sigma, np.sqrt(squares / (len(t) - 20)), rtol=1e-9)


def test_ridge_shrinks_the_weights() -> None:
    t, y = demo("noisy ramp")
    for method in ("trajectory", "acceleration"):
        small, large = (abs(fit_dmp(t, y, method=method, ridge=r).value.weights).sum() for r in (0.0, 100.0))
        assert large < 0.9 * small


def test_known_ends_are_kept() -> None:
    t, y = demo("noisy ramp")
    dmp = fit_dmp(t, y, y0=[0.0, 0.0], v0=[0.0, 0.0], g=[2.0, 1.0]).value
    np.testing.assert_array_equal(dmp.g, [2.0, 1.0])
    np.testing.assert_array_equal([dmp.y0, dmp.v0], np.zeros((2, 2)))
    pinned = fit_dmp(t, y, pin=("y0", "v0", "g")).value
    np.testing.assert_allclose(pinned.v0, (y[1] - y[0]) / t[1], rtol=1e-9)


def test_demonstrations_share_their_weights() -> None:
    ends, ms = [(0.0, 1.0), (0.5, -1.0), (1.0, 3.5)], [400, 501, 333]
    ts = [np.linspace(0, k + 1.0, N) for k, N in enumerate(ms)]
    ys = []
    for (a, b), t in zip(ends, ts):
        s = np.interp(t / t[-1], U, S + 0.1 * np.sin(np.pi * U) ** 2)
        ys.append(np.stack([a + (b - a) * s, 2 * b + 0.5 * (a - b) * s], axis=1))
    fit = fit_dmp(ts, ys)
    dmp = fit.value
    for t, y in zip(ts, ys):
        run = dmp.rollout(t, y0=y[0], g=y[-1], duration=t[-1])
        assert abs(run.y - y).max() < 1e-4 * np.ptp(y)
    again = fit_dmp(ts[::-1], ys[::-1]).value
    np.testing.assert_allclose(again.weights, dmp.weights, rtol=1e-9, atol=1e-9 * abs(dmp.weights).max())
    swapped = fit_dmp(ts, [y[:, ::-1] for y in ys]).value
    np.testing.assert_allclose(swapped.weights[:, ::-1], dmp.weights, rtol=0, atol=1e-11 * abs(dmp.weights).max())
    assert dmp.demo_weights.shape == (3, 50, 2)
    assert fit.names.count("v0 of demonstration 2 of coordinate 1") == 1
    assert fit_dmp(ts[:2], ys[:2]).value.demo_weights is None
    with pytest.raises(ConfigError, match="at least 3 demonstrations"):
        fit_dmp(ts[:2], ys[:2]).value.sample(np.random.default_rng(0))


def test_turned_demonstrations_are_one_path() -> None:
    _, letter = demo("letter")
    path = np.concatenate([letter, S[:, None]], axis=1)
    way = path[-1] - path[0]
    across = np.cross(way, [0.3, -1.0, 0.2])
    R = so3.exp(across / np.linalg.norm(across))
    turned = path[0] + 2.0 * (path - path[0]) @ R.T
    dmp = fit_dmp([U, U], [path, turned], scaling="rotate").value
    for y in (path, turned):
        assert abs(dmp.rollout(U, y0=y[0], g=y[-1]).y - y).max() < 1e-4
    with pytest.raises(ShapeError, match="displacement"):
        fit_dmp(U, np.concatenate([path, path[::-1]])[::2][:1001], scaling="rotate")
    with pytest.raises(ConfigError, match="three coordinates"):
        fit_dmp(*demo("letter"), scaling="rotate")


def test_a_pause_is_no_progress() -> None:
    t = np.linspace(0, 1, 101)
    y = np.interp(t, [0, 0.4, 0.6, 1.0], [0.0, 1.0, 1.0, 2.0])
    with pytest.raises(ShapeError, match="pauses at sample"):
        fit_dmp(t, y, schedule="position")
    resting = np.interp(t, [0, 0.2, 0.7, 1.0], [0.0, 0.0, 2.0, 2.0])
    assert fit_dmp(t, resting, schedule="position", n_basis=10).value.monotone.all()


def test_samples_have_the_mean_and_covariance_of_the_demonstrations() -> None:
    rng = np.random.default_rng(2)
    ys = [(S + a * np.sin(np.pi * U) ** 2)[::10, None] for a in rng.normal(size=6) * 0.2]
    dmp = fit_dmp([U[::10]] * 6, ys, n_basis=5).value
    drawn = np.array([dmp.sample(rng).weights.ravel() for _ in range(2000)])
    root = np.sqrt(np.diag(dmp.weight_covariance))
    assert (abs(drawn.mean(axis=0) - dmp._mean_weights.ravel()) < 4 * root / np.sqrt(2000) + 1e-9).all()
    np.testing.assert_allclose(np.cov(drawn.T), dmp.weight_covariance, atol=0.15 * root.max() ** 2)
    np.testing.assert_allclose(np.cov(dmp.demo_weights[..., 0].T), dmp.weight_covariance, atol=1e-9 * root.max() ** 2)


def drawn(seed: int, n: int, unit: float = 1.0, **options: Any) -> Experiment:
    """Noisy samples of a primitive with known weights."""
    t = np.linspace(0, 1, n)
    shape = np.stack([1 + S, 2 - S + 20 * (U - U**2) ** 3], axis=1)  # from rest to rest
    truth = fit_dmp(U, shape, n_basis=8, pin=("y0", "v0", "g"), hold=2.0).value
    y = unit * (truth.rollout(t).y + np.random.default_rng(seed).normal(size=(n, 2)) * 1e-2)
    ends = {"y0": unit * truth.y0, "g": unit * truth.g}
    parts = np.concatenate([truth.weights, [truth.y0, truth.v0, truth.g]]) * unit
    return Experiment({"t": t, "y": y, "n_basis": 8, "hold": 0.0, **ends, **options}, parts.T.ravel())


def test_the_fit_meets_the_contract() -> None:
    def scaled(data: dict[str, Any]) -> dict[str, Any]:
        return {k: 1000 * np.asarray(a) if k in ("y", "y0", "g") else a for k, a in data.items()}

    contract = check_estimator(
        fit_dmp,
        drawn,
        40,
        n=80,
        gauges=[Gauge("millimetres", scaled, lambda fit: 1000 * fit.parameters)],
        noise_given=False,
        skip={
            "efficient": "judged from 1000 runs on",
            "order-free": "samples are a motion in time",
            "refuses": "directions that the samples do not tell are left at zero and counted in the rank",
            "robust": "a motion has no outliers that could be told from it; give sample_weights",
        },
    )
    assert contract.passed, contract.text()


def test_noise_of_pinned_ends_is_in_the_covariance() -> None:
    def pinned(seed: int, n: int) -> Experiment:
        one = drawn(seed, n)
        return Experiment({k: a for k, a in one.data.items() if k not in ("y0", "g")}, one.truth)

    reasons = dict.fromkeys(
        ("consistent", "efficient", "order-free", "gauge-free", "refuses", "robust", "saves", "explains", "clean"),
        "the ends are one sample each however many there are",
    )
    contract = check_estimator(fit_dmp, pinned, 40, n=80, noise_given=False, skip=reasons)
    assert contract.passed, contract.text()


@pytest.mark.parametrize(
    "options",
    [{}, {"hold": 0.0}, {"hold": 0.0, "pin": ()}, {"pin": ("y0", "v0", "g")}, {"y0": np.zeros(40), "g": np.zeros(40)}],
    ids=["default", "no hold", "free", "pinned", "known"],
)
def test_degrees_of_freedom_are_the_trace_of_what_residuals_are_of_the_samples(options: dict[str, Any]) -> None:
    """A fit to unit samples gives that matrix as its residuals; ``sigma^2 = sum r^2 / trace``."""
    t = np.linspace(0.0, 1.0, 40)
    fit = fit_dmp(t, np.eye(40), n_basis=6, scaling="none", **options)
    trace = abs(np.trace(fit.residuals))
    np.testing.assert_allclose(fit.sigma, np.sqrt((fit.residuals**2).sum(axis=0) / trace), rtol=1e-9)
    if options.get("hold") == 0.0 and options.get("pin") == ():
        np.testing.assert_allclose(trace, 40 - 6 - 3, rtol=1e-9)


def test_noise_of_a_position_phase_is_that_of_its_residuals() -> None:
    t = np.linspace(0.0, 1.0, 101)
    y = S[::10, None] + 1e-4 * np.random.default_rng(0).normal(size=(101, 1))
    fit = fit_dmp(t, np.maximum.accumulate(y), schedule="position", n_basis=10)
    np.testing.assert_allclose(fit.sigma, np.sqrt((fit.residuals**2).sum(axis=0) / (101 - 10)), rtol=1e-9)


def test_the_start_velocity_is_the_nearest_to_those_of_the_demonstrations() -> None:
    """``v0 s T0 / T`` is the velocity for a demonstration s times as far in T seconds; v0 is the least-squares fit."""
    durations, ends, slopes = np.array([1.0, 2.0, 4.0]), np.array([1.0, 2.0, 6.0]), np.array([0.5, -0.2, 0.9])
    ts = [T * U[::10] for T in durations]
    ys = [end * S[::10] + slope * t * (1 - t / t[-1]) ** 2 for t, end, slope in zip(ts, ends, slopes)]
    found = fit_dmp(ts, ys, n_basis=6, pin=("y0", "v0", "g")).value
    v = np.array([(y[1] - y[0]) / t[1] for t, y in zip(ts, ys)])
    s = ends / ends.mean()
    wanted = np.linalg.lstsq(s[:, None], v * durations / durations.mean())[0]
    np.testing.assert_allclose(found.v0, wanted, rtol=1e-9)
