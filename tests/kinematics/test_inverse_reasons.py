"""Inverse kinematics where there is no solution: the nearest posture comes back, with the true reason."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.errors import NotConverged
from armlab.kinematics import Inverse, forward, inverse
from armlab.robots import Robot


def inside(robot: Robot, q: np.ndarray) -> bool:
    return bool(np.all((robot.q_min <= q) & (q <= robot.q_max)))


def moved_poses(robot: Robot, count: int, seed: int) -> np.ndarray:
    return forward(robot, np.random.default_rng(seed).uniform(robot.q_min, robot.q_max, (count, robot.n)))


def planar(*lengths: float, **limits: tuple[float, ...]) -> Robot:
    """Joint axes all along z: what it reaches is known from school."""
    zeros = np.zeros(len(lengths))
    return robots.from_dh("planar", zeros, lengths, zeros, zeros, **limits)  # type: ignore[arg-type]


def at(x: float, y: float, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


REACH = planar(1.0, 0.5)
BENT = planar(1.0, 0.5, q_min=(-np.pi, 0.5), q_max=(np.pi, 1.0))


@pytest.mark.parametrize(
    ("robot", "T", "q0", "options", "reason", "least"),
    [
        # further than the links are long, in front of the shortest reach, beside the plane: distances are known
        (REACH, at(3.0, 0.0), (0.1, 0.2), {}, "out of reach", 1.5),
        (REACH, at(0.2, 0.0), (0.1, 0.2), {}, "out of reach", 0.3),
        (REACH, at(0.6, 0.6, 0.1), (0.1, 0.2), {}, "out of reach", 0.1),
        (REACH, at(0.6, 0.6, 0.1), (0.1, 0.2), {"starts": 1}, "out of reach", 0.1),
        (REACH, at(1.5 + 1e-6, 0.0), (0.1, 0.2), {}, "out of reach", 1e-6),
        # the elbow would have to bend by 2 rad; at its limit the distance is that of the two circles
        (
            BENT,
            forward(REACH, (0.3, 2.0)),
            (0.3, 0.7),
            {},
            "limits",
            np.sqrt(1.25 + np.cos(1)) - np.sqrt(1.25 + np.cos(2)),
        ),
        (BENT, forward(REACH, (0.3, 2.0)), (0.3, 0.7), {"starts": 1}, "limits", 0.0),
        # the goal lies on the stretched arm: no joint moves towards it, another start gets there
        (REACH, at(1.2, 0.0), (0.0, 0.0), {"starts": 1}, "singular", 0.3),
        (REACH, at(1.2, 0.0), (0.0, 0.0), {}, "solved", 0.0),
        (REACH, forward(REACH, (0.3, 1.0)), (-2.0, 0.5), {"maxiter": 2, "starts": 1}, "iterations", 0.0),
        (REACH, at(1.5, 0.0), (0.3, 0.5), {"starts": 1}, "solved", 0.0),  # the last point that it reaches
    ],
)
def test_why_not(robot: Robot, T: np.ndarray, q0: tuple, options: dict, reason: str, least: float) -> None:
    """Where there is no solution the nearest posture comes back, with the true reason."""
    result = inverse(robot, T, q0, task="position", **options)
    assert result.reason == reason
    assert bool(result.success) == (reason == "solved")
    assert inside(robot, result.q)
    distance = np.linalg.norm(forward(robot, result.q)[:3, 3] - T[:3, 3])
    np.testing.assert_allclose(result.position_error, distance, rtol=0, atol=1e-14)
    if (reason != "iterations" and options.get("starts") != 1) or reason == "singular":
        assert least - 1e-9 <= distance <= least * (1 + 1e-3) + 1e-9
    assert reason == "solved" or f"Not solved ({reason}" in result.report()


def test_unreachable_poses_end_soon_and_stay_finite() -> None:
    robot = robots.load("yumi_left")
    T = moved_poses(robot, 30, seed=3)
    T[::2, :3, 3] += 0.4
    T[1::2, :3, 3] *= 1e6
    result = inverse(robot, T, maxiter=50, starts=30)
    assert np.isfinite(result.q).all()
    assert inside(robot, result.q)
    assert (result.reason[1::2] == "out of reach").all()  # type: ignore[index]
    assert result.iterations.max() <= 50 * (30 + 1 + 10)


def test_turns_are_taken_back_into_the_limits() -> None:
    """A joint that may turn more than once: the solution outside the limits is also one inside."""
    robot = planar(1.0, 0.5, q_min=(-4.0, 3.3), q_max=(4.0, 6.0))
    result = inverse(robot, forward(robot, (0.5, 4.0)), (0.4, 3.3), task="position")
    assert result.success
    assert inside(robot, result.q)


def test_reports() -> None:
    robot = robots.load("irb2400")
    T = moved_poses(robot, 4, seed=1)
    one = inverse(robot, forward(robot, robot.q_home), robot.q_home)
    assert repr(one) == "Inverse(Solved to 0 m and 0 rad in 0 iterations from 1 start.)"
    T[2, 0, 3] += 10.0
    text = inverse(robot, T.reshape(2, 2, 4, 4)).report()
    assert text.startswith("3 of 4 goals solved, to ")
    assert text.endswith("; not solved: 1 out of reach, first at index 1, 0.")
    assert inverse(robot, T[2:3]).report() == "0 of 1 goals solved; not solved: 1 out of reach, first at index 0."


def test_strict_raises_with_the_result() -> None:
    robot = robots.load("irb2400")
    T = forward(robot, robot.q_home)
    assert inverse(robot, T, strict=True).success
    T[0, 3] += 10.0
    with pytest.raises(NotConverged, match="out of reach") as caught:
        inverse(robot, T, strict=True)
    best = caught.value.best
    assert isinstance(best, Inverse)
    np.testing.assert_array_equal(best.q, inverse(robot, T).q)
