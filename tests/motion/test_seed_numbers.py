"""Numbers of the published equations, from an independent implementation, on the demonstrations of the ancestor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.motion import Dmp, fit_dmp

DATA = Path(__file__).resolve().parents[3] / "shared/data/dmp_reference.json"
pytestmark = pytest.mark.skipif(not DATA.exists(), reason="needs ../shared/data/dmp_reference.json")

SEED: dict[str, Any] = {"method": "lwr", "n_basis": 15, "spacing": "phase"}


@pytest.fixture(scope="module")
def numbers() -> dict[str, Any]:
    """All reference numbers."""
    return json.loads(DATA.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def readme() -> tuple[np.ndarray, np.ndarray]:
    """The demonstration of the ancestor's README: a ramp that begins and ends at rest."""
    first = np.concatenate([np.zeros(10), np.linspace(0, 2, 1000), np.full(500, 2.0)])
    return np.linspace(0, 10, 1510), np.stack([first, 0.5 * first], axis=1)


@pytest.fixture(scope="module")
def seed(readme: tuple[np.ndarray, np.ndarray]) -> Dmp:
    """Fitted as the ancestor does."""
    return fit_dmp(*readme, **SEED).value


def test_kernels_and_weights(numbers: dict[str, Any], seed: Dmp) -> None:
    wanted = numbers["readme_fit"]
    np.testing.assert_allclose(seed.centres, wanted["centers"], rtol=1e-13)
    np.testing.assert_allclose(seed.widths**2, wanted["sigma2"], rtol=1e-13)
    np.testing.assert_allclose(seed.tau_d, wanted["tau"], rtol=1e-15)
    for i, name in enumerate(("w_lwr_dof1", "w_lwr_dof2")):
        np.testing.assert_allclose(seed.weights[:, i] / (seed.g - seed.y0)[i], wanted[name], rtol=1e-10)


def test_forcing_that_the_demonstration_asks_for(
    numbers: dict[str, Any], seed: Dmp, readme: tuple[np.ndarray, np.ndarray]
) -> None:
    t, y = readme
    f = fit_dmp(t, y, **SEED).residuals + seed.forcing(seed.phase(t))
    for k, wanted in numbers["readme_fit"]["ft_dof1_at_index"].items():
        assert f[int(k), 0] == pytest.approx(wanted, abs=1e-9)
    # The ancestor's other method weighs late samples most; it is in no release of ours.
    x = seed.phase(t)
    lever = x * (seed.g - seed.y0)[0]
    w = np.linalg.pinv(seed.kernels(x)) @ (f[:, 0] / lever)
    np.testing.assert_allclose(w, numbers["readme_fit"]["w_leastsquares_dof1"], rtol=1e-8)


