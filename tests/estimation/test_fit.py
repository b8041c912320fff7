"""Fit: a value with its covariance, frozen, with a report and a file."""

from __future__ import annotations

import copy
import pickle
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models
from armlab.estimation import Excitation, Fit


@dataclass(frozen=True, eq=False)
class Pair:
    values: np.ndarray


models.register("test_pair", Pair)


def fit(cov: np.ndarray, outliers: np.ndarray | None = None) -> Fit[Pair]:
    excitation = Excitation(2, 2, np.array([2.0, 1.0]), "b", held=("c",))
    return Fit(
        value=Pair(np.array([1.0, 2.0])),
        names=("a", "b"),
        units=("m", "N"),
        parameters=np.array([1.0, 2.0]),
        cov=cov,
        sigma=np.array([0.5]),
        residuals=np.zeros((5, 1)),
        n=5,
        excitation=excitation,
        outliers=np.zeros(0) if outliers is None else outliers,
        classes=("position [m]",),
    )


def test_fit_is_frozen_and_reports_value_deviation_and_unit() -> None:
    result = fit(np.diag([0.04, 0.09]), np.array([False, True, False, True, False]))
    np.testing.assert_allclose(result.sd, [0.2, 0.3])
    for part in ("+- 0.2 m", "+- 0.3 N", "5 samples", "noise of position [m]: 0.5", "2 outliers left out: 1, 3"):
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
    after = Fit.load(before.save(tmp_path / "pair.toml"), kind="test_pair")
    for name in ("parameters", "cov", "sigma", "outliers"):
        assert getattr(after, name).tobytes() == getattr(before, name).tobytes(), name
    assert after.value.values.tobytes() == before.value.values.tobytes()
    assert (after.names, after.units, after.classes, after.n) == (before.names, before.units, before.classes, before.n)
    assert after.excitation.text() == before.excitation.text()
    assert after.residuals.size == 0


def test_a_fit_goes_to_other_processes() -> None:
    made = fit(np.eye(2))
    lazy = replace(
        made,
        cov=lambda: np.eye(2),  # type: ignore[arg-type]
        residuals=lambda: np.arange(5.0),  # type: ignore[arg-type]
        excitation=lambda: made.excitation,  # type: ignore[arg-type]
        summary=lambda it: f"{it.n} samples, told",
    )
    for again in (pickle.loads(pickle.dumps(lazy)), copy.deepcopy(lazy)):
        np.testing.assert_array_equal(again.cov, np.eye(2))
        np.testing.assert_array_equal(again.residuals, np.arange(5.0))
        assert not any(part.flags.writeable for part in (again.cov, again.residuals, again.sigma))
        assert again.report() == f"{made.n} samples, told"
        assert again.excitation.text() == made.excitation.text()


def test_a_saved_fit_names_its_sources(tmp_path) -> None:
    path = fit(np.eye(2)).save(tmp_path / "a.toml", ("run.csv sha256 00",))
    assert tomllib.loads(path.read_text(encoding="utf-8"))["meta"]["sources"] == ["run.csv sha256 00"]
