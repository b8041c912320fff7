"""Inverse kinematics, of poses and along paths, against its oracle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import kernels, robots
from armlab.errors import ShapeError

from .. import oracles

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
    native, reference = solver(kernels, name, seed=7), solver(oracles, name, seed=7)
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
    native, reference = (solver(module, "yumi_left").solve(T, **options) for module in (kernels, oracles))
    np.testing.assert_array_equal(native[2][:, 1:], reference[2][:, 1:])
    assert np.abs(native[2][:, 0] - reference[2][:, 0]).max() <= 2  # of the last steps, which are rounding
    np.testing.assert_allclose(native[0], reference[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(native[1][:, 2], reference[1][:, 2], rtol=0.0, atol=1e-9)


def test_same_reasons() -> None:
    """Beyond reach, out of reach among the links, outside the limits, without a step, held by the bound."""
    _, T = goals("yumi_left", 12, seed=8)
    T[:2, :3, 3] += 10.0
    T[2:7, :3, 3] += 0.3
    native, reference = solver(kernels, "yumi_left"), solver(oracles, "yumi_left")
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
        found, _, counts, _ = solver(kernels, "yumi_left").follow(T, q + 0.1, change)
        robot = robots.load("yumi_left")
        start = np.clip(q + 0.1, robot.q_min, robot.q_max)
        assert np.abs(found - start).max() <= change + 1e-15
        assert (counts[:, 1] == 1).all()
    free = solver(kernels, "yumi_left").follow(T, q + 0.1)
    one = solver(kernels, "yumi_left").solve(T, q + 0.1, starts=1)
    there = free[2][:, 2] == 0
    np.testing.assert_array_equal(free[0][there], one[0][there])


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
def test_wrong_arguments(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        solver(kernels, "yumi_left").solve(**({"T_base_tool": np.eye(4)} | change))


def test_wrong_bounds_and_limits() -> None:
    with pytest.raises(ShapeError, match="change >= 0, got -1"):
        solver(kernels, "yumi_left").follow(np.eye(4), np.zeros(7), -1.0)
    chain = kernels.Chain(np.tile(np.eye(4), (3, 1, 1)), [False, False])
    with pytest.raises(ShapeError, match="q_min <= q_home <= q_max and a finite q_home, got others at joint 2"):
        kernels.InverseSolver(chain, [0.0, 1.0], [1.0, 2.0], [0.5, 0.5])
    with pytest.raises(ShapeError, match=r"q_max of shape \(2,\), got \(3,\)"):
        kernels.InverseSolver(chain, [0.0, 1.0], [1.0, 2.0, 3.0], [0.5, 1.5])


MODULES = [kernels, oracles]


def path_solver(module: Any, name: str) -> Any:
    robot = robots.load(name)
    return module.InverseSolver(module.Chain(robot.frames, robot.prismatic), robot.q_min, robot.q_max, robot.q_home)


def wave(name: str, count: int, seed: int, reach: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """A smooth joint path inside the limits and its poses."""
    robot, rng = robots.load(name), np.random.default_rng(seed)
    middle, range_ = (robot.q_min + robot.q_max) / 2, np.minimum(robot.q_max - robot.q_min, np.pi)
    s = np.linspace(0, 1, count)[:, None]
    q = middle + range_ * reach * np.sin(2 * np.pi * (rng.uniform(0.2, 0.6, robot.n) * s + rng.random(robot.n)))
    return q, robot.chain.forward(q)


def assert_same_path(native: tuple, reference: tuple) -> None:
    np.testing.assert_array_equal(native[2][:, 1:], reference[2][:, 1:])
    np.testing.assert_allclose(native[2][:, 0], reference[2][:, 0], rtol=0.05)  # rounding ends long searches
    np.testing.assert_allclose(native[0], reference[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(native[1][:, :2], reference[1][:, :2], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", ["yumi_left", "irb2400"])
@pytest.mark.parametrize("task", [6, 5, 3, 2])
def test_same_paths(name: str, task: int) -> None:
    q, T = wave(name, 60, seed=task)
    axis = (1.0, -2.0, 0.5)
    assert_same_path(*(_follow(module, name, T, q[0], task=task, axis=axis) for module in MODULES))


@pytest.mark.parametrize("objective", [1, 2, 3])
def test_same_postures(objective: int) -> None:
    q, T = wave("yumi_left", 12, seed=3)
    wanted = {"objective": objective, "reference": q.mean(axis=0), "scale": np.linspace(0.5, 1.0, 7)}
    native, reference = (_follow(m, "yumi_left", T, q[0], **wanted) for m in MODULES)
    np.testing.assert_array_equal(native[2][:, 1:], reference[2][:, 1:])
    np.testing.assert_allclose(native[0], reference[0], rtol=0.0, atol=1e-6)  # where rounds end is a matter of rounding


def test_same_postures_row_by_row() -> None:
    q, T = wave("yumi_left", 25, seed=3)
    for module in MODULES:
        found = _follow(module, "yumi_left", T, q[0], objective=1, reference=q, scale=np.ones(7))[0]
        np.testing.assert_allclose(found, q, rtol=0, atol=1e-6)


def test_same_breaks() -> None:
    """Out of reach and back, a jump, and a path that limits end."""
    q, T = wave("irb2400", 60, seed=1)
    far = T.copy()
    far[20:30, 0, 3] += 3.0
    assert_same_path(*(_follow(module, "irb2400", far, q[0]) for module in MODULES))
    gap = T[[*range(20), *range(50, 60)]]
    native, reference = (_follow(module, "irb2400", gap, q[0], change=np.full(6, 0.1)) for module in MODULES)
    assert_same_path(native, reference)
    assert native[2][20, 1] != 0
    assert_same_path(*(_follow(module, "irb2400", T, None) for module in MODULES))


def _follow(module: Any, name: str, T: np.ndarray, q0: Any, *arguments: Any, **settings: Any) -> tuple:
    return module.follow_path(path_solver(module, name), T, q0, *arguments, **settings)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"T_base_tool": np.eye(4)}, r"shape \(N, 4, 4\), one pose after the other, got \(4, 4\)"),
        ({"T_base_tool": np.zeros((2, 3, 3))}, r"shape \(\.\.\., 4, 4\), got \(2, 3, 3\)"),
        ({"T_base_tool": np.stack([np.eye(4), 2 * np.eye(4)])}, r"got T_base_tool\[1\] that is not"),
        ({"T_base_tool": np.full((1, 4, 4), np.nan)}, r"got T_base_tool\[0\] that is not"),
        ({"q0": np.zeros(7)}, r"q0 of shape \(6,\), got \(7,\)"),
        ({"q0": np.full(6, np.inf)}, "finite joint positions, got others in q0"),
        ({"change": np.full(6, np.nan)}, "change >= 0, got others"),
        ({"change": np.full(6, -0.1)}, "change >= 0, got others"),
        ({"change": np.zeros(7)}, r"change of shape \(6,\), got \(7,\)"),
        ({"reference": np.zeros(7)}, r"Expected posture of shape \(6,\) or one posture per goal"),
        ({"reference": np.full((2, 6), np.inf)}, r"others in posture\[0\]"),
        ({"scale": np.ones(5)}, r"scale of shape \(6,\), got \(5,\)"),
        ({"objective": 4}, "an objective from 0 to 3"),
        ({"task": 4}, "a task of 6, 5, 3 or 2 rows, got 4"),
        ({"axis": np.zeros(3)}, "Expected axis to be a direction"),
        ({"starts": 0}, "starts >= 1"),
    ],
)
def test_path_wrong_arguments(change: dict[str, Any], sentence: str) -> None:
    arguments: dict[str, Any] = {"T_base_tool": np.tile(np.eye(4), (2, 1, 1))} | change
    with pytest.raises(ShapeError, match=sentence):
        kernels.follow_path(path_solver(kernels, "irb2400"), **arguments)


def test_empty_path() -> None:
    q, errors, counts = kernels.follow_path(path_solver(kernels, "irb2400"), np.zeros((0, 4, 4)))
    assert (q.shape, errors.shape, counts.shape) == ((0, 6), (0, 3), (0, 3))


def test_every_bound_may_be_infinite() -> None:
    q, T = wave("irb2400", 5, seed=2)
    found = kernels.follow_path(path_solver(kernels, "irb2400"), T, q[0], change=np.full(6, np.inf))[0]
    np.testing.assert_allclose(found, q, rtol=0, atol=1e-6)
