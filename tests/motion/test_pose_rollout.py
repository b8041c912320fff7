"""What a rollout of poses holds."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.estimation import Fit
from armlab.lie import quaternion, so3
from armlab.motion import PoseDmp, PoseRollout, PoseRunOptions


def test_twists_are_derivatives_and_everything_is_frozen(pose_fit: Fit[PoseDmp]) -> None:
    run = pose_fit.value.rollout(np.linspace(0, 1.2, 2401), twist0=[0.1, 0, 0, 0, 0.2, 0])
    assert isinstance(run, PoseRollout)
    h = run.t[1]
    v = np.gradient(run.T[:, :3, 3], h, axis=0)
    R = run.T[:, :3, :3]
    w = so3.log(R[2:] @ np.swapaxes(R[:-2], 1, 2)) / (2 * h)
    np.testing.assert_allclose(run.twist[1:-1], np.concatenate([v[1:-1], w], axis=1), atol=5e-5)
    np.testing.assert_allclose(run.twistd[2:-2], np.gradient(run.twist, h, axis=0)[2:-2], atol=2e-2)
    np.testing.assert_allclose(run.twist[0], [0.1, 0, 0, 0, 0.2, 0], atol=1e-12)
    np.testing.assert_allclose(quaternion.to_matrix(run.q), R, atol=1e-12)
    assert (np.diff(run.x) < 0).all()
    assert ((run.q[1:] * run.q[:-1]).sum(axis=1) > 0).all()
    for name in ("t", "T", "q", "twist", "twistd", "x"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(run, name)[0] = 0


def test_options_mean_the_same_everywhere(pose_fit: Fit[PoseDmp]) -> None:
    dmp = pose_fit.value
    given: PoseRunOptions = {"duration": 2.0, "start": dmp.T_goal, "goal": dmp.T_start, "twist0": None}
    run, stepper = dmp.rollout(0.01, **given), dmp.stepper(**given)
    steps = [stepper.step(0.01)[0] for _ in run.t[1:]]
    np.testing.assert_allclose(steps, run.T[1:], atol=1e-12)
    assert run.t[-1] == pytest.approx(2.0)
    with pytest.raises(TypeError, match="speed"):
        dmp.rollout(0.01, speed=2.0)  # type: ignore[call-arg]
