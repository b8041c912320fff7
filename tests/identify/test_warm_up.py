"""Warm-up without a temperature sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.estimation import Experiment, Fit, check_estimator
from armlab.identify import fit_dynamics, fit_warm_up
from armlab.log import Table
from armlab.models import TorqueModel, WarmUp

RATE = 50.0
OWN = ("viscous", "coulomb_pos", "coulomb_neg", "offset")


def log(model: TorqueModel, minutes: float, seed: int) -> Table:
    """Free motion with speeds that change over minutes, torque from the model itself."""
    t = np.arange(0, 60 * minutes, 1 / RATE)
    rng = np.random.default_rng(seed)
    slow = 0.6 + 0.4 * np.sin(2 * np.pi * t / rng.uniform(300, 500))[:, None]
    phase = np.cumsum(slow * (1.0 + 0.15 * np.arange(7)), axis=0) / RATE
    q = 0.8 * np.sin(phase)
    qd = np.gradient(q, t, axis=0)
    tau = model.torque(q, qd, np.gradient(qd, t, axis=0), np.full(len(t), 1 / RATE))
    return Table(t, {"q": q, "qd": qd, "tau": tau + 0.05 * rng.standard_normal(q.shape)})


@pytest.fixture(scope="module")
def cold(model: TorqueModel) -> TorqueModel:
    """Joints 1 and 2 with viscous friction that counts."""
    viscous = np.array(model.friction.viscous)
    viscous[:2] = 4.0
    return replace(model, friction=replace(model.friction, viscous=viscous))


@pytest.mark.slow  # 20 s
def test_a_warm_up_of_40_minutes_is_found(cold: TorqueModel) -> None:
    """Viscous friction falls by 0.4 with 12 min: time within 25 %, held-out error less than half of that without."""
    warm, still = np.zeros(7), np.ones(7)
    of_viscous, time = warm.copy(), warm.copy()
    of_viscous[:2], time[:2] = -0.4, 720.0
    truth = replace(cold, warm_up=WarmUp(warm, of_viscous, time, 0.5 * still, warm))
    fit = fit_warm_up(log(truth, 40, seed=0), cold)
    found = fit.value.warm_up
    assert found is not None
    assert np.flatnonzero(found.time).tolist() == [0, 1]
    np.testing.assert_allclose(found.time[:2], 720.0, rtol=0.25)
    held_out = log(truth, 40, seed=1)
    qdd = np.gradient(held_out["qd"], held_out.t, axis=0)
    before, after, exact = (
        model.torque(held_out["q"], held_out["qd"], qdd, held_out.dt)[:, :2] for model in (cold, fit.value, truth)
    )
    assert np.sqrt(np.mean((after - exact) ** 2)) < 0.5 * np.sqrt(np.mean((before - exact) ** 2))
    quality = fit.value.quality
    assert np.all(quality.rms_cv[:2] >= quality.rms[:2])
    assert np.all(quality.rms_cv[:2] < 0.5 * np.std(after - before, axis=0)), "without warm-up much more is left"
    np.testing.assert_allclose(quality.coverage, 0.954, atol=0.05)
    assert len(fit.names) == 16
    assert np.all(fit.sd > 0)


SECONDS = 1206.0
CHANGE = np.array([-0.4, -0.2, 400.0, 0.1])  # of viscous and Coulomb friction, time constant, warmth at the start
POWER = 2.0


def difference(fit: Fit[TorqueModel], truth: np.ndarray) -> np.ndarray:
    """Errors of a fit whose warmth is 1 at another power than the truth's."""
    assert fit.value.warm_up is not None
    ratio = POWER / fit.value.warm_up.power[0]
    return fit.parameters - truth * [1, 1, 1, 1, 1 / ratio, 1 / ratio, 1, ratio]


@pytest.mark.slow  # 20 s
def test_the_statistical_contract(short_arm) -> None:
    """One joint of two warms up for 20 minutes; four times the samples are those of four times the rate."""
    cold = fit_dynamics(short_arm.log(0, 3000), short_arm.robot).value
    own = np.array([4.0, 2.0, 2.0, 0.3])
    friction = {name: np.array([value, 0.5 * value]) for name, value in zip(OWN, own)}
    cold = replace(cold, friction=replace(cold.friction, **friction))
    of_coulomb, of_viscous, time, start = (np.array([x, 0.0]) for x in CHANGE[[1, 0, 2, 3]])
    truth = replace(cold, warm_up=WarmUp(of_coulomb, of_viscous, time, np.full(2, POWER), start))
    motions: dict[int, Table] = {}

    def draw(seed: int, n: int) -> Experiment:
        t = np.arange(n) * SECONDS / n
        if n not in motions:
            phase = 0.6 * t - 200 / (2 * np.pi) * np.cos(2 * np.pi * t / 400)  # fast and slow for minutes each
            q = 0.8 * np.sin(phase[:, None] * [1.5, 1.9])
            qd = np.gradient(q, t, axis=0)
            tau = truth.torque(q, qd, np.gradient(qd, t, axis=0), np.full(n, SECONDS / n))
            motions[n] = Table(t, {"q": q, "qd": qd, "tau": tau})
        clean = motions[n]
        tau = clean["tau"] + 0.1 * np.random.default_rng(seed).standard_normal((n, 2))
        return Experiment({"table": clean.with_column("tau", tau), "model": cold}, np.concatenate([own, CHANGE]))

    n = int(40 * SECONDS)
    contract = check_estimator(
        fit_warm_up,
        draw,
        8,
        n=n,
        error=difference,
        noise_given=False,
        refusals={"warm-up": {"table": draw(0, n).data["table"].between(0.0, 600.0), "model": cold}},
        skip={
            "efficient": "residuals of robots are coloured: there is no bound to reach",
            "order-free": "warmth remembers: the rows of a log have an order",
            "gauge-free": "parameters are those of the drives",
            "robust": "fit_dynamics takes care of outliers before",
        },
    )
    assert contract.passed, contract.text()
