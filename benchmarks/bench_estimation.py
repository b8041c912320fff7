"""Streaming least squares for a million samples of a 7-joint arm, compared with normal equations and LAPACK on whole
blocks.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from blocks import Contender, Table, agree, once, table

from armlab.estimation import Rows, least_squares
from armlab.estimation.tsqr import factorise

JOINTS, SHARED, OWN = 7, 45, 7  # joints; base parameters shared by the joints; friction parameters per joint
SIZE = SHARED + JOINTS * OWN
PIECE, BLOCK = 4096, 1000  # samples generated at once; samples per time block
BAR = 0.75  # relative to LAPACK on whole blocks


def run(quick: bool) -> list[Table]:
    """Measure the factorisation of all rows in one pass, without weighting and robust fitting."""
    samples = 50_000 if quick else 1_000_000
    names = [f"p{i}" for i in range(SIZE)]
    few = list(_rows(20_000))
    found = least_squares(few, names, method="ols")
    worst = agree("solution", found.x, _normal_equations(few), 1e-9)
    scale = 1_000_000 / samples
    contenders = [
        Contender("armlab estimation.factorise", once(lambda: factorise(_rows(samples), SIZE), scale), "armlab"),
        Contender("numpy.linalg.qr of each joint and block", once(lambda: _blocked(samples), scale), bar=BAR,
                  note="the same R"),
        Contender("normal equations", once(lambda: _normal_equations(_rows(samples)), scale), "limit",
                  note="squares the condition number"),
    ]  # fmt: skip
    text = (
        f"1e6 samples of {JOINTS} joints; {SHARED} shared columns and {OWN} per joint, {SIZE} in total; 1000 "
        f"time blocks. Rows are generated on the fly from one segment of {PIECE} samples. Solutions agree to "
        f"{worst:.1g}."
    )
    return [table("Least squares", text, "s", contenders, 2 if quick else 3)]


_RNG = np.random.default_rng(0)
_A, _Y = _RNG.standard_normal((PIECE, SHARED + OWN)), _RNG.standard_normal((PIECE, JOINTS))
_COLUMNS = [np.r_[0:SHARED, SHARED + OWN * i : SHARED + OWN * (i + 1)] for i in range(JOINTS)]


def _rows(samples: int) -> Iterator[Rows]:
    for start in range(0, samples, PIECE):
        m = min(PIECE, samples - start)
        block = np.arange(start, start + m) // BLOCK
        for i in range(JOINTS):
            yield Rows(_A[:m], _Y[:m, i], block, i, _COLUMNS[i])


def _blocked(samples: int) -> list[np.ndarray]:
    return [
        np.linalg.qr(np.column_stack([rows.A[a : a + BLOCK], rows.y[a : a + BLOCK]]), mode="r")
        for rows in _rows(samples)
        for a in range(0, len(rows.y), BLOCK)
    ]


def _normal_equations(pieces) -> np.ndarray:
    gram, moment = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    for rows in pieces:
        gram[np.ix_(rows.columns, rows.columns)] += rows.A.T @ rows.A
        moment[rows.columns] += rows.A.T @ rows.y
    return np.linalg.solve(gram, moment)
