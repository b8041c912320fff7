"""Accelerometers are force sensors of one kilogram that read the reaction."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.calibrate import fit_accelerometer
from armlab.calibrate.gravity_load.model import Load, WeightEquation
from armlab.errors import NotConverged, NotExcited, ShapeError
from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.lie import se3, so3

G = np.array([0.0, 0.0, -9.80665])
SIGMA = 0.02


def draw(weights, seed: Any, N: int = 50, sigma: float = SIGMA, scale: float = 1.0):
    """Generator F6."""
    rng = np.random.default_rng(seed)
    R, b = weights.rotations(rng, 1)[0], 0.2 * rng.standard_normal(3)
    RA = weights.rotations(rng, N)
    return RA, -scale * (G @ RA @ R) + b + sigma * rng.standard_normal((N, 3)), {"R": R, "bias": b, "scale": scale}


def error(fit: Fit[Any], truth: dict[str, Any]) -> np.ndarray:
    parts = [so3.log(truth["R"].T @ fit.value.R_tool_sensor)]
    parts += [[fit.value.scale - truth["scale"]]] if "scale" in fit.names else []
    return np.concatenate([*parts, fit.value.bias - truth["bias"]])


@pytest.mark.parametrize("scale", [False, True])
def test_exact_data_give_the_exact_answer(weights, scale) -> None:
    RA, acc, truth = draw(weights, 0, sigma=0.0, scale=1.1 if scale else 1.0)
    poses = se3.from_rp(RA, np.ones((50, 3)))
    fit = fit_accelerometer(poses, acc, scale=scale)
    np.testing.assert_allclose(error(fit, truth), 0.0, atol=1e-12)
    assert ("scale" in fit.names) is scale
    assert fit.value.scale == pytest.approx(truth["scale"], abs=1e-12)
    np.testing.assert_allclose(fit.value.acceleration(acc, poses), 0.0, atol=1e-10)


def experiment_of(weights, scale: bool):
    def experiment(seed: int, n: int) -> Experiment:
        RA, acc, truth = draw(weights, [3500, seed], n)
        equation = WeightEquation(RA, acc, -G, True, None if scale else 1.0, np.full(3, SIGMA**2), ("a",) * 3, "")
        (at,) = equation.evaluate(Load(truth["R"], -G, truth["bias"], np.zeros(3)))
        J = at.J.reshape(-1, at.J.shape[2]) / SIGMA
        data = {"T_base_tool": RA, "acc": acc, "noise": SIGMA, "gravity": G}
        return Experiment(data | ({"scale": True} if scale else {}), truth, np.linalg.inv(J.T @ J))

    return experiment


def contract(weights, runs: int, scale: bool):
    def spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
        bad = np.zeros(len(data["acc"]), dtype=bool)
        bad[rng.choice(len(bad), max(len(bad) // 20, 1), replace=False)] = True
        acc = data["acc"].copy()
        acc[bad] += 3.0 * weights.rotations(rng, int(bad.sum()))[:, 0]
        return {**data, "acc": acc, "robust": True}, bad

    S = so3.exp([0.3, -1.0, 0.5])

    def same(fit: Fit[Any], **changed: np.ndarray) -> dict[str, Any]:
        value = fit.value
        return {"R": value.R_tool_sensor, "bias": value.bias, "scale": value.scale, **changed}

    gauges = [
        Gauge("base turned", lambda d: {**d, "T_base_tool": S @ d["T_base_tool"], "gravity": S @ d["gravity"]}, same),
        Gauge("tool turned", lambda d: {**d, "T_base_tool": d["T_base_tool"] @ S},
              lambda f: same(f, R=S.T @ f.value.R_tool_sensor)),
    ]  # fmt: skip
    upright = so3.exp(np.linspace(0.0, 3.0, 20)[:, None] * [0.0, 0.0, 1.0])
    refusals = {"about the vertical only": {"T_base_tool": upright, "acc": -(G @ upright)}}
    return check_estimator(
        fit_accelerometer, experiment_of(weights, scale), runs, n=50, error=error, gauges=gauges, refusals=refusals,
        spoil=spoil,
    )  # fmt: skip


def test_the_statistical_contract_in_short(weights) -> None:
    found = contract(weights, 20, True)
    assert found.passed, found.text()


@pytest.mark.slow  # 4 s
@pytest.mark.parametrize("scale", [False, True])
def test_the_statistical_contract(weights, scale) -> None:
    found = contract(weights, 200, scale)
    assert found.passed, found.text()


def test_refusals(weights) -> None:
    RA, acc, _ = draw(weights, 1)
    with pytest.raises(NotConverged, match="mirrored") as caught:
        fit_accelerometer(RA, -acc)
    assert caught.value.reason == "left_handed"
    with pytest.raises(NotExcited, match="at least 3 samples"):
        fit_accelerometer(RA[:2], acc[:2])
    with pytest.raises(ShapeError, match=r"readings of shape \(50, 3\)"):
        fit_accelerometer(RA, acc[:, :2])
    with pytest.raises(ShapeError, match="NaN or Inf in 1 rows: 4"):
        fit_accelerometer(RA, np.where(np.arange(50)[:, None] == 4, np.nan, acc))
