"""Triangular factors of a linear problem, computed row by row with O(p^2) memory per time block.

For the rows ``[A y]`` of one measurement class in one time block, only the triangle R of ``[A y] = Q R`` is stored.
This triangle satisfies ``||A x - y|| = ||R [x; -1]||`` for every x. Theory: docs/theory/estimation.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from itertools import pairwise
from threading import Lock
from typing import Any

import numpy as np

from armlab._display import Shown
from armlab.errors import ShapeError

PANEL = 8  # LAPACK block size; fastest for 20 to 100 columns
CHUNK = 1024  # rows per LAPACK call; small enough for the cache


@dataclass(frozen=True, eq=False, repr=False)
class Rows(Shown):
    """Rows of a linear problem for one measurement class, such as a joint or a sensor.

    Attributes
    ----------
    A : (m, w) regressor rows, restricted to the columns of this class.
    y : (m,) measurements.
    block : (m,) index of the time block of each row, in ascending order; residuals within a block may be correlated.
    group : index of the class, counted from 0; each class has one weight.
    columns : (w,) parameter indices of the columns; default: all.
    """

    A: np.ndarray
    y: np.ndarray
    block: np.ndarray
    group: int = 0
    columns: np.ndarray | None = None

    @staticmethod
    def of(A: np.ndarray, y: np.ndarray, block: np.ndarray) -> Iterator[Rows]:
        """Yield one `Rows` for each of the k measurements per sample, with measurement i as class i.

        Parameters
        ----------
        A : (N, k, p) regressor of N samples with k rows each. Columns that are zero for a class are omitted.
        y : (N, k) measurements.
        block : (N,) index of the time block of each sample, in ascending order.
        """
        if A.ndim != 3 or y.shape != A.shape[:2] or block.shape != A.shape[:1]:
            raise ShapeError(
                f"Expected A (N, k, p), y (N, k) and block (N,), got {A.shape}, {y.shape} and {block.shape}. "
                "Pass one row of y and one block number per sample."
            )
        for i in range(A.shape[1]):
            columns = np.flatnonzero(A[:, i].any(axis=0))
            yield Rows(A[:, i, columns], y[:, i], block, i, columns)


@dataclass(frozen=True, eq=False)
class Factors:
    """Triangular factors of the rows ``[A y]`` of every measurement class in every time block."""

    size: int  # number of parameters p
    columns: tuple[np.ndarray, ...]  # (w,) parameter indices of each class
    R: tuple[np.ndarray, ...]  # (B, w + 1, w + 1) factors of each class
    rows: np.ndarray  # (B, G) number of rows per block and class

    def of_groups(self, kept: np.ndarray | None = None) -> list[np.ndarray]:
        """Return the factor (w + 1, w + 1) of each class over the blocks of the mask `kept` (B,); None: all blocks."""
        blocks = range(len(self.rows)) if kept is None else np.flatnonzero(kept)
        return [stack(R[b] for b in blocks) for R in self.R]

    def merge(self, groups: list[np.ndarray], weights: np.ndarray) -> np.ndarray:
        """Return the factor (p + 1, p + 1) of all classes, with the rows scaled by the class weights (G,), 1 / sd."""
        p = self.size
        wide = []
        for R, columns, weight in zip(groups, self.columns, weights):
            rows = np.zeros((len(R), p + 1))
            rows[:, [*columns, p]] = weight * R
            wide.append(rows)
        return stack(wide)

    def power(self, x: np.ndarray) -> np.ndarray:
        """Return the sum of squared residuals (B, G) per block and class for the parameters x (p,)."""
        columns = zip(self.R, self.columns)
        return np.stack([np.sum((R @ np.append(x[c], -1.0)) ** 2, axis=1) for R, c in columns], axis=1)


def factorise(rows: Iterable[Rows], size: int) -> Factors:
    """Reduce the rows of all classes, in any order, to triangular factors in one pass (Demmel et al. 2012)."""
    columns: dict[int, np.ndarray] = {}
    found: dict[tuple[int, int], np.ndarray] = {}
    count: dict[tuple[int, int], int] = {}
    for piece in rows:
        _check(piece, size, columns)
        edges = [*np.flatnonzero(np.diff(piece.block, prepend=-1)).tolist(), len(piece.y)]
        for a, b in pairwise(edges):
            key = (piece.group, int(piece.block[a]))
            found[key] = _append(found.get(key), piece, a, b)
            count[key] = count.get(key, 0) + b - a
    if not found:
        raise ShapeError("Expected rows to fit, got an empty sequence. Pass at least one sample.")
    groups, blocks = max(columns) + 1, 1 + max(b for _, b in found)
    totals = np.zeros((blocks, groups), dtype=int)
    for (g, b), number in count.items():
        totals[b, g] = number
    widths = [len(columns[g]) + 1 if g in columns else 1 for g in range(groups)]
    empty = [np.zeros((w, w)) for w in widths]
    factors = tuple(np.stack([found.get((g, b), empty[g]) for b in range(blocks)]) for g in range(groups))
    return Factors(size, tuple(columns.get(g, np.zeros(0, dtype=int)) for g in range(groups)), factors, totals)


def stack(parts: Iterable[np.ndarray]) -> np.ndarray:
    """Return the triangle R (w, w) of vertically stacked parts (m, w)."""
    found = list(parts)
    return triangle(np.concatenate(found)) if found else np.zeros((0, 0))


def triangle(A: np.ndarray, y: np.ndarray | None = None, R: np.ndarray | None = None) -> np.ndarray:
    """Return the triangular factor (w, w) of A (m, p) or ``[A y]``, stacked below R, which is overwritten."""
    from scipy.linalg import lapack

    w = A.shape[1]
    wide = w + (y is not None)
    whole: np.ndarray = np.zeros((wide, wide), order="F") if R is None else R
    for a in range(0, len(A), CHUNK):
        below = np.empty((min(CHUNK, len(A) - a), wide), order="F")
        below[:, :w] = A[a : a + CHUNK]
        if y is not None:
            below[:, w] = y[a : a + CHUNK]
        whole = lapack.dtpqrt(0, min(PANEL, wide), whole, below, overwrite_a=1, overwrite_b=1)[0]  # pyright: ignore
    return whole


def _append(R: np.ndarray | None, piece: Rows, start: int, stop: int) -> np.ndarray:
    """Return the triangle R updated with further rows."""
    R = triangle(piece.A[start:stop], piece.y[start:stop], R)
    if not np.isfinite(R).all():
        bad = start + np.flatnonzero(~np.isfinite(piece.A[start:stop]).all(axis=1) | ~np.isfinite(piece.y[start:stop]))
        raise ShapeError(
            f"Expected finite rows, got NaN or Inf in {len(bad)} rows of class {piece.group}, first {bad[:5].tolist()}"
            ". Drop these samples."
        )
    return R


def _check(piece: Rows, size: int, known: dict[int, np.ndarray]) -> None:
    A, y, block = piece.A, piece.y, piece.block
    if A.ndim != 2 or y.shape != A.shape[:1] or block.shape != y.shape or np.any(np.diff(block) < 0):
        raise ShapeError(
            f"Expected A (m, w), y (m,) and ascending block numbers (m,), got {A.shape}, {y.shape} and {block.shape}. "
            "Sort the samples by time."
        )
    columns = np.arange(size) if piece.columns is None else np.asarray(piece.columns)
    fits = columns.shape == A.shape[1:] and np.all((columns >= 0) & (columns < size))
    if not fits or len(np.unique(columns)) != len(columns) or (len(y) and block[0] < 0):
        raise ShapeError(
            f"Expected {A.shape[1]} different columns from 0 to {size - 1} and blocks from 0, got {columns.tolist()} "
            f"in class {piece.group}. Name each column exactly once."
        )
    if not np.array_equal(known.setdefault(piece.group, columns), columns):
        raise ShapeError(
            f"Expected the same columns in all rows of class {piece.group}, got {columns.tolist()}. Use two classes."
        )


# Fits use one BLAS thread, so results are bit-identical on every machine. More threads are no faster for tall, thin
# matrices.
_lock = Lock()
_inside = 0
_limits = ExitStack()


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS to one thread in a `with` block; if blocks overlap, the last to exit restores the thread count."""
    global _inside
    with _lock:
        if not _inside:
            _limits.enter_context(_libraries().limit(limits=1, user_api="blas"))
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                _limits.close()


@cache
def _libraries() -> Any:
    """Return the thread limiter of the loaded libraries; cached because finding them takes milliseconds."""
    from threadpoolctl import ThreadpoolController

    import_module("scipy.linalg")  # only loaded libraries can be limited
    return ThreadpoolController()
