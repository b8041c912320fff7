"""The compiled inverse kinematics gives what the NumPy reference gives: same steps, same starts, same reasons."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native

TASKS = (6, 5, 3, 2)


def solver(module: Any, name: str, seed: int = 0) -> Any:
    robot = robots.load(name)
    return module.InverseSolver(
        module.Chain(robot.frames, robot.prismatic), robot.q_min, robot.q_max, robot.q_home, seed
    )


def goals(name: str, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    robot = robots.load(name)
    q = np.random.default_rng(seed).uniform(robot.q_min, robot.q_max, (count, robot.n))
    return q, robot.chain.forward(q)


def assert_same(native: tuple, reference: tuple) -> None:
    np.testing.assert_array_equal(native[2], reference[2])
    there = native[2][..., 2] == 0
    # Near singular poses the last bits of a sine move a joint by ten thousand times as much.
    np.testing.assert_allclose(native[0][there], reference[0][there], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(native[1], reference[1], rtol=0.0, atol=1e-9)
    assert (native[3] is None) == (reference[3] is None)
    if native[3] is not None:
        np.testing.assert_allclose(native[3][there], reference[3][there], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["yumi_left", "irb7600"])
@pytest.mark.parametrize("task", TASKS)
def test_same_solutions(name: str, task: int) -> None:
    q, T = goals(name, 30, seed=task)
    axis = np.array([1.0, -2.0, 0.5])
    native, reference = solver(_native, name, seed=7), solver(_reference, name, seed=7)
    assert_same(*(s.solve(T, task=task, axis=axis, history=True) for s in (native, reference)))
    assert_same(*(s.solve(T, q + 0.1, task=task, axis=axis) for s in (native, reference)))
    assert_same(*(s.follow(T, q + 0.1, 0.3, task=task, axis=axis, history=True) for s in (native, reference)))


@pytest.mark.parametrize("objective", [1, 2, 3])
@pytest.mark.parametrize("task", [6, 5])
def test_same_objectives(task: int, objective: int) -> None:
    """To 1e-9: second derivatives come from differences, whose rounding is not the same."""
    robot = robots.load("yumi_left")
    _, T = goals("yumi_left", 8, seed=objective)
    options = {
        "task": task,
        "axis": (0.3, 0.5, 0.8),  # about the last joint's own axis it would change nothing, and the optimum be a line
        "objective": objective,
        "reference": (robot.q_min + robot.q_max) / 2,
        "scale": 2 / (robot.q_max - robot.q_min),
    }
    native, reference = (solver(module, "yumi_left").solve(T, **options) for module in (_native, _reference))
    np.testing.assert_array_equal(native[2][:, 1:], reference[2][:, 1:])
    assert np.abs(native[2][:, 0] - reference[2][:, 0]).max() <= 2  # of the last steps, which are rounding
    np.testing.assert_allclose(native[0], reference[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(native[1][:, 2], reference[1][:, 2], rtol=0.0, atol=1e-9)


def test_same_reasons() -> None:
    """Beyond reach, out of reach among the links, outside the limits, without a step, held by the bound."""
    _, T = goals("yumi_left", 12, seed=8)
    T[:2, :3, 3] += 10.0
    T[2:7, :3, 3] += 0.3
    native, reference = solver(_native, "yumi_left"), solver(_reference, "yumi_left")
    home = robots.load("yumi_left").q_home
    seen = set()
    for options in ({"starts": 12}, {"starts": 1}, {"starts": 1, "steps": 3}, {"starts": 3, "task": 3}):
        both = [s.solve(T, home, **options) for s in (native, reference)]
        np.testing.assert_array_equal(both[0][2], both[1][2])
        seen |= set(both[0][2][:, 2])
    for change in (0.0, 0.5, 2.0):
        both = [s.follow(T, home, change) for s in (native, reference)]
        np.testing.assert_array_equal(both[0][2], both[1][2])
        assert max(np.abs(q - home).max() for q, *_ in both) <= change + 1e-15
        seen |= set(both[0][2][:, 2])
    assert seen >= {0, 1, 2, 4, 5}


def test_follow_keeps_within_the_bound() -> None:
    q, T = goals("yumi_left", 50, seed=3)
    for change in (0.0, 0.01, 0.2):
        found, _, counts, _ = solver(_native, "yumi_left").follow(T, q + 0.1, change)
        robot = robots.load("yumi_left")
        start = np.clip(q + 0.1, robot.q_min, robot.q_max)
        assert np.abs(found - start).max() <= change + 1e-15
        assert (counts[:, 1] == 1).all()
    free = solver(_native, "yumi_left").follow(T, q + 0.1)
    one = solver(_native, "yumi_left").solve(T, q + 0.1, starts=1)
    there = free[2][:, 2] == 0
    np.testing.assert_array_equal(free[0][there], one[0][there])


BOTH = pytest.mark.parametrize("module", [_native, _reference], ids=["native", "reference"])


@BOTH
@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"task": 4}, "task of 6, 5, 3 or 2 rows, got 4"),
        ({"objective": 4}, "objective from 0 to 3, got 4"),
        ({"scale": np.zeros(3)}, r"scale of shape \(7,\), got \(3,\)"),
        ({"reference": np.zeros((2, 7))}, r"Expected posture of shape \(7,\) or one posture per goal"),
        ({"q0": np.zeros(6)}, r"q0 of shape \(7,\) or one posture per goal of T_base_tool \(4, 4\), got \(6,\)"),
        ({"starts": 0}, "starts >= 1"),
        ({"axis": (0.0, 0.0, 0.0)}, "no length"),
        ({"T_base_tool": np.zeros((2, 4, 4))}, r"T_base_tool\[0\] that is not"),
    ],
)
def test_wrong_arguments(module: Any, change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        solver(module, "yumi_left").solve(**({"T_base_tool": np.eye(4)} | change))


@BOTH
def test_wrong_bounds_and_limits(module: Any) -> None:
    with pytest.raises(ShapeError, match="change >= 0, got -1"):
        solver(module, "yumi_left").follow(np.eye(4), np.zeros(7), -1.0)
    chain = module.Chain(np.tile(np.eye(4), (3, 1, 1)), [False, False])
    with pytest.raises(ShapeError, match="q_min <= q_home <= q_max and a finite q_home, got others at joint 2"):
        module.InverseSolver(chain, [0.0, 1.0], [1.0, 2.0], [0.5, 0.5])
    with pytest.raises(ShapeError, match=r"q_max of shape \(2,\), got \(3,\)"):
        module.InverseSolver(chain, [0.0, 1.0], [1.0, 2.0, 3.0], [0.5, 1.5])
