"""A hand leads smoothly, within limits, and the same way for the same seed."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.sim.events import HandPath

ROBOT = robots.load("yumi_right")


@pytest.mark.parametrize("seed", range(5))
def test_random_paths_are_smooth_and_inside(seed: int) -> None:
    path = HandPath.random(ROBOT, seed, 20.0)
    t = np.arange(0.0, 20.0, 0.004)
    q, qd = (np.array(values) for values in zip(*(path.at(at) for at in t)))
    assert ((q >= ROBOT.q_min) & (q <= ROBOT.q_max)).all()
    assert (np.abs(qd) <= 0.11 * ROBOT.qd_max).all()
    assert np.abs(np.diff(qd, axis=0)).max() < 0.02, "no steps of the speed"
    np.testing.assert_allclose(np.diff(q, axis=0) / 0.004, (qd[1:] + qd[:-1]) / 2, atol=2e-3)
    np.testing.assert_allclose(q[0], ROBOT.q_home)
    assert np.ptp(q, axis=0).max() > 0.1
    np.testing.assert_array_equal(path.at(7.0)[0], HandPath.random(ROBOT, seed, 20.0).at(7.0)[0])


def test_rows_are_met_and_it_rests_outside() -> None:
    path = HandPath(np.array([1.0, 2.0, 4.0]), np.array([[0.0], [1.0], [0.5]]))
    assert path.n == 1
    assert [float(path.at(t)[0][0]) for t in (0.0, 1.0, 2.0, 4.0, 9.0)] == [0.0, 0.0, 1.0, 0.5, 0.5]
    assert path.at(0.5)[1][0] == path.at(5.0)[1][0] == 0.0


@pytest.mark.parametrize(
    ("t", "q"),
    [([0.0], [[1.0]]), ([0.0, 0.0], [[1.0], [2.0]]), ([0.0, 1.0], [[1.0], [np.nan]]), ([0.0, 1.0], [1.0, 2.0])],
)
def test_wrong_paths_are_refused(t: list[float], q: list[float]) -> None:
    with pytest.raises(ShapeError):
        HandPath(np.array(t), np.array(q))
