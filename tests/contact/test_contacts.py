"""Intervals of contact, and estimates compared with measurements."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.contact import Comparison, Contact, compare, contacts
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


# `contact.compare`: errors and coverage against truth or sensor.


N = 5000


@pytest.fixture
def table() -> Table:
    rng = np.random.default_rng(1)
    sigma = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    true = rng.normal(size=(N, 6))
    hat = true + sigma * rng.normal(size=(N, 6))
    hat[:7] = np.nan
    cov = np.broadcast_to(np.diag(sigma**2), (N, 6, 6))
    return Table(np.arange(N) * 0.004, {"wrench_hat": hat, "wrench_hat_cov": cov, "wrench_true": true, "wrench": hat})


def test_errors_are_those_against_the_truth_where_there_is_one(table: Table) -> None:
    found = compare(table)
    assert isinstance(found, Comparison)
    error = (table["wrench_hat"] - table["wrench_true"])[7:]
    assert found.rows == N - 7
    assert found.rms == pytest.approx(np.sqrt(np.mean(error**2, axis=0)))
    assert found.inside == pytest.approx(0.954, abs=0.015)
    rms = " ".join(f"{value:.2f}" for value in found.rms[:3])
    assert found.text() == f"force x y z against the true wrench: {rms} N RMS, 95 % inside 2 sigma"
    assert not found.rms.flags.writeable


def test_else_against_the_sensor(table: Table) -> None:
    found = compare(table.without("wrench_true"))
    assert found.against == "the force sensor"
    assert not found.rms.any()
