"""Guidance needs motors and RAPID; RAPID that is stuck at UNDEFINED counts as running."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.sim.events import MOTORS, RAPID, AppliedWrench, Grip, HandPath, StateScript, Surroundings


def test_readiness() -> None:
    assert Surroundings().is_ready(0.0)
    assert Surroundings(rapid=StateScript("undefined", RAPID)).is_ready(0.0)
    assert not Surroundings(rapid=StateScript("stopped", RAPID)).is_ready(0.0)
    assert not Surroundings(motors=StateScript("undefined", MOTORS)).is_ready(0.0)
    switched = Surroundings(motors=StateScript("0:off,1:on", MOTORS))
    assert [switched.is_ready(t) for t in (0.0, 0.99, 1.0)] == [False, False, True]


def test_a_hand_leads_in_one_program_only_and_an_arm_of_as_many_joints() -> None:
    hand = HandPath.random(robots.load("irb120"), 0)
    scene = Surroundings(hand=hand)
    assert scene.leads("loop", 7) is None
    assert scene.leads("lead-through", 6) is hand
    with pytest.raises(ShapeError, match="7 joints, got one of 6"):
        scene.leads("lead-through", 7)


def test_hands_that_push_and_hold_add_up() -> None:
    push = AppliedWrench(np.array([0.0, 3.0]), np.tile([1.0, 0, 0, 0, 0, 0], (2, 1)))
    scene, moved = Surroundings(push, grip=Grip(1.0, 2.0)), np.eye(4)
    moved[0, 3] = 0.001
    np.testing.assert_array_equal(scene.wrench(0.5, np.eye(4)), [1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(scene.wrench(1.0, np.eye(4)), [1, 0, 0, 0, 0, 0])
    held = scene.wrench(1.5, moved)
    assert held is not None
    assert held[0] < 1.0
    assert Surroundings().wrench(1.0, np.eye(4)) is None
    assert Surroundings(grip=Grip(0.0, 1.0)).wrench(0.5, np.eye(4)) is not None
