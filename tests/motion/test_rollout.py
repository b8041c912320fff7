"""What a movement primitive returns cannot be changed, and what is free in a run."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import Dmp, Rollout, RunOptions


def test_a_rollout_is_frozen() -> None:
    parts = np.zeros((5, 4, 2))
    run = Rollout(np.arange(4.0), *parts[:3], np.ones(4), parts[3])
    for name in ("t", "y", "yd", "ydd", "x", "forcing"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(run, name)[0] = 1
    parts[0] = 1  # what was given stays the caller's


def test_options_mean_the_same_everywhere(primitive: Callable[..., Dmp]) -> None:
    dmp = primitive()
    given: RunOptions = {"duration": 3.0, "tau_d": None, "y0": dmp.y0 + 0.1, "g": dmp.g + 0.5, "v0": None}
    run, batch = dmp.rollout(0.01, **given), dmp.rollout_batch(0.01, **given)
    stepper = dmp.stepper(**given)
    steps = [stepper.step(0.01)[0] for _ in run.t[1:]]
    np.testing.assert_allclose(steps, run.y[1:], atol=1e-12)
    np.testing.assert_allclose(batch.y[:, 0], run.y, atol=1e-12)
    np.testing.assert_allclose(dmp.solve(0.1, **given).y, run.y[::10], atol=1e-5)
    assert run.t[-1] == pytest.approx(3.0)
    for call in (dmp.rollout, dmp.rollout_batch, dmp.solve):
        for name in ("speed", "runs", "dmp"):
            with pytest.raises(TypeError, match=name):
                call(0.01, **{name: 2})  # type: ignore[call-arg]
    for call in (dmp.rollout, dmp.solve):
        with pytest.raises(ShapeError, match=r"y0 of shape .* one run"):
            call(0.01, y0=np.zeros((2, 3)))
