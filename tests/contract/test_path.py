"""The compiled path follower gives what the NumPy reference gives: same postures, same breaks."""

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

MODULES = [_native, _reference]


def solver(module: Any, name: str) -> Any:
    robot = robots.load(name)
    return module.InverseSolver(module.Chain(robot.frames, robot.prismatic), robot.q_min, robot.q_max, robot.q_home)


def wave(name: str, count: int, seed: int, reach: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """A smooth joint path inside the limits and its poses."""
    robot, rng = robots.load(name), np.random.default_rng(seed)
    middle, range_ = (robot.q_min + robot.q_max) / 2, np.minimum(robot.q_max - robot.q_min, np.pi)
    s = np.linspace(0, 1, count)[:, None]
    q = middle + range_ * reach * np.sin(2 * np.pi * (rng.uniform(0.2, 0.6, robot.n) * s + rng.random(robot.n)))
    return q, robot.chain.forward(q)


def assert_same(native: tuple, reference: tuple) -> None:
    np.testing.assert_array_equal(native[2][:, 1:], reference[2][:, 1:])
    np.testing.assert_allclose(native[2][:, 0], reference[2][:, 0], rtol=0.05)  # rounding ends long searches
    np.testing.assert_allclose(native[0], reference[0], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(native[1][:, :2], reference[1][:, :2], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", ["yumi_left", "irb2400"])
@pytest.mark.parametrize("task", [6, 5, 3, 2])
def test_same_paths(name: str, task: int) -> None:
    q, T = wave(name, 60, seed=task)
    axis = (1.0, -2.0, 0.5)
    assert_same(*(_follow(module, name, T, q[0], task=task, axis=axis) for module in MODULES))


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
    assert_same(*(_follow(module, "irb2400", far, q[0]) for module in MODULES))
    gap = T[[*range(20), *range(50, 60)]]
    native, reference = (_follow(module, "irb2400", gap, q[0], change=np.full(6, 0.1)) for module in MODULES)
    assert_same(native, reference)
    assert native[2][20, 1] != 0
    assert_same(*(_follow(module, "irb2400", T, None) for module in MODULES))


def _follow(module: Any, name: str, T: np.ndarray, q0: Any, *arguments: Any, **settings: Any) -> tuple:
    return module.follow_path(solver(module, name), T, q0, *arguments, **settings)


@pytest.mark.parametrize("module", MODULES, ids=["native", "reference"])
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
def test_wrong_arguments(module: Any, change: dict[str, Any], sentence: str) -> None:
    arguments: dict[str, Any] = {"T_base_tool": np.tile(np.eye(4), (2, 1, 1))} | change
    with pytest.raises(ShapeError, match=sentence):
        module.follow_path(solver(module, "irb2400"), **arguments)


@pytest.mark.parametrize("module", MODULES, ids=["native", "reference"])
def test_empty_path(module: Any) -> None:
    q, errors, counts = module.follow_path(solver(module, "irb2400"), np.zeros((0, 4, 4)))
    assert (q.shape, errors.shape, counts.shape) == ((0, 6), (0, 3), (0, 3))


@pytest.mark.parametrize("module", MODULES, ids=["native", "reference"])
def test_every_bound_may_be_infinite(module: Any) -> None:
    q, T = wave("irb2400", 5, seed=2)
    found = module.follow_path(solver(module, "irb2400"), T, q[0], change=np.full(6, np.inf))[0]
    np.testing.assert_allclose(found, q, rtol=0, atol=1e-6)
