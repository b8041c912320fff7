"""Refusals of the package: an input, its error, and words that the sentence must have."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import models
from armlab.errors import ConfigError, ModelMismatchError, NotExcited, ShapeError, UnknownName
from armlab.estimation import Excitation, Fit, Prior, Rows, block_bootstrap, block_cv, least_squares
from armlab.estimation.linear_problem import LinearProblem, check_spread
from armlab.estimation.nonlinear import Measurement
from armlab.estimation.robust import BlockSums, block_seconds, correlation_time, effective_samples
from armlab.estimation.tsqr import factorise

RNG = np.random.default_rng(0)
A, Y = RNG.standard_normal((60, 3)), RNG.standard_normal(60)
NAMES = ("mass", "offset", "viscous")
ONE, TWO = np.ones((3, 2)), np.ones((3, 2, 2))
COV = np.array([[4.0, 1.0], [1.0, 9.0]])


def rows(A: np.ndarray = A, y: np.ndarray = Y, block: Any = None) -> list[Rows]:
    return [Rows(A, y, np.zeros(len(y), dtype=int) if block is None else np.asarray(block))]


def fit(x: Any = (), names: tuple[str, ...] = NAMES, **options: Any) -> Any:
    return least_squares(x or rows(), names, **options)


def sums(blocks: int) -> BlockSums:
    return BlockSums.of(fit(rows(block=np.arange(60) * blocks // 60), method="ols"))


def made(cov: np.ndarray, value: Any = 1.0) -> Fit[Any]:
    excitation = Excitation(2, 2, np.ones(2), "a")
    return Fit(value, ("a", "b"), ("m", "m"), np.ones(2), cov, np.ones(1), np.zeros(3), 3, excitation)


def with_nan(x: np.ndarray, *at: Any) -> np.ndarray:
    x = x.copy()
    x[at] = np.nan
    return x


CASES: list[tuple[type[Exception], str, Callable[[], Any]]] = [
    (UnknownName, "method of least squares, got 'lasso'", lambda: fit(method="lasso")),
    (ShapeError, "got a generator", lambda: fit(iter(rows()), method="irls")),
    (ShapeError, "3 lower bounds below the 3 corresponding upper bounds", lambda: fit(lower=np.zeros(2))),
    (ShapeError, "lower bounds below", lambda: fit(lower=np.ones(3), upper=np.zeros(3))),
    (ShapeError, "2 lower bounds below the 2 corresponding upper bounds",
     lambda: LinearProblem.of(["a", "b"], "x", np.ones(2), np.ones(2))),
    (ShapeError, "a prior of 3 finite values", lambda: fit(prior=Prior(np.zeros(3), np.zeros(3)))),
    (ShapeError, "a prior of 3 finite values", lambda: fit(prior=Prior(np.zeros(2), np.ones(2)))),
    (NotExcited, "more than 3 rows for the model, got 3", lambda: fit(rows(A[:3], Y[:3]))),
    (ShapeError, "at least 8 segments of 1 blocks, got 7", lambda: block_bootstrap(sums(7))),
    (ShapeError, "at least 2 draws for a covariance, got 1", lambda: block_bootstrap(sums(10), 1)),
    (ShapeError, "2 to 7 folds", lambda: block_cv(sums(7), folds=8)),
    (UnknownName, "mode of cross-validation, got 'random'", lambda: block_cv(sums(7), mode="random")),
    (ShapeError, r"\(0,\)", lambda: effective_samples(np.zeros(0))),
    (ShapeError, r"\(1,\)", lambda: correlation_time(np.zeros(1), 0.1)),
    (ShapeError, "1 NaN", lambda: block_seconds(np.array([[1.0], [np.nan], [2.0]]), 1.0)),
    (ShapeError, "got an empty sequence", lambda: factorise([], 3)),
    (ShapeError, r"got \(3, 2\), \(2,\)", lambda: factorise(rows(ONE, np.ones(2)), 3)),
    (ShapeError, "Sort the samples by time", lambda: factorise(rows(ONE, np.ones(3), [1, 0, 0]), 3)),
    (ShapeError, "2 different columns from 0 to 2", lambda: factorise(rows(ONE, np.ones(3)), 3)),
    (ShapeError, "from 0 to 2", lambda: factorise([Rows(ONE, np.ones(3), np.zeros(3, int), 0, np.array([0, 3]))], 3)),
    (ShapeError, "Name each column exactly once",
     lambda: factorise([Rows(ONE, np.ones(3), np.zeros(3, int), 0, np.ones(2, int))], 3)),
    (ShapeError, "same columns in all rows",
     lambda: factorise([Rows(ONE, np.ones(3), np.zeros(3, int), 0, np.array(c)) for c in ([0, 1], [0, 2])], 3)),
    (ShapeError, r"NaN or Inf in 1 rows of class 0, first \[40\]", lambda: factorise(rows(with_nan(A, 40, 2)), 3)),
    (ShapeError, r"2 rows of class 0, first \[3, 5\]", lambda: factorise(rows(A, with_nan(Y, [3, 5])), 3)),
    (ShapeError, r"Expected A \(N, k, p\)", lambda: list(Rows.of(A, Y[:, None], np.zeros(60, int)))),
    (ShapeError, "design matrix with 3 columns", lambda: Excitation.of(np.ones((5, 2)), NAMES)),
    (ShapeError, "finite", lambda: Excitation.of(np.full((5, 3), np.nan), NAMES)),
    (ShapeError, "3 limits above zero", lambda: check_spread(np.eye(3), NAMES, NAMES, np.zeros(3), "model")),
    (ShapeError, "bug in the residual function", lambda: Measurement(ONE, np.ones((3, 1, 2)), COV, ("t", "R"))),
    (ShapeError, "got", lambda: Measurement(ONE, TWO, COV, ("t",))),
    (ShapeError, "positive definite", lambda: Measurement(ONE, TWO, np.zeros((2, 2)), ("t", "R")).roots({})),
    (ShapeError, "in addition to estimated noise", lambda: Measurement(ONE, TWO, COV, ("t", "R"), added=COV)),
    (ShapeError, "Pass its covariance", lambda: Measurement(ONE, TWO, None, ("p", "q"), prior=True)),
    (ShapeError, r"cov of shape \(2, 2\)", lambda: made(np.eye(3))),
    (ShapeError, "finite covariance", lambda: made(np.diag([1.0, np.nan]))),
    (ShapeError, "non-negative diagonal", lambda: made(np.diag([1.0, -1.0]))),
    (ConfigError, "float", lambda: made(np.eye(2)).save("none.toml")),
]  # fmt: skip


@pytest.mark.parametrize(("error", "words", "call"), CASES, ids=[words for _, words, _ in CASES])
def test_refused(error: type[Exception], words: str, call: Callable[[], Any]) -> None:
    with pytest.raises(error, match=words):
        call()


def test_files_of_another_kind_or_without_a_fit(tmp_path: Path) -> None:
    value = models.velocity_covariance("const", np.ones(2), np.ones(2))
    path = made(np.eye(2), value).save(tmp_path / "fit.toml")
    with pytest.raises(ModelMismatchError, match="kind 'hand_eye'"):
        Fit.load(path, kind="hand_eye")
    with pytest.raises(ConfigError, match="saved without"):
        Fit.load(models.save(value, tmp_path / "bare.toml"))
