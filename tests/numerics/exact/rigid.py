"""Rotations and rigid motions in mpmath, from the definitions: exponentials are power series of matrices, Jacobians
series of commutators, inverses inverses of matrices. No closed form of the kernels is used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np
from mpmath import mp, mpf

mp.dps = 80  # of which 50 are right also after the cancellations near a half turn and at 1e-300
TINY = mpf(10) ** -75
few: int | None = None  # samples of each table that are made, where a check does not want all


def chosen(count: int, in_order: bool = False) -> list[int]:
    """Return which samples are made: all, or a few; twice as many and the first ones where each follows another."""
    if few is None:
        return list(range(count))
    if in_order:
        return list(range(min(2 * few, count)))
    return np.random.default_rng(count).choice(count, min(few, count), replace=False).tolist()


def filled(made: dict[int, np.ndarray], count: int) -> np.ndarray:
    """Return all samples, of which those that were not made are NaN."""
    gap = np.full(np.shape(next(iter(made.values()))), np.nan)
    return np.array([made.get(k, gap) for k in range(count)])


def each(call: Callable[..., np.ndarray], *columns: np.ndarray, slow: int | None = None) -> np.ndarray:
    """Return what a call makes of each sample; where one alone is slow, a few are all others."""
    rows = list(zip(*columns, strict=True))
    wanted = chosen(len(rows)) if slow is None or few is None else [k for k in range(len(rows)) if k != slow]
    return filled({k: call(*rows[k]) for k in wanted}, len(rows))


def exact(values: np.ndarray) -> mp.matrix:
    """Return doubles (r, c) or (r,) as a matrix without rounding."""
    return mp.matrix(np.asarray(values, dtype=float).tolist())


def rounded(value: mpf) -> float:
    """Return the nearest double."""
    if not value or mp.isinf(value):
        return float(value)
    sign, mantissa, exponent, _ = mpf(value)._mpf_
    return float((-1) ** sign * int(mantissa) * Fraction(2) ** int(exponent))


def array(matrix: mp.matrix | Sequence[mpf]) -> np.ndarray:
    """Return the nearest doubles, a column as (r,).

    What is 1e-60 to 1e-100 of the largest entry is zero: no sum or product of the inputs is so small, but what rounding
    to 80 digits leaves of a difference that is none.
    """
    found = doubles(matrix)
    share = np.abs(found) / np.max(np.abs(found), initial=np.finfo(float).tiny, where=np.isfinite(found))
    return np.where((share > 1e-100) & (share < 1e-60), 0.0, found)


def doubles(matrix: mp.matrix | Sequence[mpf]) -> np.ndarray:
    if not isinstance(matrix, mp.matrix):
        return np.array([rounded(value) for value in matrix])
    rows = np.array([[rounded(matrix[i, j]) for j in range(matrix.cols)] for i in range(matrix.rows)])
    return rows[:, 0] if matrix.cols == 1 else rows


def part(matrix: mp.matrix, rows: range, columns: range) -> mp.matrix:
    """Return the entries of some rows and columns."""
    return mp.matrix([[matrix[i, j] for j in columns] for i in rows])


def blocks(rows: Sequence[Sequence[mp.matrix]]) -> mp.matrix:
    """Return a matrix of matrices."""
    lines = [[value for block in row for value in block[i, :]] for row in rows for i in range(row[0].rows)]
    return mp.matrix(lines)


def hat(w: Sequence[mpf]) -> mp.matrix:
    x, y, z = w
    return mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def vee(W: mp.matrix) -> mp.matrix:
    """Return the vector of the antisymmetric part."""
    return mp.matrix([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2


def twist_hat(xi: Sequence[mpf]) -> mp.matrix:
    v = mp.matrix(list(xi[:3]))
    return blocks([[hat(xi[3:]), v], [mp.zeros(1, 3), mp.zeros(1, 1)]])


def commutator(xi: Sequence[mpf]) -> mp.matrix:
    """Return ad: ``ad(x) y`` is the twist of ``hat(x) hat(y) - hat(y) hat(x)``."""
    return blocks([[hat(xi[3:]), hat(xi[:3])], [mp.zeros(3), hat(xi[3:])]])


def series(A: mp.matrix, shift: int = 0) -> mp.matrix:
    """Return the sum of ``A^k / (k + shift)!``."""
    entries = np.array(A.tolist(), dtype=object)  # NumPy multiplies matrices of numbers of mpmath thrice as fast
    term = np.array(mp.eye(A.rows).tolist(), dtype=object) / mp.factorial(shift)
    total, size, k = term, max(abs(entries).sum(axis=1)), 0
    bound = mpf(1)  # of the norm of the term
    while bound > TINY and k < 400:
        k += 1
        term = term @ entries / (k + shift)
        bound = bound * size / (k + shift)
        total = total + term
    return mp.matrix(total.tolist())


def nearest(M: mp.matrix) -> mp.matrix:
    """Return the orthonormal matrix nearest to one close to it (Newton)."""
    for _ in range(12):
        M = (M + mp.inverse(M).T) / 2
    return M


def logarithm(R: mp.matrix) -> mp.matrix:
    """Return the rotation vector of the rotation nearest to R, less than a half turn."""
    R = nearest(R)
    a = vee(R)
    sine = mp.norm(a)
    if sine == 0:
        return a
    return a * (mp.atan2(sine, (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2) / sine)


def pose(R: mp.matrix, p: mp.matrix) -> mp.matrix:
    return blocks([[R, p], [mp.zeros(1, 3), mp.ones(1, 1)]])


def rotation_of(T: mp.matrix) -> mp.matrix:
    return nearest(part(T, range(3), range(3)))


def position_of(T: mp.matrix) -> mp.matrix:
    return part(T, range(3), range(3, 4))


def twist(T: mp.matrix) -> mp.matrix:
    """Return the logarithm [v; w] of a rigid motion."""
    w = logarithm(rotation_of(T))
    v = mp.inverse(series(hat(w), 1)) * position_of(T)
    return mp.matrix([*v, *w])


def quaternion(R: mp.matrix) -> mp.matrix:
    """Return wxyz with w not negative."""
    w = logarithm(R)
    angle = mp.norm(w)
    scale = mp.sin(angle / 2) / angle if angle else mpf(1) / 2
    return mp.matrix([mp.cos(angle / 2), *(scale * w)])
