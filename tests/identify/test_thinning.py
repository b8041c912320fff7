"""Filter and decimation in one pass."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from armlab.identify import prepare
from armlab.identify.columns import Decimation, Piece


@pytest.fixture(scope="module")
def data(truth, excited):
    """A record of two segments."""
    whole = prepare(excited, truth.robot)
    return replace(whole, segments=((0, 5000), (5000, len(whole.t))))


def test_thinning_is_the_zero_phase_filter_at_the_rows_that_are_kept(data) -> None:
    thinning = Decimation.of(data, 25.0, 4)
    got = thinning.run(lambda a, b: data.tau[a:b], data.tau.shape[1])
    expected = data.filter(data.tau, 25.0)[thinning.rows]
    inside = np.concatenate([np.arange(50, 1200), np.arange(1300, len(got) - 50)])
    scale = np.std(expected, axis=0)
    assert np.max(np.abs(got - expected)[inside] / scale) < 1e-5
    assert np.max(np.abs(got - expected) / scale) < 0.1, "ends are continued in another way"


def test_a_constant_and_a_slope_pass_unchanged(data) -> None:
    for every in (1, 3, 7):
        thinning = Decimation.of(data, 10.0, every)
        x = np.column_stack([np.ones(len(data.t)), np.arange(len(data.t))])
        np.testing.assert_allclose(thinning.run(lambda a, b, x=x: x[a:b], 2), x[thinning.rows], rtol=1e-9, atol=1e-6)


def test_without_a_filter_rows_are_picked(data) -> None:
    thinning = Decimation.of(data, np.inf, 50)
    got = thinning.run(lambda a, b: data.tau[a:b], data.tau.shape[1])
    np.testing.assert_array_equal(got, data.tau[thinning.rows])


def test_pieces_ask_for_no_row_beyond_their_segment(data) -> None:
    thinning = Decimation.of(data, 25.0, 4)
    pieces = list(thinning.pieces())
    assert all(isinstance(piece, Piece) for piece in pieces)
    assert pieces[0].first == 0
    assert pieces[-1].last == len(thinning.rows)
    assert all(one.last == other.first for one, other in pairwise(pieces))
    assert all(any(a <= piece.start < piece.stop <= b for a, b in data.segments) for piece in pieces)
    x = np.random.default_rng(0).standard_normal((len(data.t), 2))
    first = pieces[0]
    got = np.empty((first.last, 2))
    thinning.thin(first, x[first.start : first.stop], got)
    np.testing.assert_allclose(got, thinning.run(lambda a, b: x[a:b], 2)[: first.last], rtol=1e-13)


@pytest.mark.parametrize("rows", [100, 5000])
def test_ends_are_continued_by_point_reflection(data, rows: int) -> None:
    """Also where the filter reaches beyond the other end of the piece."""
    short = replace(data, rate=2500.0, segments=((0, rows),))
    thinning = Decimation.of(short, 25.0, 10)
    reach = len(thinning.taps) // 2
    assert reach > 200
    x = data.tau[:rows]
    wide = np.pad(x, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    expected = [thinning.taps @ wide[k : k + 2 * reach + 1] for k in thinning.rows]
    np.testing.assert_allclose(thinning.run(lambda a, b: x[a:b], x.shape[1]), expected, rtol=1e-9, atol=1e-9)
