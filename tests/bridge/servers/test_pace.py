"""Which rows a reader gets."""

from __future__ import annotations

import numpy as np

from armlab.bridge.servers.row import Pace


def test_each_arm_has_its_rate_whoever_comes_first() -> None:
    pace, got = Pace(0.1), {"left": 0, "right": 0}
    for k in range(2500):  # 10 s of two arms at 250 Hz, the right one just after the left
        for arm, after in (("left", 0.0), ("right", 1e-4)):
            got[arm] += pace.takes([arm], 0.004 * k + after)
    assert np.allclose(list(got.values()), 100, atol=2)


def test_a_row_that_is_fresh_for_both_counts_for_both() -> None:
    pace = Pace(1.0)
    assert pace.takes(["left", "right"], 5.0)
    assert not pace.takes(["left", "right"], 5.5)
    assert not pace.takes([], 7.0)
    assert pace.takes(["right"], 6.0)
    assert pace.takes(["left", "right"], 6.1)


def test_all_rows() -> None:
    pace = Pace(0.0)
    assert all(pace.takes(["left"], now) for now in (1.0, 1.0, 1.5))
