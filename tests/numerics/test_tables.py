"""Every kernel against tables of results computed with 50 digits and more; errors of inverse kinematics likewise."""

from __future__ import annotations

import inspect
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpmath import mp

from armlab import kernels
from armlab.lie import se3

RESULTS = runpy.run_path(str(Path(__file__).with_name("results.py")))
TABLES: dict[str, dict[str, Any]] = RESULTS["tables"]()
TABLED, LEFT_OUT = RESULTS["TABLED"], RESULTS["LEFT_OUT"]


@pytest.mark.parametrize("key", TABLES)
def test_errors_stay_within_their_bounds(key: str) -> None:
    found = RESULTS["result"](kernels, key, TABLES[key])
    assert RESULTS["error"](TABLES[key], found) <= RESULTS["bound"](key)


@pytest.mark.parametrize("key", ["groups/so3_log", "chains/rnea 5", "filters/SignalOperator lowpass"])
def test_an_error_in_the_thirteenth_digit_shows(key: str) -> None:
    wanted = TABLES[key]["wanted"]
    assert RESULTS["error"](TABLES[key], wanted) == 0.0
    assert RESULTS["error"](TABLES[key], wanted * (1.0 + 1e-13)) > RESULTS["bound"](key)
    assert not RESULTS["error"](TABLES[key], wanted * float("nan")) <= RESULTS["bound"](key)


@pytest.mark.parametrize("key", [key for key in TABLES if "wrench_interval" in key])
def test_an_interval_holds_the_exact_one(key: str) -> None:
    """Tie-breaking may only widen the interval."""
    found = RESULTS["result"](kernels, key, TABLES[key])
    inside = (found - TABLES[key]["wanted"]) * [1.0, -1.0]
    assert inside.max() <= 0.0


def kernel_names() -> Iterator[str]:
    """Yield the names of functions, and of methods with their class."""
    for name, kernel in vars(kernels._native).items():
        if name.startswith("_"):
            continue
        if not inspect.isclass(kernel):
            yield name
            continue
        yield from (f"{name}.{method}" for method, _ in inspect.getmembers(kernel, callable) if method[0] != "_")


def has_table(kernel: str) -> bool:
    words = TABLED.get(kernel, kernel.rpartition(".")[2]).split()
    return any(key.partition("/")[2].split()[: len(words)] == words for key in TABLES)


def test_every_kernel_has_a_table_or_a_reason() -> None:
    found = list(kernel_names())
    classes = {kernel.partition(".")[0] for kernel in found}
    left_out = {kernel for kernel in found if kernel in LEFT_OUT or kernel.partition(".")[0] in LEFT_OUT}
    assert {kernel for kernel in found if has_table(kernel)} == {*found} - left_out
    assert {*LEFT_OUT} <= {*found} | classes
    assert {*TABLED} <= {*found} - left_out
    assert {"Chain.rnea", "so3_exp"} <= {*found}


TOLERANCE = 1e-9
ROUNDING = 2e-15  # m and rad, of an arm of about 2 m
N = 6
FRAMES = se3.exp(np.random.default_rng(1).uniform(-0.8, 0.8, (N + 1, 6)))
ARM = kernels.Chain(FRAMES, np.arange(N) == 2)


def tool(q: np.ndarray) -> Any:
    """Return T_base_tool as the product of frames and joints, with 50 digits."""
    T = mp.matrix(ARM.frames[0].tolist())
    for value, slides, frame in zip(q.tolist(), ARM.prismatic, ARM.frames[1:], strict=True):
        Z = mp.eye(4)
        if slides:
            Z[2, 3] = value
        else:
            Z[0, 0] = Z[1, 1] = mp.cos(value)
            Z[1, 0], Z[0, 1] = mp.sin(value), -mp.sin(value)
        T = T * Z * mp.matrix(frame.tolist())
    return T


def apart(T: np.ndarray, q: np.ndarray) -> list[float]:
    """Return distance and angle between a goal and the tool at a posture."""
    now, goal = tool(q), mp.matrix(T.tolist())
    R = goal[:3, :3] * now[:3, :3].T
    sine = mp.norm(mp.matrix([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])) / 2
    return [float(mp.norm(goal[:3, 3] - now[:3, 3])), float(mp.atan2(sine, (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2))]


@pytest.fixture(scope="module")
def runs() -> Iterator[dict[str, tuple[np.ndarray, ...]]]:
    """Goals, postures, errors, statuses, and which errors must be 0, for every kind of query; one goal is next to
    another, one is out of reach."""
    seeds, limits = np.random.default_rng(53).uniform(-1.2, 1.2, (5, N)), np.full(N, 3.0)
    tight: dict[str, Any] = {"position_tolerance": TOLERANCE, "rotation_tolerance": TOLERANCE}
    with mp.workdps(50):
        T = np.array([np.array(tool(q).tolist(), dtype=float) for q in seeds])
        T[3] = T[2]
        T[3, :3, 3] += [1e-9, -2e-9, 1e-7]
        T[4, :3, 3] += [0.0, 30.0, 0.0]
        solver = kernels.InverseSolver(ARM, -limits, limits, np.zeros(N))
        solved = solver.solve(T, starts=20, **tight)
        near = solver.follow(T[:3], seeds[:3] + 0.05, **tight)
        stopped = solver.follow(T, seeds + 0.3, steps=0, **tight)
        q, errors, counts = kernels.follow_path(solver, T[2:4], seeds[2] + 0.01, **tight)
        yield {
            "solve": (T, *solved[:2], solved[2][:, 2], np.arange(5) < 4),
            "follow": (T[:3], *near[:2], near[2][:, 2], np.ones(3, dtype=bool)),
            "no step": (T, *stopped[:2], stopped[2][:, 2], np.zeros(5, dtype=bool)),
            "path": (T[2:4], q, errors, counts[:, 1], np.ones(2, dtype=bool)),
        }


@pytest.mark.parametrize("way", ["solve", "follow", "no step", "path"])
def test_inverse_kinematics_reports_true_errors(way: str, runs: dict[str, tuple[np.ndarray, ...]]) -> None:
    T, q, errors, statuses, wanted = runs[way]
    np.testing.assert_array_equal(statuses == 0, wanted)
    found = np.array([apart(*row) for row in zip(T, q, strict=True)])
    size = np.maximum(1.0, np.linalg.norm(T[:, :3, 3], axis=1))[:, None]
    assert np.all(np.abs(found - errors[:, :2]) <= ROUNDING * size)
    np.testing.assert_array_equal(statuses == 0, (found <= TOLERANCE + ROUNDING * size).all(axis=1))
