"""Ten constant speeds, both ways, with holds between them: on every robot, inside every limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError, UnknownName
from armlab.identify import friction_run


@pytest.mark.parametrize(("name", "joint"), [("yumi_left", 0), ("yumi_right", 5), ("irb2400", 2), ("ur5e", 1)])
def test_constant_speeds_both_ways_with_holds(name: str, joint: int) -> None:
    robot = robots.load(name)
    run = friction_run(robot, joint)
    t = np.arange(0, run.seconds, 0.004)
    q, qd, qdd = run.sample(t)
    assert np.all(q >= robot.q_min)
    assert np.all(q <= robot.q_max)
    assert np.all(np.abs(qdd) <= 1.001 * robot.qdd_max)
    others = np.arange(robot.n) != joint
    assert not qd[:, others].any()
    steady = np.abs(qdd[:, joint]) == 0
    speeds, ways = steady_runs(t, q[:, joint], qd[:, joint], steady)
    top = 0.8 * robot.qd_max[joint]
    expected = np.geomspace(0.005, top, 10)
    np.testing.assert_allclose(np.abs(speeds[::2]), [*expected, expected[4]], rtol=1e-9)
    np.testing.assert_allclose(speeds[::2], -speeds[1::2], rtol=1e-9)
    gear = abs(1 / robot.coupling[joint, joint])
    period = np.pi / gear if gear > 1 else 0.03
    assert np.all(np.abs(ways) >= 10 * period - 2 * 0.004 * np.abs(speeds))
    np.testing.assert_allclose(q[-1], q[0], atol=1e-9)
    assert not qd[[0, -1]].any()


def steady_runs(t: np.ndarray, q: np.ndarray, qd: np.ndarray, steady: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return speed and way of each stretch of constant speed that is not a hold; check that holds last 2 s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], steady.astype(int), [0]]))).reshape(-1, 2)
    edges = edges[edges[:, 1] - edges[:, 0] > 3]
    speeds = np.array([np.median(qd[a:b]) for a, b in edges])
    ways = np.array([q[b - 1] - q[a] for a, b in edges])
    holds = np.array([t[b - 1] - t[a] for a, b in edges])[speeds == 0]
    assert np.all(holds > 1.98)
    return speeds[speeds != 0], ways[speeds != 0]


def test_derivatives_fit_together() -> None:
    robot = robots.load("yumi_left")
    run = friction_run(robot, robot.joint_names[3], at=robot.q_home)
    t = np.linspace(run.seconds - 60, run.seconds, 200001)
    q, qd, qdd = run.sample(t)
    np.testing.assert_allclose(np.gradient(q[:, 3], t)[1:-1], qd[1:-1, 3], atol=2e-3)
    np.testing.assert_allclose(np.gradient(qd[:, 3], t)[1:-1], qdd[1:-1, 3], atol=0.15)
    assert run.sample(np.array(0.0))[0].shape == (7,)


def test_a_short_joint_runs_less_fast_or_not_at_all() -> None:
    robot = robots.load("irb2400")
    low, high, home = robot.q_min.copy(), robot.q_max.copy(), robot.q_home.copy()
    low[0], high[0], home[0] = -0.3, 0.3, 0.0
    short = replace(robot, q_min=low, q_max=high, q_home=home)
    q, qd, _ = friction_run(short, 0).sample(np.arange(0, 400, 0.01))
    assert 0.05 < np.abs(qd[:, 0]).max() < 0.79 * robot.qd_max[0]
    assert np.abs(q[:, 0]).max() < 0.3
    low[0], high[0] = -0.1, 0.1
    with pytest.raises(ShapeError, match=r"room for a run of 0.3 rad .*Use identify\.design_excitation"):
        friction_run(replace(robot, q_min=low, q_max=high, q_home=home), 0)


def test_refusals() -> None:
    robot = robots.load("yumi_left")
    with pytest.raises(UnknownName, match="Expected the name of a joint, got 'elbow'"):
        friction_run(robot, "elbow")
    with pytest.raises(UnknownName, match="from 0 to 6, got 7"):
        friction_run(robot, 7)
    for wrong in (1.5, True, None):
        with pytest.raises(UnknownName, match="number of a joint from 0 to 6"):
            friction_run(robot, wrong)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"pose of shape \(7,\)"):
        friction_run(robot, 0, at=np.full(7, 9.0))
    with pytest.raises(ShapeError, match="limits of speed and acceleration"):
        friction_run(replace(robot, qd_max=np.full(7, np.inf)), 0)
