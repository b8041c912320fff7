"""Inverse kinematics of poses and along paths: bounds, reasons and refusals.

Laws of solutions, reasons and objectives are in tests/kinematics, those of the reported errors in tests/numerics.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from armlab import kernels, robots
from armlab.errors import ShapeError

SOLVED, LIMITS, BOUND = 0, 2, 5


def solver(name: str) -> kernels.InverseSolver:
    robot = robots.load(name)
    return kernels.InverseSolver(robot.chain, robot.q_min, robot.q_max, robot.q_home)


def goals(name: str, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    robot = robots.load(name)
    q = np.random.default_rng(seed).uniform(robot.q_min, robot.q_max, (count, robot.n))
    return q, robot.chain.forward(q)


def wave(name: str, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A smooth joint path inside the limits and its poses."""
    robot, rng = robots.load(name), np.random.default_rng(seed)
    middle, range_ = (robot.q_min + robot.q_max) / 2, np.minimum(robot.q_max - robot.q_min, np.pi)
    s = np.linspace(0, 1, count)[:, None]
    q = middle + range_ * 0.3 * np.sin(2 * np.pi * (rng.uniform(0.2, 0.6, robot.n) * s + rng.random(robot.n)))
    return q, robot.chain.forward(q)


def test_follow_stays_within_the_bound_and_says_when_that_is_in_the_way() -> None:
    robot, (q, T) = robots.load("yumi_left"), goals("yumi_left", 50, seed=3)
    start = np.clip(q + 0.1, robot.q_min, robot.q_max)
    for change in (0.0, 0.01, 0.2):
        found, _, counts, _ = solver("yumi_left").follow(T, q + 0.1, change)
        assert np.abs(found - start).max() <= change + 1e-15
        assert (counts[:, 1] == 1).all()
        moved = np.abs(start - q).max(axis=1) > change
        assert set(counts[moved, 2]) <= {SOLVED, LIMITS, BOUND}
        assert (counts[:, 2] == BOUND).any() == (change < 0.1)
    free = solver("yumi_left").follow(T, q + 0.1)
    one = solver("yumi_left").solve(T, q + 0.1, starts=1)
    there = free[2][:, 2] == SOLVED
    np.testing.assert_array_equal(free[0][there], one[0][there])


def test_a_history_ends_at_the_errors() -> None:
    q, T = goals("yumi_left", 8, seed=6)
    _, errors, counts, history = solver("yumi_left").follow(T, q + 0.1, 0.3, history=True)
    assert history is not None
    for row, error, (steps, _, status) in zip(history, errors, counts, strict=True):
        if status == SOLVED:
            np.testing.assert_array_equal(row[steps], error[:2])
        assert np.isnan(row[steps + 1 :]).all()


def test_paths_follow_a_posture_for_each_row() -> None:
    q, T = wave("yumi_left", 25, seed=3)
    own = {"objective": 1, "reference": q, "scale": np.ones(7)}
    found = kernels.follow_path(solver("yumi_left"), T, q[0], **own)[0]
    np.testing.assert_allclose(found, q, rtol=0, atol=1e-6)


def test_paths_keep_to_the_change_or_break() -> None:
    q, T = wave("irb2400", 60, seed=1)
    whole, _, counts = kernels.follow_path(solver("irb2400"), T, q[0], change=np.full(6, np.inf))
    np.testing.assert_allclose(whole, q, rtol=0, atol=1e-6)
    assert not counts[:, 1:].any()
    gap = T[[*range(20), *range(50, 60)]]
    jumped, _, counts = kernels.follow_path(solver("irb2400"), gap, q[0], change=np.full(6, 0.1))
    assert np.flatnonzero(counts[:, 1]).tolist() == [20]
    assert np.abs(np.diff(np.delete(jumped, 20, axis=0), axis=0)[:19]).max() <= 0.1


