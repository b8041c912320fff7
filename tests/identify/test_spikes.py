"""Spikes of torque, found and replaced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import median_filter

from armlab.identify import fit_dynamics, prepare
from armlab.identify.record import AT_ONCE, torque_outliers, without_outliers


def test_spikes_are_found_and_replaced_better_by_a_model(short_arm) -> None:
    """The median errs where friction turns round; with the model no replacement is worse than the noise around it."""
    clean, bad = short_arm.log(0, 3000), short_arm.log(0, 3000, bad=0.05)
    data = prepare(bad, short_arm.robot)
    spoilt, found = bad["tau"] != clean["tau"], torque_outliers(data)
    assert np.sum(found & ~spoilt) < 0.02 * found.sum()
    assert found.sum() > 0.98 * spoilt.sum()
    plain = without_outliers(data, found)
    modelled = without_outliers(data, found, fit_dynamics(clean, short_arm.robot).value)
    for tau in (plain, modelled):
        np.testing.assert_array_equal(tau[~found], bad["tau"][~found])
    first, second = (np.sqrt(np.mean((tau - clean["tau"])[found] ** 2)) for tau in (plain, modelled))
    assert second < 0.9 * first
    noise = np.sqrt(np.mean(np.broadcast_to([0.3, 0.2], found.shape)[found] ** 2))
    assert second == pytest.approx(np.hypot(1.0, 0.5) * noise, rel=0.15), "its own noise, and that of a median of nine"


def test_a_clean_record_has_no_spikes(short_arm) -> None:
    assert not torque_outliers(prepare(short_arm.log(1, 3000), short_arm.robot)).any()


def test_what_replaces_a_spike_without_a_model_is_the_median_of_nine(short_arm) -> None:
    data = prepare(short_arm.log(2, AT_ONCE + 900), short_arm.robot)
    data = replace(data, segments=((0, AT_ONCE + 500), (AT_ONCE + 500, AT_ONCE + 900)))
    expected = [median_filter(data.tau[a:b], size=(9, 1), mode="nearest") for a, b in data.segments]
    got = without_outliers(data, np.ones(data.tau.shape, dtype=bool))
    np.testing.assert_array_equal(got, np.concatenate(expected))
