"""The statistical contract is itself tested: a good fit passes, and every fault is caught by the property it breaks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from armlab import models
from armlab.errors import ConfigError, NotExcited, ShapeError, UnknownName
from armlab.estimation import Contract, ContractLimits, Excitation, Experiment, Fit, Gauge, check_estimator
from armlab.estimation.contract import PROPERTIES

TRUTH = np.array([2.0, -1.0, 0.5])
NAMES = ("slope", "bend", "offset")
UNITS = ("N/m", "N/m^2", "N")
NOISE = 0.1
FEW = 20  # runs, although one would show the fault


@dataclass(frozen=True, eq=False)
class Curve:
    coefficients: np.ndarray


models.register("test_curve", Curve)


def columns(x: np.ndarray) -> np.ndarray:
    return np.stack([x, x * x, np.ones_like(x)], axis=1)


def experiment(seed: int, n: int) -> Experiment:
    rng = np.random.default_rng([7, seed])
    x = rng.uniform(-1, 1, n)
    A = columns(x)
    y = A @ TRUTH + NOISE * rng.standard_normal(n)
    return Experiment({"x": x, "y": y, "noise": NOISE}, TRUTH, NOISE**2 * np.linalg.inv(A.T @ A))


def fit_curve(x: np.ndarray, y: np.ndarray, noise: float, robust: bool = False) -> Fit[Curve]:
    """A correct fit: y = slope x + bend x^2 + offset."""
    bad = np.flatnonzero(~np.isfinite(x) | ~np.isfinite(y))
    if len(bad):
        raise ShapeError(f"Expected finite samples, got NaN in rows {bad.tolist()}. Drop them.")
    A = columns(x)
    excitation = Excitation.of(A, NAMES)
    if excitation.rank < 3:
        raise NotExcited("Expected several x, got too few. Measure more.", ["bend"], ["0"])
    outliers = np.zeros(len(x), dtype=bool)
    if robust:
        p = np.linalg.lstsq(A, y, rcond=None)[0]
        for limit in (50.0, 20.0, 6.0, 4.0, 4.0):
            outliers = np.abs(y - A @ p) > limit * noise
            p = np.linalg.lstsq(A[~outliers], y[~outliers], rcond=None)[0]
    kept = ~outliers
    p = np.linalg.lstsq(A[kept], y[kept], rcond=None)[0]
    p.flags.writeable = False
    cov = noise**2 * np.linalg.inv(A[kept].T @ A[kept])
    return Fit(Curve(p), NAMES, UNITS, p, cov, np.array([noise]), (y - A @ p)[:, None], len(x), excitation,
               outliers=outliers)  # fmt: skip


def spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
    bad = np.zeros(len(data["y"]), dtype=bool)
    bad[rng.choice(len(bad), len(bad) // 20, replace=False)] = True
    return {**data, "y": data["y"] + 5.0 * bad, "robust": True}, bad


def check(fit: Callable[..., Fit[Any]], runs: int = 200, **options: Any) -> Contract:
    given = {
        "n": 60,
        "gauges": [Gauge("x in mm", lambda d: {**d, "x": 1e3 * d["x"]}, lambda f: f.parameters / [1e3, 1e6, 1.0])],
        "refusals": {"bend": {"x": np.repeat([0.0, 1.0], 30), "y": np.zeros(60), "noise": NOISE}},
        "spoil": spoil,
    }
    return check_estimator(fit, experiment, runs, **{**given, **options})


def changed(**changes: Callable[[Fit[Any]], Any]) -> Callable[..., Fit[Any]]:
    def fit(x: np.ndarray, y: np.ndarray, noise: float, robust: bool = False) -> Fit[Any]:
        good = fit_curve(x, y, noise, robust)
        return replace(good, **{name: change(good) for name, change in changes.items()})

    return fit


def test_a_correct_fit_has_all_ten_properties() -> None:
    found = check(fit_curve, 100)
    assert found.passed, found.text()
    assert found.failed == ()
    assert [one.name for one in found.properties] == list(PROPERTIES)
    assert found["efficient"].passed is None  # judged from 1000 runs on
    assert "100 runs" in found.text()


def test_the_benchmark_has_narrower_limits() -> None:
    found = check(fit_curve, 1000, skip=dict.fromkeys(("gauge-free", "robust", "consistent"), "tested above"))
    assert found.passed, found.text()
    assert found["efficient"].passed is True
    assert ContractLimits.of(2000, True).honest == (0.95, 1.05)
    assert ContractLimits.of(2000, False).honest == (0.95, 1.10)
    assert ContractLimits.of(200, True) == ContractLimits()


def trusting(x: np.ndarray, y: np.ndarray, noise: float, robust: bool = False) -> Fit[Curve]:
    return fit_curve(x, y, noise)


@pytest.mark.parametrize(("fit", "runs", "failed", "words"), [
    (changed(cov=lambda good: 2.0 * good.cov), 100, {"honest"}, "NEES"),
    (changed(cov=lambda good: 0.5 * good.cov), 100, {"honest"}, "NEES"),
    (changed(parameters=lambda good: good.parameters + 0.05), 100, {"consistent", "gauge-free"}, ""),
    (changed(parameters=lambda good: good.parameters + 1e-6 * good.residuals[0, 0] * good.sd), FEW,
     {"order-free"}, ""),
    (changed(parameters=lambda good: good.parameters + 1e-5 * good.sd[0]), FEW, {"gauge-free"}, ""),
    (changed(value=lambda good: tuple(good.parameters)), FEW, {"saves"}, "raised ConfigError"),
    (changed(summary=lambda good: lambda fit: "slope bend offset: all fine"), FEW, {"explains"}, ""),
    (trusting, 100, {"robust"}, "300 outliers missed"),
])  # fmt: skip
def test_a_fault_fails_its_property(fit: Callable[..., Fit[Any]], runs: int, failed: set[str], words: str) -> None:
    found = check(fit, runs)
    assert failed <= set(found.failed), found.text()
    assert len(failed) > 1 or "gauge-free" in failed or set(found.failed) == failed
    assert words in found.text()


def test_less_than_half_of_the_samples_is_not_efficient() -> None:
    def half(x: np.ndarray, y: np.ndarray, noise: float) -> Fit[Curve]:
        return replace(fit_curve(x[::2], y[::2], noise), n=len(x))

    others = ("consistent", "order-free", "robust", "refuses", "clean")
    assert check(half, 1000, skip=dict.fromkeys(others, "not under test")).failed == ("efficient",)
    assert check(half, 50, skip=dict.fromkeys(others, "not under test")).passed


def test_refusals_need_the_name_of_the_direction() -> None:
    def nameless(x: np.ndarray, y: np.ndarray, noise: float, robust: bool = False) -> Fit[Curve]:
        try:
            return fit_curve(x, y, noise, robust)
        except NotExcited as error:
            raise NotExcited(str(error), ["something"]) from None

    def eager(x: np.ndarray, y: np.ndarray, noise: float, robust: bool = False) -> Fit[Curve]:
        return fit_curve(np.linspace(-1, 1, len(x)) if np.all(y == 0) else x, y, noise, robust)

    found = check(nameless, FEW)
    assert found.failed == ("refuses",)
    assert "reported as something" in found["refuses"].text
    assert "was accepted" in check(eager, FEW)["refuses"].text


def test_hands_must_be_clean() -> None:
    def mutating(x: np.ndarray, y: np.ndarray, noise: float, robust: bool = False) -> Fit[Curve]:
        found = fit_curve(x, y, noise, robust)
        x -= 1e-3
        return found

    def careless(x: np.ndarray, y: np.ndarray, noise: float, robust: bool = False) -> Fit[Curve]:
        kept = np.isfinite(x) & np.isfinite(y)
        return fit_curve(x[kept], y[kept], noise, robust)

    state = np.random.default_rng(0)

    def drifting(good: Fit[Any]) -> np.ndarray:
        return good.cov * (1.0 + 1e-12 * state.random())

    def open_handed(good: Fit[Any]) -> Curve:
        return Curve(np.array(good.value.coefficients))

    for fit, words in (
        (mutating, "input x changed"),
        (careless, "NaN in x accepted"),
        (changed(cov=drifting), "cov is not reproducible"),
        (changed(value=open_handed), "output value.coefficients is writeable"),
    ):
        found = check(fit, FEW)
        assert found.failed == ("clean",), found.text()
        assert words in found["clean"].text


def test_what_a_fit_raises_is_a_finding_and_not_an_exception() -> None:
    def broken(**data: Any) -> Fit[Any]:
        raise ZeroDivisionError("no good")

    found = check(broken, 5)
    assert not found.passed
    assert "raised ZeroDivisionError: no good" in found["honest"].text
    assert set(found.failed) == set(PROPERTIES)


def test_a_property_is_skipped_with_its_reason_or_needs_its_means() -> None:
    found = check_estimator(fit_curve, experiment, 20, n=60, skip={"robust": "no outliers in this data"})
    assert found["robust"].passed is None
    assert "no outliers in this data" in found.text()
    assert found["gauge-free"].passed is False
    assert "pass gauges, or skip" in found["gauge-free"].text
    with pytest.raises(UnknownName, match="Did you mean 'robust'"):
        check(fit_curve, 1, skip={"robus": "x"})
    with pytest.raises(ConfigError, match="a reason for skipping"):
        check(fit_curve, 1, skip={"robust": " "})
    with pytest.raises(UnknownName, match="property"):
        found["speed"]


def test_errors_may_be_those_of_validation_where_the_covariance_has_not_full_rank() -> None:
    """Only the sum of two parameters is identifiable, but the curve is; its covariance has rank three of four."""
    x = np.linspace(-1, 1, 12)
    J = np.column_stack([columns(x), np.ones(12)])

    def doubled(**data: Any) -> Fit[Curve]:
        good = fit_curve(**data)
        split = np.vstack([np.eye(3) * [1, 1, 0.5], [0, 0, 0.5]])
        return replace(good, names=(*NAMES, "bias"), units=(*UNITS, "N"), parameters=split @ good.parameters,
                       cov=split @ good.cov @ split.T)  # fmt: skip

    def error(fit: Fit[Any], truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return J @ fit.parameters - columns(x) @ truth, J @ fit.cov @ J.T

    skip = dict.fromkeys(("efficient", "gauge-free", "robust", "refuses"), "not under test")
    found = check_estimator(doubled, experiment, 100, n=60, error=error, skip=skip)
    assert found.passed, found.text()
    assert "NEES/3" in found["honest"].text
