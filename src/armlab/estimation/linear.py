"""Linear least squares for any number of rows: one verb, four methods."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from armlab.errors import ShapeError, UnknownName
from armlab.estimation.excitation import MAX_CONDITION, Prior
from armlab.estimation.factors import Rows, factorise
from armlab.estimation.robust import huber, trimmed
from armlab.estimation.solution import LinearSolution, Question, solve

__all__ = ["METHODS", "least_squares"]

METHODS = ("ols", "wls", "irls", "lts")


def least_squares(
    rows: Iterable[Rows],
    names: Sequence[str],
    *,
    what: str = "model",
    method: str = "wls",
    lower: np.ndarray | None = None,
    upper: np.ndarray | None = None,
    prior: Prior | None = None,
    max_condition: float = MAX_CONDITION,
    seed: int = 0,
) -> LinearSolution:
    """Minimise ``sum_i w_i ||A_i x - y_i||^2`` over classes i of measurement by streaming QR.

    Parameters
    ----------
    rows : of all classes, block by block; may be made on the fly. Memory is O(p^2) per block of time and class.
    names : of the p parameters.
    what : what is fitted, for messages.
    method : "ols": w = 1. "wls": w = 1 / sd^2 of the residuals of each class, found in rounds. "irls": the same with
        Huber's loss; reads the rows once per round. "lts": wls on the blocks of time that agree.
    lower, upper : (p,) bounds; the result says which hold and how much the residual grows by them.
    prior : when given, directions that the data do not tell keep its values and are listed in `excitation.held`.
    max_condition : of the column-scaled, weighted regressor.
    seed : of the random starts of "lts".

    Raises
    ------
    ShapeError : rows or bounds do not fit together or are not finite. UnknownName : another method.
    NotExcited : fewer rows than parameters, or directions that the data do not tell, by name.

    References
    ----------
    Golub and Van Loan (2013), Matrix Computations, chapters 5 and 6. Derivations: docs/theory/estimation.md.
    """
    if method not in METHODS:
        raise UnknownName.among("method of least squares", method, METHODS)
    if method == "irls" and iter(rows) is rows:
        raise ShapeError("Expected rows that can be read again in every round, got a generator. Give a list of Rows.")
    question = Question.of(names, what, lower, upper, prior, max_condition)
    factors = factorise(rows, len(names))
    found = solve(question, factors, np.ones(len(factors.columns)) if method == "ols" else None)
    if method == "irls":
        return huber(rows, found)
    return trimmed(found, seed) if method == "lts" else found
