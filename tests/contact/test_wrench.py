"""Wrench: sigma, condition, observability per direction, hidden direction."""

from __future__ import annotations

import numpy as np

from armlab.contact import INFEASIBLE, INVALID, SINGULAR, STUCK, TARED, WEAK, Wrench

PRIOR = np.array([400.0, 400, 400, 4, 4, 4])


def wrench(cov: np.ndarray, flags: int = 0, at_point: bool = False) -> Wrench:
    observability = 1 - np.diag(cov) / PRIOR
    return Wrench(
        np.ones(6), cov, observability, np.zeros(7), np.ones(7), PRIOR, flags, np.ones(7, dtype=bool), None, at_point
    )


def test_wrench_tells_what_cannot_be_seen() -> None:
    cov = np.diag(PRIOR * [0.1, 0.1, 0.1, 0.1, 0.1, 1.0])
    blind = wrench(cov, WEAK)
    assert abs(blind.hidden[5]) == 1.0
    assert blind.cond == float("inf")
    np.testing.assert_allclose(blind.sigma, np.sqrt(np.diag(cov)))
    seen, axes = blind.directions
    np.testing.assert_allclose(seen, [0.0, 0.9, 0.9, 0.9, 0.9, 0.9], atol=1e-12)
    assert np.array_equal(axes[:, 0], blind.hidden)
    even = wrench(np.diag(PRIOR * 0.2))
    assert abs(even.cond - 1.0) < 1e-9
    uneven = wrench(np.diag(PRIOR * [0.5, 0.5, 0.5, 0.5, 0.5, 1 / 26]))
    assert abs(uneven.cond - 5.0) < 1e-9


def test_at_a_known_point_three_directions_count() -> None:
    known = wrench(np.diag(PRIOR * [0.5, 0.5, 1 / 26, 0, 0, 0]), at_point=True)
    assert abs(known.cond - 5.0) < 1e-9
    assert known.hidden.shape == (3,)
    np.testing.assert_allclose(known.directions[0], [0.5, 0.5, 25 / 26])


def test_an_estimate_that_is_missing_has_no_direction() -> None:
    for flags in (INVALID, SINGULAR, INVALID | STUCK | INFEASIBLE | TARED):
        missing = wrench(np.full((6, 6), np.nan), flags)
        assert np.isnan(missing.cond)
        assert np.isnan(missing.hidden).all()
        assert np.isnan(missing.directions[0]).all()
