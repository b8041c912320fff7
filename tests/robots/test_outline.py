"""The outline of an arm."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.robots.robot import arm_length, bends


def test_a_stretched_arm_is_as_long_as_its_links_and_strokes_together() -> None:
    limits = {"q_min": [-2, -2, 0, -3], "q_max": [2, 2, 0.3, 3]}
    alpha, a, d = [0, np.pi, 0, 0], [0.4, 0.3, 0, 0], [0.5, 0, 0, 0.05]
    scara = robots.from_dh("scara", alpha, a, d, prismatic=[0, 0, 1, 0], **limits)
    assert arm_length(scara) == pytest.approx(np.hypot(0.5, 0.4) + 0.3 + 0.3 + 0.05)


def test_a_link_follows_the_common_normal_of_its_axes() -> None:
    """Axis z through the origin, axis y through (0.3, 0.1, 0.5): they are nearest at x = 0 and 0.3, height 0.5."""
    z, y = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    found = bends(np.zeros(3), z, np.array([0.3, 0.1, 0.5]), y)
    np.testing.assert_allclose(found, [[0.0, 0.0, 0.5], [0.3, 0.0, 0.5]], atol=1e-15, rtol=0)


def test_parallel_axes_have_one_bend() -> None:
    z = np.array([0.0, 0.0, 1.0])
    found = bends(np.zeros(3), z, np.array([0.3, 0.1, 0.5]), z)
    np.testing.assert_allclose(found, [[0.0, 0.0, 0.5]], atol=1e-15, rtol=0)
