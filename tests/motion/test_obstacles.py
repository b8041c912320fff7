"""Obstacles: gone around with the clearance asked, in two and three dimensions, and not felt from afar."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.motion import Dmp, fit_dmp
from armlab.motion.obstacles import FORMS, Obstacle, avoid

U = np.linspace(0.0, 1.0, 251)
S = U**3 * (10 - 15 * U + 6 * U**2)
T = np.linspace(0.0, 3.0, 401)


@pytest.fixture(scope="module")
def space() -> Dmp:
    return fit_dmp(U, np.stack([0.5 * S, 0.1 * np.sin(np.pi * S), 0.2 * S], axis=1), n_basis=20).value


@pytest.fixture(scope="module")
def plane() -> Dmp:
    return fit_dmp(U, np.stack([0.5 * S, 0.2 * S], axis=1), n_basis=20).value


def succeeds(dmp: Dmp, scene: list[Obstacle], form: str, clearance: float = 0.02) -> bool:
    run = avoid(dmp, T, scene, clearance=clearance, reach=0.1, form=form)
    least = min(one.nearest(y)[0] for one in scene for y in run.y)
    return bool(np.abs(run.y[-1] - dmp.g).max() < 1e-3 and least > clearance - 1e-6)


def scenes(dmp: Dmp, count: int) -> list[list[Obstacle]]:
    """Three spheres each, near the path, their surfaces 5 cm from start and goal."""
    rng, path, found = np.random.default_rng(0), dmp.rollout(U).y, []
    for _ in range(count):
        scene: list[Obstacle] = []
        while len(scene) < 3:
            one = Obstacle.sphere(path[rng.integers(50, 200)] + rng.normal(0, 0.03, dmp.n), rng.uniform(0.01, 0.04))
            if min(one.nearest(p)[0] for p in (dmp.y0, dmp.g)) > 0.05:
                scene.append(one)
        found.append(scene)
    return found


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("count", [3, pytest.param(100, marks=pytest.mark.slow)])  # 8 s each
def test_random_scenes(space: Dmp, form: str, count: int) -> None:
    reached = sum(succeeds(space, scene, form) for scene in scenes(space, count))
    assert reached >= 0.99 * count


@pytest.mark.parametrize("form", FORMS)
def test_head_on_point_and_capsule(plane: Dmp, form: str) -> None:
    """The path is a straight line, so the velocity points at the centre."""
    middle = 0.5 * (plane.y0 + plane.g)
    assert succeeds(plane, [Obstacle.sphere(middle)], form)
    across = np.array([-0.2, 0.5]) / 8
    assert succeeds(plane, [Obstacle(middle - across, middle + across, 0.01)], form)


@pytest.mark.parametrize("form", FORMS)
def test_what_is_far_away_or_not_there_is_not_felt(space: Dmp, form: str) -> None:
    for scene in ([], [Obstacle.sphere([0.2, 0.6, 0.1], 0.1)]):
        run = avoid(space, U, scene, clearance=0.02, reach=0.1, form=form)
        np.testing.assert_allclose(run.y, space.rollout(U).y, rtol=0, atol=1e-6)


def test_distances_of_a_capsule() -> None:
    one = Obstacle(np.zeros(2), np.array([1.0, 0.0]), 0.1)
    for point, distance, away in (([0.5, 1.0], 0.9, [0, 1]), ([2.0, 0.0], 0.9, [1, 0]), ([-1.0, 0.0], 0.9, [-1, 0])):
        d, n = one.nearest(np.array(point))
        assert d == pytest.approx(distance)
        np.testing.assert_allclose(n, away, atol=1e-12)
    d, n = one.nearest(np.array([0.5, 0.0]))  # on the segment: any direction across
    assert d == -0.1
    np.testing.assert_allclose(np.abs(n), [0, 1], atol=1e-12)


def test_bad_input_is_refused_by_a_sentence(space: Dmp, plane: Dmp) -> None:
    near = [Obstacle.sphere(space.g + 0.01, 0.05)]
    for words, call in {
        "goal outside the clearance": lambda: avoid(space, U, near, clearance=0.02, reach=0.1),
        "in their space": lambda: avoid(plane, U, near, clearance=0.02, reach=0.1),
        "finite point": lambda: Obstacle.sphere([0.0, np.nan, 0.0]),
        "radius of 0 or more": lambda: Obstacle.sphere([0.0, 0.0], -1.0),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
    with pytest.raises(ConfigError, match="clearance < reach"):
        avoid(space, U, [], clearance=0.2, reach=0.1)
    with pytest.raises(ConfigError, match="two or three"):
        avoid(fit_dmp(U, S, n_basis=8).value, U, [], clearance=0.0, reach=0.1)
    with pytest.raises(UnknownName, match="form"):
        avoid(space, U, [], clearance=0.0, reach=0.1, form="wall")
