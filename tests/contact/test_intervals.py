"""Intervals of contact."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.contact import Contact, contacts
from armlab.log import Table


def estimate(force: np.ndarray) -> Table:
    N = len(force)
    wrench = np.column_stack([force, np.zeros((N, 5))])
    return Table(np.arange(N) * 0.004, {"wrench_hat": wrench, "wrench_hat_cov": np.tile(np.eye(6), (N, 1, 1))})


def test_contacts_are_found_merged_and_short_ones_left_out() -> None:
    force = np.random.default_rng(0).standard_normal(2000) * 0.5
    force[500:800] = 5.0
    force[600:610] = 0.0  # a hole of 40 ms
    force[1000:1020] = 5.0  # 80 ms: too short
    force[1500] = np.nan
    (found,) = contacts(estimate(force))
    assert isinstance(found, Contact)
    assert found.start == pytest.approx(2.0)
    assert found.end == pytest.approx(799 * 0.004)
    assert found.force[0] == pytest.approx(5.0 * 290 / 300, rel=1e-6)
    assert found.band == pytest.approx(2.0)


def test_nothing_touches() -> None:
    assert contacts(estimate(np.zeros(500))) == []
    assert contacts(estimate(np.full(500, np.nan))) == []


def test_a_chain_of_short_excursions_is_no_contact() -> None:
    """What a slow filter does without contact: 20 ms outside, 60 ms inside, and again."""
    force = np.zeros(1000)
    for start in range(300, 600, 20):
        force[start : start + 5] = 5.0
    assert contacts(estimate(force)) == []
