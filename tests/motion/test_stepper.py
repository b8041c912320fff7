"""A movement primitive sample by sample: as the rollout, and with a goal that moves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.motion import Dmp, Stepper

Primitive = Callable[..., Dmp]


@given(st.sampled_from(["canonical", "time", "position"]), st.integers(0, 99))
def test_steps_are_the_rollout(primitive: Primitive, schedule: str, seed: int) -> None:
    dmp = primitive(schedule)
    t = np.cumsum(np.random.default_rng(seed).uniform(1e-3, 0.1, 40))
    run = dmp.rollout(t, g=dmp.g + 1, duration=3.0)
    stepper = dmp.stepper(g=dmp.g + 1, duration=3.0)
    assert isinstance(stepper, Stepper)
    for _ in range(2):
        rows = [stepper.state, *(stepper.step(dt) for dt in np.diff(t))]
        for got, wanted in zip(np.array(rows).swapaxes(0, 1), (run.y, run.yd, run.ydd)):
            np.testing.assert_allclose(got, wanted, atol=1e-12 * (1 + abs(wanted).max()))
        np.testing.assert_allclose(stepper.x, run.x[-1], atol=1e-12)
        assert [stepper.t, stepper.duration] == pytest.approx([t[-1] - t[0], 3.0])
        stepper.reset()


def test_the_velocity_stays_when_the_pace_changes(primitive: Primitive) -> None:
    stepper = primitive().stepper()
    for _ in range(100):
        _, before, _ = stepper.step(0.004)
    stepper.change_duration(5.0)
    np.testing.assert_allclose(stepper.state[1], before, rtol=1e-14)
    for _ in range(5000):
        y, _, _ = stepper.step(0.004)
    np.testing.assert_allclose(y, stepper.goal, atol=1e-3)


def test_bad_arguments_are_refused(primitive: Primitive) -> None:
    dmp = primitive()
    with pytest.raises(UnknownName, match="shift"):
        dmp.stepper(goal_forcing="jump")
    with pytest.raises(ConfigError, match="scaling"):
        primitive(scaling="none").stepper(goal_forcing="scale")
    with pytest.raises(ConfigError, match="goal_rate"):
        dmp.stepper(goal_rate=-1.0)
    with pytest.raises(ShapeError, match="each run"):
        dmp.stepper(g=np.zeros((2, 3)))
    stepper = dmp.stepper()
    for dt in (0.0, -0.1, np.nan):
        with pytest.raises(ShapeError, match="dt"):
            stepper.step(dt)
    for g in (np.zeros(2), np.full(3, np.nan)):
        with pytest.raises(ShapeError):
            stepper.change_goal(g)
    with pytest.raises(ShapeError, match="above zero"):
        stepper.change_duration(0.0)
