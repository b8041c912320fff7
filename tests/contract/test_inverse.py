"""The compiled inverse kinematics gives what the NumPy reference gives: same steps, same starts, same reasons."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from armlab import robots
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
    np.testing.assert_allclose(native[1], reference[1], rtol=1e-6, atol=1e-12)
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
