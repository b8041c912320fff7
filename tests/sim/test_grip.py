"""The hand that holds the tool: a spring to where it took it, of limited strength, only while it holds."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError
from armlab.lie import se3, so3
from armlab.sim.events import DAMPING, STIFFNESS, STRENGTH, Grip


def pose(p: list[float], w: list[float]) -> np.ndarray:
    return se3.from_rp(so3.exp(np.array(w)), np.array(p))


def test_it_holds_the_tool_where_it_took_it() -> None:
    grip, start = Grip(1.0, 2.0), pose([0.4, 0.1, 0.3], [0.2, -0.1, 0.5])
    assert grip.at(0.999, pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])) is None
    np.testing.assert_array_equal(grip.at(1.0, start), np.zeros(6))
    moved = start.copy()
    moved[:3, 3] += [0.01, 0.0, -0.02]
    np.testing.assert_allclose(
        grip.at(1.1, moved), -STIFFNESS * [0.01, 0, -0.02, 0, 0, 0] - DAMPING * [0.1, 0, -0.2, 0, 0, 0]
    )
    turned = start.copy()
    turned[:3, :3] = so3.exp(np.array([0.0, 0.0, 0.1])) @ start[:3, :3]
    wrench = grip.at(1.2, turned)
    assert wrench is not None
    assert wrench[5] == pytest.approx(-15 * 0.1 - 1.0 * 1.0)
    assert grip.at(2.0, start) is None


def test_it_is_only_so_strong() -> None:
    grip, start = Grip(0.0, 2.0), pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    grip.at(0.0, start)
    np.testing.assert_array_equal(np.abs(grip.at(1.0, pose([1.0, -1.0, 1.0], [1.0, -1.0, 1.0]))), STRENGTH)


@pytest.mark.parametrize(("start", "end"), [(1.0, 1.0), (2.0, 1.0), (np.nan, 1.0), (0.0, np.inf)])
def test_bad_times_get_a_sentence(start: float, end: float) -> None:
    with pytest.raises(ConfigError, match=r"^Expected .*\.$"):
        Grip(start, end)
