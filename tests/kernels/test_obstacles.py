"""Obstacles against their oracle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import kernels, robots
from armlab.errors import ShapeError

from .. import oracles

ROBOT = robots.load("yumi_right")
SLIDING = np.zeros(7, dtype=bool)
SLIDING[2] = True


def pair(kind: str, rng: np.random.Generator, by_potential: bool) -> tuple[Any, Any]:
    if kind in ("plane", "space"):
        arm = 2 if kind == "plane" else 3
        return tuple(module.Obstacles(arm, None, None, 0.02, 0.5, by_potential) for module in (kernels, oracles))
    links, bodies = np.array([7.0, 3.0, 1.0]), rng.normal(0, 0.1, (3, 7))
    bodies[:, 6] = 0.02
    bodies[2, 3:6] = bodies[2, :3]  # a sphere
    chains = (module.Chain(ROBOT.chain.frames, SLIDING) for module in (kernels, oracles))
    modules = zip((kernels, oracles), chains)
    return tuple(module.Obstacles(chain, links, bodies, 0.02, 0.5, by_potential) for module, chain in modules)


def capsules(kind: str, rng: np.random.Generator, near: np.ndarray, count: int) -> np.ndarray:
    rows = np.concatenate([near + rng.normal(0, 0.2, (count, 3)) for _ in range(2)], axis=1)
    rows = np.concatenate([rows, rng.uniform(0, 0.05, (count, 1)), rng.normal(0, 0.3, (count, 3))], axis=1)
    if kind == "plane":
        rows[:, [2, 5, 9]] = 0.0
    rows[: count // 2, 3:6] = rows[: count // 2, :3]
    return rows


@given(st.sampled_from(["plane", "space", "arm"]), st.booleans(), st.integers(0, 5), st.integers(0, 999))
@settings(max_examples=40)
def test_what_obstacles_add_is_the_reference(kind: str, by_potential: bool, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ours, wanted = pair(kind, rng, by_potential)
    n = {"plane": 2, "space": 3, "arm": ROBOT.n}[kind]
    y, yd, g, ydd = rng.normal(0, 0.5, (4, n))
    near = ROBOT.chain.forward(y)[:3, 3] if kind == "arm" else np.append(y, np.zeros(3 - n))
    rows = capsules(kind, rng, near, count)
    for field in (ours, wanted):
        field.place(rows)
        field.advance(0.01)
    np.testing.assert_allclose(ours.distance(y[None]), wanted.distance(y[None]), rtol=0, atol=1e-13)
    found, specified = ours.add(y, yd, g, ydd), wanted.add(y, yd, g, ydd)
    np.testing.assert_allclose(found, specified, rtol=0, atol=1e-11 * max(1.0, np.abs(specified).max()))


@pytest.mark.parametrize("phase", ["time", "position"])
def test_steps_among_obstacles_are_the_reference(phase: str) -> None:
    """Into the reach of one that moves, with a goal that is filtered."""
    rng = np.random.default_rng(0)
    runs = []
    for module, around in zip((kernels, oracles), pair("space", rng, False)):
        law = module.Primitive(np.linspace(0, 1, 8), np.full(8, 0.1), np.ones((8, 3)), 25.0, 156.25, 1.0, 0.4, phase)
        around.place(np.array([[0.9, 0.1, 0.0, 0.9, 0.1, 0.0, 0.05, -0.1, 0.0, 0.0]]))
        one = module.PrimitiveStepper(law, 12.5, around)
        one.start(np.zeros(3), np.zeros(3), np.array([1.2, 0.5, -0.5]), np.ones(3), 0.3)
        first = one.follow(np.arange(8) * 0.01)
        one.change_goal(np.array([1.5, 0.4, -0.4]), np.ones(3))
        runs.append([*first, *one.follow(np.array([0.0, 0.05, 0.06])), around.distance(first[0])])
    for ours, wanted in zip(*runs, strict=True):
        np.testing.assert_allclose(ours, wanted, rtol=0, atol=1e-11 * max(1.0, np.abs(wanted).max()))


def test_the_same_is_refused() -> None:
    good = np.zeros((1, 10))
    chain = kernels.Chain(ROBOT.chain.frames, SLIDING)
    space = kernels.Obstacles(3, None, None, 0.02, 0.1)
    law = kernels.Primitive([0.5], [0.5], np.ones((1, 2)), 25.0, 156.25, 1.0, 0.4, "time")
    for words, call in {
        "0 <= clearance < reach": lambda m=kernels: m.Obstacles(3, None, None, 0.2, 0.1),
        "2 or 3 axes of the space": lambda m=kernels: m.Obstacles(4, None, None, 0.0, 0.1),
        "links from 1 to 7": lambda m=kernels, c=chain: m.Obstacles(c, [8.0], good[:, :7], 0.0, 0.1),
        "radius of 0 or more": lambda f=space: f.place(good - 1.0),
        "finite capsules": lambda f=space: f.place(good * np.nan),
        "capsules of shape": lambda f=space: f.place(np.zeros((1, 7))),
        "finite y": lambda f=space: f.add(np.full(3, np.nan), good[0, :3], good[0, :3], good[0, :3]),
        "obstacles for 2 coordinates": lambda m=kernels, f=space, p=law: m.PrimitiveStepper(p, 0.0, f),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()


@pytest.mark.parametrize("kind", ["plane", "space", "arm"])
def test_a_distance_that_is_not_known_is_no_large_one(kind: str) -> None:
    n = {"plane": 2, "space": 3, "arm": ROBOT.n}[kind]
    for field in pair(kind, np.random.default_rng(0), False):
        field.place(capsules(kind, np.random.default_rng(1), np.zeros(3), 3))
        for i in range(n):
            y = np.where(np.arange(n) == i, np.nan, 0.3)
            assert np.isnan(field.distance(y)), i