@pytest.mark.parametrize("key", ["readme_solve", "readme_new_goal_g=3_dof1"])
def test_motion(numbers: dict[str, Any], seed: Dmp, key: str) -> None:
    wanted = numbers[key]
    t = np.array(wanted["t"])
    fine = np.arange(2501) * 0.004
    if key == "readme_solve":
        run, steps = seed.solve(t, rtol=1e-12, atol=1e-13), seed.rollout(fine)
        paths = [np.stack([wanted["y_dof1"], wanted["y_dof2"]], axis=1)]
        np.testing.assert_allclose(run.yd[:, 0], wanted["yd_dof1"], atol=1e-9)
        np.testing.assert_allclose(run.x, wanted["x"], atol=1e-12)
    else:
        goal = np.array([3.0, 1.5])
        run, steps = seed.solve(t, g=goal, rtol=1e-12, atol=1e-13), seed.rollout(fine, g=goal)
        path = np.array(wanted["ijspeert_semantics_force_scaled_with_new_goal"])
        paths = [np.stack([path, path / 2], axis=1)]
        np.testing.assert_allclose(steps.y, 1.5 * seed.rollout(fine).y, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(run.y, paths[0], atol=1e-9)
    np.testing.assert_allclose(steps.y[np.round(t / 0.004).astype(int)], paths[0], atol=1e-9)


def test_a_goal_that_leaves_the_forcing_alone_is_that_of_the_ancestor(numbers: dict[str, Any], seed: Dmp) -> None:
    wanted = numbers["readme_new_goal_g=3_dof1"]
    stepper = seed.stepper(goal_forcing="shift")
    stepper.change_goal([3.0, 1.5])
    path = [stepper.state[0][0], *(stepper.step(0.004)[0][0] for _ in range(2500))]
    times = np.round(np.array(wanted["t"]) / 0.004).astype(int)
    np.testing.assert_allclose(
        np.array(path)[times], wanted["seed_semantics_force_scaled_with_training_goal"], atol=1e-9
    )


def test_the_ancestors_own_test(numbers: dict[str, Any]) -> None:
    wanted = numbers["seed_runtests_canonical"]
    first = np.concatenate([np.linspace(0, 1, 100), np.ones(10)])
    t, y = np.linspace(0, 110, 110), np.stack([first, first / 2], axis=1)
    dmp = fit_dmp(t, y, **{**SEED, "n_basis": 20}).value
    np.testing.assert_allclose(dmp.weights[:, 0] / (dmp.g - dmp.y0)[0], wanted["w_dof1"], rtol=1e-10)
    run = dmp.solve(t, rtol=1e-12, atol=1e-13)
    assert abs(run.y - y).sum() == pytest.approx(wanted["sum_abs_y"], abs=1e-6)
    assert abs(run.yd - np.gradient(y, t[1], axis=0)).sum() == pytest.approx(wanted["sum_abs_yd"], abs=1e-6)


def test_weights_of_the_authors_simulation(numbers: dict[str, Any]) -> None:
    """Their differences are forward and their phase is by Euler, so that only the kernels and the rule are ours."""
    wanted = numbers["ifac2017_simulation"]
    y = np.maximum(0.0, -np.sin(2 * np.pi * np.linspace(0, 10, 2500)[:1000] / 2.5))
    y = np.concatenate([y, np.full(50, y[-1])])
    dt, T = 1 / 250, 4.2
    yd = np.append(np.diff(y) / dt, 0.0)
    ydd = np.append(np.diff(yd) / dt, 0.0)
    dmp = fit_dmp(np.arange(1051) * dt, np.zeros((1051, 1)), n_basis=15, method="lwr", raw_kernels=True).value
    np.testing.assert_allclose(dmp.centres, wanted["centers"], rtol=1e-12)
    np.testing.assert_allclose(1 / dmp.widths**2, wanted["precision"], rtol=1e-12)
    tau, g = T / 3, y[-1]
    f = tau**2 * ydd - 25 * (25 / 4 * (g - y) - tau * yd)
    x = np.cumprod(np.append(1.0, np.full(len(y) - 1, 1 - dt / tau)))
    bell = np.exp(-0.5 * ((x[:, None] - dmp.centres) / dmp.widths) ** 2)
    xi = x * (g - y[0])
    w = (bell * (xi * f)[:, None]).sum(0) / (bell * (xi * xi)[:, None]).sum(0)
    np.testing.assert_allclose(w, wanted["w"], rtol=1e-10)


def _ancestor(t: np.ndarray, y: np.ndarray, n: int, width: float, phase: np.ndarray, lever: np.ndarray) -> Any:
    """The ancestor's equations for the phases that its fit refuses: weights and kernels."""
    h = t[1]
    yd = np.gradient(y) / h
    tau, g = t[-1] / 3, y[-1]
    f = tau**2 * (np.gradient(yd) / h) - 25 * (25 / 4 * (g - y) - tau * yd)
    centres = np.linspace(phase.min(), phase.max(), n)
    psi = np.exp(-((phase[:, None] - centres) ** 2) / (2 * width))
    psi /= psi.sum(axis=1, keepdims=True)
    return (psi * (lever * f)[:, None]).sum(0) / (psi * (lever**2)[:, None]).sum(0), centres


def test_time_and_position_phases_of_the_ancestor_are_bad(
    numbers: dict[str, Any], readme: tuple[np.ndarray, np.ndarray]
) -> None:
    from scipy.integrate import solve_ivp

    wanted = numbers["other_scheduling_with_seed_equations"]
    (t, y), n = readme, 15
    y = y[:, 0]
    tau = t[-1] / 3
    width = wanted["time_sigma"] ** 2
    w, centres = _ancestor(t, y, n, width, t, t * (y[-1] - y[0]))
    np.testing.assert_allclose(w, wanted["time_w_dof1"], rtol=1e-8)

    def motion(force: Any) -> float:
        def slope(s: float, state: np.ndarray) -> list[float]:
            return [state[1] / tau, (25 * (25 / 4 * (y[-1] - state[0]) - state[1]) + force(s, state[0])) / tau]

        run = solve_ivp(slope, (0, t[-1]), [y[0], 0.0], "DOP853", t, rtol=1e-9, atol=1e-11)
        return float(np.sqrt(((run.y[0] - y) ** 2).mean()))

    def late(s: float, _: float) -> float:
        psi = np.exp(-((s - centres) ** 2) / (2 * width))
        return float(psi @ w / psi.sum() * s * (y[-1] - y[0]))

    assert motion(late) == pytest.approx(wanted["time_rmse_dof1"], abs=1e-5)

    phase = y[-1] - y
    w, centres = _ancestor(t, y, n, np.ptp(phase) * (0.5 / n) ** 2, phase, phase * (y[-1] - y[0]))
    np.testing.assert_allclose(w, wanted["position_w_dof1"], rtol=1e-8)
    width = np.ptp(phase) * (0.5 / n) ** 2

    def near(_: float, now: float) -> float:
        psi = np.exp(-((y[-1] - now - centres) ** 2) / (2 * width))
        return float(psi @ w / psi.sum() * (y[-1] - now) * (y[-1] - y[0]))

    assert motion(near) == pytest.approx(wanted["position_rmse_dof1"], abs=1e-5)
