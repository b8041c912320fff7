"""A rhythm on an arm: from rest and back to rest, around a baseline, within limits."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import State, robots
from armlab.errors import ShapeError
from armlab.motion import Controller, PeriodicController, PeriodicDmp, fit_periodic_dmp

PERIOD = 0.004032
ROBOT = robots.load("yumi_right")
T = np.linspace(0.0, 4.0, 401)


@pytest.fixture(scope="module")
def rhythm() -> PeriodicDmp:
    """Two joints go round twice in four seconds."""
    y = np.tile(ROBOT.q_home, (401, 1))
    y[:, 0] += 0.2 * np.cos(np.pi * T)
    y[:, 1] += 0.1 * np.sin(np.pi * T)
    return fit_periodic_dmp(T, y, period=2.0).value


def run(controller: Controller, seconds: float) -> np.ndarray:
    """Joint positions of an arm that is where it was told to be one packet ago."""
    found, qd = [ROBOT.q_home], np.zeros(7)
    for k in range(round(seconds / PERIOD)):
        command = controller(State(k * PERIOD, PERIOD, found[-1], qd, found[-1]))
        assert command.q is not None
        assert command.qd is not None
        found.append(command.q)
        qd = command.qd
    return np.array(found[1:])


def test_it_grows_goes_round_and_fades(rhythm: PeriodicDmp) -> None:
    controller = rhythm.controller(ROBOT, turns=4.0)
    assert isinstance(controller, PeriodicController)
    q = run(controller, 9.0)
    t = PERIOD * np.arange(len(q))
    assert np.abs(q[0] - ROBOT.q_home).max() < 1e-9
    assert np.abs(np.diff(q, axis=0)).max() / PERIOD < 1.2 * 0.2 * np.pi  # never faster than it was shown
    full = (t > 3.0) & (t < 5.8)
    wanted = rhythm.g + rhythm.steady(2 * np.pi * t[full] / 2.0)[0]
    np.testing.assert_allclose(q[full], wanted, rtol=0, atol=2e-3)
    assert np.abs(q[-1] - rhythm.g).max() < 1e-3
    assert controller.done


def test_amplitude_period_and_baseline_are_free(rhythm: PeriodicDmp) -> None:
    there = rhythm.g + 0.05
    q = run(rhythm.controller(ROBOT, period=1.0, r=0.5, g=there), 3.0)
    last = q[-round(1.0 / PERIOD) :]
    np.testing.assert_allclose(np.ptp(last[:, :2], axis=0), [0.2, 0.1], rtol=0.01)
    np.testing.assert_allclose(last.mean(axis=0), there, rtol=0, atol=2e-3)


def test_the_baseline_may_be_set_while_it_runs(rhythm: PeriodicDmp) -> None:
    controller = rhythm.controller(ROBOT)
    run(controller, 1.0)
    controller.goal = rhythm.g + 0.05
    assert np.allclose(controller.goal, rhythm.g + 0.05)


def test_bad_input_gets_a_sentence(rhythm: PeriodicDmp) -> None:
    for misuse in (
        lambda: rhythm.controller(ROBOT, turns=0.0),
        lambda: rhythm.controller(ROBOT, period=-1.0),
        lambda: rhythm.controller(ROBOT, g=np.full(7, 9.0)),
        lambda: rhythm.controller(robots.load("ur5e")),
    ):
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse()
