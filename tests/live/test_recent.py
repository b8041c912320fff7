"""`RingBuffer` keeps what a list of the last seconds would."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.live.curves import RingBuffer


@pytest.mark.parametrize("step", [0.004, 0.033, 0.4, 20.0])
def test_it_keeps_the_last_seconds(step: float) -> None:
    """Also when far more samples come than there is room for, and when each is older than the window."""
    recent, all_t = RingBuffer(2, 10.0), step * np.arange(6000)
    views = []
    for k, t in enumerate(all_t):
        recent.add(t, [k, -k])
        if k % 997 == 0:
            views.append((recent.t, recent.t.copy(), recent.values, recent.values.copy()))
        if k % 501 == 0:
            inside = np.flatnonzero((all_t <= t) & (all_t >= t - 10.0))
            np.testing.assert_array_equal(recent.values, np.stack([inside, -inside], axis=1))
            np.testing.assert_array_equal(recent.t, all_t[inside])
            assert len(recent) == len(inside)
    for t, t_then, values, values_then in views:  # what was sent is not overwritten
        np.testing.assert_array_equal(t, t_then)
        np.testing.assert_array_equal(values, values_then)


def test_it_begins_anew() -> None:
    recent = RingBuffer(1, 1.0)
    recent.add(5.0, [1.0])
    recent.clear()
    assert len(recent) == 0
    recent.add(1.0, [2.0])
    assert (recent.t.tolist(), recent.values.tolist()) == ([1.0], [[2.0]])
