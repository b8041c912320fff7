"""Fit and excitation: value, covariance, report and file; errors that name unobservable directions."""

from __future__ import annotations

import copy
import pickle
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models
from armlab.errors import NotExcited
from armlab.estimation import Excitation, Fit, Prior
from armlab.estimation.linear_problem import check_excitation, check_spread


@dataclass(frozen=True, eq=False)
class Pair:
    values: np.ndarray


models.register("test_pair", Pair)


def fit(cov: np.ndarray, outliers: np.ndarray | None = None) -> Fit[Pair]:
    excitation = Excitation(2, 2, np.array([2.0, 1.0]), "b", held=("c",))
    x, out = np.array([1.0, 2.0]), np.zeros(0) if outliers is None else outliers
    return Fit(
        Pair(x), ("a", "b"), ("m", "N"), x, cov, np.array([0.5]), np.zeros((5, 1)), 5, excitation, outliers=out,
        classes=("position [m]",),
    )  # fmt: skip


def test_fit_is_frozen_and_reports_value_deviation_and_unit() -> None:
    result = fit(np.diag([0.04, 0.09]), np.array([False, True, False, True, False]))
    np.testing.assert_allclose(result.sd, [0.2, 0.3])
    for part in ("+- 0.2 m", "+- 0.3 N", "5 samples", "noise of position [m]: 0.5", "2 outliers excluded: 1, 3"):
        assert part in result.report()
    with pytest.raises(ValueError, match="read-only"):
        result.cov[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        result.outliers[0] = True


def test_rank_of_a_covariance_with_a_direction_that_nothing_tells() -> None:
    assert fit(np.diag([1e-12, 1e6])).rank == 2
    assert fit(np.array([[1.0, -2.0], [-2.0, 4.0]])).rank == 1
    assert fit(np.zeros((2, 2))).rank == 0


def test_a_saved_fit_comes_back_bit_equal(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((2, 2))
    before = fit(root @ root.T, np.array([True, False, False, False, False]))
    path = before.save(tmp_path / "pair.toml", ("run.csv sha256 00",))
    assert tomllib.loads(path.read_text(encoding="utf-8"))["meta"]["sources"] == ["run.csv sha256 00"]
    after = Fit.load(path, kind="test_pair")
    for name in ("parameters", "cov", "sigma", "outliers"):
        assert getattr(after, name).tobytes() == getattr(before, name).tobytes(), name
    assert after.value.values.tobytes() == before.value.values.tobytes()
    assert (after.names, after.units, after.classes, after.n) == (before.names, before.units, before.classes, before.n)
    assert after.excitation.text() == before.excitation.text()
    assert after.residuals.size == 0


def test_a_fit_goes_to_other_processes() -> None:
    made = fit(np.eye(2))
    told = replace(made, residuals=np.arange(5.0), summary=lambda it: f"{it.n} samples, told")
    for again in (pickle.loads(pickle.dumps(told)), copy.deepcopy(told)):
        np.testing.assert_array_equal(again.cov, np.eye(2))
        np.testing.assert_array_equal(again.residuals, np.arange(5.0))
        assert not any(part.flags.writeable for part in (again.cov, again.residuals, again.sigma))
        assert again.report() == f"{made.n} samples, told"
        assert again.excitation.text() == made.excitation.text()


NAMES = ("mass", "offset", "viscous")


def design(scale: np.ndarray | float = 1.0) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((100, 3)) * scale


def test_check_excitation_is_free_of_units() -> None:
    plain, scaled = (check_excitation(design(units), NAMES, "model") for units in (1.0, [1e6, 1.0, 1e-9]))
    assert isinstance(plain, Excitation)
    np.testing.assert_allclose(plain.singular_values, scaled.singular_values, rtol=1e-6)
    assert plain.rank == plain.expected == 3
    assert plain.condition < 2
    assert "good" in plain.text()


def test_a_prior_holds_what_would_be_refused_and_says_so() -> None:
    A = design([1.0, 0.0, 1.0])
    with pytest.raises(NotExcited, match="the data do not excite: offset") as caught:
        check_excitation(A, NAMES, "model")
    assert caught.value.directions == ("offset",)
    found = check_excitation(A, NAMES, "model", Prior(np.zeros(3), np.ones(3)))
    assert found.held == ("offset",)
    assert found.text().endswith("held by the prior: offset")


LIMITS = np.array([0.3, 0.2, 0.05])
UNITS = ("kg", "rad", "m")


def test_check_spread_judges_the_deviation_and_not_the_rank() -> None:
    J = np.diag([100.0, 100.0, 100.0])
    good = check_spread(J, NAMES, UNITS, LIMITS, "model")
    assert (good.rank, good.expected, good.held, good.null_names) == (3, 3, (), ())
    np.testing.assert_allclose(good.spread, 0.01 / LIMITS)
    assert good.weakest == "viscous (0.01 m)"
    assert "good" in good.text()
    J[2, 2] = 10.0  # full rank, but a standard deviation of 0.1 m
    with pytest.raises(NotExcited, match=r"exceed their limits along: viscous \(0.1 m\)") as caught:
        check_spread(J, NAMES, UNITS, LIMITS, "model")
    assert caught.value.spread == ("2 times the limit",)


def test_unseen_directions_are_refused_by_name() -> None:
    J = np.array([[100.0, 0.0, 0.0], [0.0, 100.0, 100.0]]) / LIMITS
    with pytest.raises(NotExcited, match=r"offset and viscous|viscous and offset") as caught:
        check_spread(J, NAMES, UNITS, LIMITS, "model")
    assert caught.value.spread == ("unobservable",)
    held = Excitation(2, 3, np.ones(3), "b", held=("c",), null_names=("gauge: d",), spread=np.array([0.1, 0.2, 2.0]))
    assert "excitation weak: record a longer or richer motion: rank 2 of 3" in held.text()
    assert "not observable: gauge: d\nheld by the prior: c" in held.text()


def test_an_estimate_without_a_design_matrix_tells_the_same_by_its_covariance() -> None:
    A, names = np.random.default_rng(0).standard_normal((40, 3)) * [1.0, 1e3, 1e-3], ("a", "b", "c")
    found = Excitation.of_covariance(np.linalg.inv(A.T @ A), names)
    expected = Excitation.of(A, names)
    np.testing.assert_allclose(found.singular_values, expected.singular_values, rtol=1e-6)
    assert (found.rank, found.weakest) == (3, expected.weakest)
    nothing = Excitation.of_covariance(np.zeros((0, 0)), ())
    assert nothing.condition == 1.0
    assert "rank 0 of 0" in nothing.text()
