"""Tall-skinny QR in pieces."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.estimation import Factors, Rows, factorise
from armlab.estimation.tsqr import triangle

RNG = np.random.default_rng(0)
A = RNG.standard_normal((90, 2, 4))
A[:, 0, 3] = 0.0  # class 0 has no fourth column
Y = RNG.standard_normal((90, 2))
BLOCK = np.arange(90) // 30


def test_factors_tell_the_residual_of_any_parameters_per_block_and_class() -> None:
    factors = factorise(Rows.of(A, Y, BLOCK), 4)
    assert isinstance(factors, Factors)
    assert factors.rows.tolist() == [[30, 30]] * 3
    x = np.array([1.0, -2.0, 3.0, 0.5])
    residuals = (Y - A @ x).reshape(3, 30, 2)
    direct = np.sum(residuals**2, axis=1)
    np.testing.assert_allclose(factors.power(x), direct, rtol=1e-13)


def test_merged_factor_is_that_of_dense_qr() -> None:
    factors = factorise(Rows.of(A, Y, BLOCK), 4)
    R = factors.merge(factors.of_groups(), np.array([2.0, 0.5]))
    dense = np.concatenate([2.0 * np.c_[A[:, 0], Y[:, 0]], 0.5 * np.c_[A[:, 1], Y[:, 1]]])
    np.testing.assert_allclose(R.T @ R, dense.T @ dense, rtol=1e-12, atol=1e-12)
    left = factors.merge(factors.of_groups(np.array([True, False, True])), np.ones(2))
    some = np.concatenate([np.c_[A[BLOCK != 1, g], Y[BLOCK != 1, g]] for g in range(2)])
    np.testing.assert_allclose(left.T @ left, some.T @ some, rtol=1e-12, atol=1e-12)


@given(cuts=st.lists(st.integers(1, 89), max_size=6, unique=True), order=st.randoms())
@settings(max_examples=25)
def test_pieces_and_their_order_change_nothing_but_rounding(cuts: list[int], order) -> None:
    edges = [0, *sorted(cuts), 90]
    pieces = [rows for a, b in pairwise(edges) for rows in _pieces(a, b)]
    order.shuffle(pieces)
    x = np.array([0.3, 0.1, -1.0, 2.0])
    whole = factorise(Rows.of(A, Y, BLOCK), 4)
    np.testing.assert_allclose(factorise(iter(pieces), 4).power(x), whole.power(x), rtol=1e-12)


def _pieces(a: int, b: int) -> list[Rows]:
    columns = (np.arange(3), np.arange(4))
    return [Rows(A[a:b, g][:, columns[g]], Y[a:b, g], BLOCK[a:b], g, columns[g]) for g in range(2)]


def test_blocks_without_rows_are_empty() -> None:
    factors = factorise([Rows(np.ones((2, 1)), np.ones(2), np.array([0, 3]))], 1)
    assert factors.rows.tolist() == [[1], [0], [0], [1]]
    np.testing.assert_array_equal(factors.R[0][1:3], 0.0)


def test_the_triangle_of_many_rows_has_their_gram_matrix() -> None:
    rng = np.random.default_rng(0)
    A, y = rng.standard_normal((2500, 4)), rng.standard_normal(2500)
    R, both = triangle(A), triangle(A, y)
    np.testing.assert_allclose(R.T @ R, A.T @ A, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(both[:, 4] @ both[:, 4], y @ y, rtol=1e-12)
    assert triangle(A[:2]).shape == (4, 4)
