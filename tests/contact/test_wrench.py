"""Wrench: sigma, condition, hidden direction, flags."""

from __future__ import annotations

import numpy as np

from armlab.contact import INVALID, WEAK, Wrench
from armlab.contact.wrench import flags_of

PRIOR = np.array([400.0, 400, 400, 4, 4, 4])


def wrench(cov: np.ndarray, flags: int = 0) -> Wrench:
    return Wrench(np.ones(6), cov, 1 - np.diag(cov) / PRIOR, np.zeros(7), np.ones(7), PRIOR, flags)


def test_wrench_tells_what_cannot_be_seen() -> None:
    cov = np.diag(PRIOR * [0.1, 0.1, 0.1, 0.1, 0.1, 1.0])
    blind = wrench(cov)
    assert abs(blind.hidden[5]) == 1.0
    assert blind.cond == float("inf")
    np.testing.assert_allclose(blind.sigma, np.sqrt(np.diag(cov)))
    even = wrench(np.diag(PRIOR * 0.2))
    assert abs(even.cond - 1.0) < 1e-9
    uneven = wrench(np.diag(PRIOR * [0.5, 0.5, 0.5, 0.5, 0.5, 1 / 26]))
    assert abs(uneven.cond - 5.0) < 1e-9


def test_flags() -> None:
    assert flags_of(np.full(6, np.nan), np.ones(6)) == INVALID
    assert flags_of(np.zeros(6), np.array([1, 1, 1, 1, 1, 0.3])) == WEAK
    assert flags_of(np.zeros(6), np.full(6, 0.9)) == 0
    assert np.isnan(wrench(np.diag(PRIOR), INVALID).cond)
    assert np.isnan(wrench(np.full((6, 6), np.nan), INVALID).hidden).all()
