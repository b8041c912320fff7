"""Guidance needs motors and RAPID; RAPID that is stuck at UNDEFINED counts as running."""

from __future__ import annotations

from armlab.sim.scene import Scene
from armlab.sim.script import MOTORS, RAPID, Script


def test_readiness() -> None:
    assert Scene().is_ready(0.0)
    assert Scene(rapid=Script("undefined", RAPID)).is_ready(0.0)
    assert not Scene(rapid=Script("stopped", RAPID)).is_ready(0.0)
    assert not Scene(motors=Script("undefined", MOTORS)).is_ready(0.0)
    switched = Scene(motors=Script("0:off,1:on", MOTORS))
    assert [switched.is_ready(t) for t in (0.0, 0.99, 1.0)] == [False, False, True]
