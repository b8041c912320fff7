"""The postures that inverse kinematics returns, by the exact poses of their tools: errors are told as they are."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import kernels

sys.path.insert(0, str(Path(__file__).with_name("exact")))

from chains import Motion, arm
from rigid import array, exact, logarithm, mp, position_of, rotation_of

N, TOLERANCE = 6, 1e-9
ROUNDING = 2e-15  # m and rad, of an arm of about 2 m
FRAMES, PRISMATIC, _ = arm(N, N)
SEEDS = np.random.default_rng(53).uniform(-1.2, 1.2, (5, N))
Runs = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]


def tool(q: np.ndarray) -> Any:
    return Motion(FRAMES, PRISMATIC, exact(q)).transform(N + 1)


def goals() -> np.ndarray:
    """Return poses of postures, of which one is next to another, and one is out of reach."""
    T = np.array([array(tool(q)) for q in SEEDS])
    T[3] = T[2]
    T[3, :3, 3] += [1e-9, -2e-9, 1e-7]
    T[4, :3, 3] += [0.0, 30.0, 0.0]
    return T


@pytest.fixture(scope="module")
def runs() -> Runs:
    """Goals, postures, errors and statuses of every way to ask."""
    T = goals()
    limits = np.full(N, 3.0)
    solver = kernels.InverseSolver(kernels.Chain(FRAMES, PRISMATIC), -limits, limits, np.zeros(N))
    path = T[2:4]
    tight: dict[str, Any] = {"position_tolerance": TOLERANCE, "rotation_tolerance": TOLERANCE}
    solved = solver.solve(T, starts=20, **tight)
    near = solver.follow(T[:3], SEEDS[:3] + 0.05, **tight)
    stopped = solver.follow(T, SEEDS + 0.3, steps=0, **tight)
    q, errors, counts = kernels.follow_path(solver, path, SEEDS[2] + 0.01, **tight)
    return {
        "solve": (T, *solved[:2], solved[2][:, 2]),
        "follow": (T[:3], *near[:2], near[2][:, 2]),
        "no step": (T, *stopped[:2], stopped[2][:, 2]),
        "path": (path, q, errors, counts[:, 1]),
    }


def apart(T: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return distance and angle between a goal and the tool at a posture, exactly."""
    now, goal = tool(q), exact(T)
    turn = logarithm(rotation_of(goal) * rotation_of(now).T)
    return array([mp.norm(position_of(goal) - position_of(now)), mp.norm(turn)])


WAYS: dict[str, Callable[[np.ndarray], bool]] = {
    "solve": lambda statuses: bool((statuses[:4] == 0).all() and statuses[4] != 0),
    "follow": lambda statuses: bool((statuses == 0).all()),
    "no step": lambda statuses: bool((statuses != 0).all()),
    "path": lambda statuses: bool((statuses == 0).all()),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_is_said_of_a_posture_is_true(way: str, runs: Runs) -> None:
    T, q, errors, statuses = runs[way]
    assert WAYS[way](statuses)
    found = np.array([apart(*row) for row in zip(T, q)])
    size = np.maximum(1.0, np.linalg.norm(T[:, :3, 3], axis=1))[:, None]
    assert np.all(np.abs(found - errors[:, :2]) <= ROUNDING * size)
    assert np.array_equal(statuses == 0, (found <= TOLERANCE + ROUNDING * size).all(axis=1))
