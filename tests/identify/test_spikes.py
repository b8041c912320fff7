"""Spikes of torque, found and replaced."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.identify import fit_dynamics, prepare
from armlab.identify.spikes import spikes, without_spikes


def test_spikes_are_found_and_replaced_better_by_a_model(short_arm) -> None:
    """The median errs where friction turns round; with the model no replacement is worse than the noise around it."""
    clean, bad = short_arm.log(0, 3000), short_arm.log(0, 3000, bad=0.05)
    data = prepare(bad, short_arm.robot)
    spoilt, found = bad["tau"] != clean["tau"], spikes(data)
    assert np.sum(found & ~spoilt) < 0.02 * found.sum()
    assert found.sum() > 0.98 * spoilt.sum()
    plain = without_spikes(data, found)
    modelled = without_spikes(data, found, fit_dynamics(clean, short_arm.robot).value)
    for tau in (plain, modelled):
        np.testing.assert_array_equal(tau[~found], bad["tau"][~found])
    first, second = (np.sqrt(np.mean((tau - clean["tau"])[found] ** 2)) for tau in (plain, modelled))
    assert second < 0.9 * first
    noise = np.sqrt(np.mean(np.broadcast_to([0.3, 0.2], found.shape)[found] ** 2))
    assert second == pytest.approx(np.hypot(1.0, 0.5) * noise, rel=0.15), "its own noise, and that of a median of nine"


def test_a_clean_record_has_no_spikes(short_arm) -> None:
    assert not spikes(prepare(short_arm.log(1, 3000), short_arm.robot)).any()