def test_empty_path() -> None:
    q, errors, counts = kernels.follow_path(solver("irb2400"), np.zeros((0, 4, 4)))
    assert (q.shape, errors.shape, counts.shape) == ((0, 6), (0, 3), (0, 3))


EYE, TWO = np.eye(4), np.tile(np.eye(4), (2, 1, 1))
REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("solve", {"task": 4}, "task of 6, 5, 3 or 2 rows, got 4"),
    ("solve", {"objective": 4}, "objective from 0 to 3, got 4"),
    ("solve", {"scale": np.zeros(3)}, r"scale of shape \(7,\), got \(3,\)"),
    ("solve", {"reference": np.zeros((2, 7))}, r"Expected posture of shape \(7,\) or one posture per goal"),
    ("solve", {"q0": np.zeros(6)}, r"q0 of shape \(7,\) or one posture per goal of T_base_tool \(4, 4\), got \(6,\)"),
    ("solve", {"starts": 0}, "starts >= 1"),
    ("solve", {"axis": (0.0, 0.0, 0.0)}, "no length"),
    ("solve", {"T_base_tool": np.zeros((2, 4, 4))}, r"T_base_tool\[0\] that is not"),
    ("follow", {"q0": np.zeros(7), "change": -1.0}, "change >= 0, got -1"),
    ("path", {"T_base_tool": EYE}, r"shape \(N, 4, 4\), poses in path order, got \(4, 4\)"),
    ("path", {"T_base_tool": np.zeros((2, 3, 3))}, r"shape \(\.\.\., 4, 4\), got \(2, 3, 3\)"),
    ("path", {"T_base_tool": np.stack([EYE, 2 * EYE])}, r"got T_base_tool\[1\] that is not"),
    ("path", {"T_base_tool": np.full((1, 4, 4), np.nan)}, r"got T_base_tool\[0\] that is not"),
    ("path", {"q0": np.zeros(6)}, r"q0 of shape \(7,\), got \(6,\)"),
    ("path", {"q0": np.full(7, np.inf)}, "finite joint positions, got NaN or Inf in q0"),
    ("path", {"change": np.full(7, np.nan)}, "change >= 0, got another value"),
    ("path", {"change": np.full(7, -0.1)}, "change >= 0, got another value"),
    ("path", {"change": np.zeros(6)}, r"change of shape \(7,\), got \(6,\)"),
    ("path", {"reference": np.zeros(6)}, r"Expected posture of shape \(7,\) or one posture per goal"),
    ("path", {"reference": np.full((2, 7), np.inf)}, r"NaN or Inf in posture\[0\]"),
    ("path", {"scale": np.ones(5)}, r"scale of shape \(7,\), got \(5,\)"),
    ("path", {"objective": 4}, "an objective from 0 to 3"),
    ("path", {"task": 4}, "a task of 6, 5, 3 or 2 rows, got 4"),
    ("path", {"axis": np.zeros(3)}, "Expected axis to be a direction"),
    ("path", {"starts": 0}, "starts >= 1"),
]


@pytest.mark.parametrize(("way", "change", "words"), REFUSED)
def test_refusals(way: str, change: dict[str, Any], words: str) -> None:
    one, T = solver("yumi_left"), TWO if way == "path" else EYE
    call = partial(kernels.follow_path, one) if way == "path" else getattr(one, way)
    with pytest.raises(ShapeError, match=words):
        call(**{"T_base_tool": T} | change)


def test_refused_limits() -> None:
    chain = kernels.Chain(TWO.repeat(2, axis=0)[:3], [False, False])
    with pytest.raises(ShapeError, match="q_min <= q_home <= q_max and a finite q_home, got other values at joint 2"):
        kernels.InverseSolver(chain, [0.0, 1.0], [1.0, 2.0], [0.5, 0.5])
    with pytest.raises(ShapeError, match=r"q_max of shape \(2,\), got \(3,\)"):
        kernels.InverseSolver(chain, [0.0, 1.0], [1.0, 2.0, 3.0], [0.5, 1.5])
