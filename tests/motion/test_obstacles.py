"""Obstacles: gone around with the clearance asked, in the plane, in space and with an arm; not felt from afar."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import ArmlabError, ConfigError, ShapeError, UnknownName
from armlab.motion import Dmp, fit_dmp
from armlab.motion.obstacles import FORMS, AvoidingDmp, Capsule, rows_of

U = np.linspace(0.0, 1.0, 251)
S = U**3 * (10 - 15 * U + 6 * U**2)
T = np.linspace(0.0, 3.0, 401)
FEW = 100
ROBOT = robots.load("yumi_right")
REACH = np.array([1.1, 0.1, 0.2, 0.2, -0.3, 0.4, 0.2])
CLEARANCE = 0.02


@pytest.fixture(scope="module")
def space() -> Dmp:
    return fit_dmp(U, np.stack([0.5 * S, 0.1 * np.sin(np.pi * S), 0.2 * S], axis=1), n_basis=20).value


@pytest.fixture(scope="module")
def plane() -> Dmp:
    return fit_dmp(U, np.stack([0.5 * S, 0.2 * S], axis=1), n_basis=20).value


@pytest.fixture(scope="module")
def arm() -> Dmp:
    return fit_dmp(2 * U, ROBOT.q_home + S[:, None] * REACH, n_basis=20).value


def avoiding(dmp: Dmp, scene: list[Capsule], form: str = "steering", **more: object) -> AvoidingDmp:
    return AvoidingDmp(dmp, scene, CLEARANCE, 0.1, form, **more)  # type: ignore[arg-type]


def succeeds(one: AvoidingDmp, t: np.ndarray = T) -> bool:
    run = one.rollout(t)
    return bool(np.abs(run.y[-1] - one.dmp.g).max() < 1e-3 and one.distance(run.y).min() > CLEARANCE - 1e-6)


def scenes(dmp: Dmp, count: int) -> list[list[Capsule]]:
    """Three spheres each, near the path, their surfaces 5 cm from start and goal."""
    rng, path, found = np.random.default_rng(0), dmp.rollout(U).y, []
    for _ in range(count):
        scene: list[Capsule] = []
        while len(scene) < 3:
            centre, radius = path[rng.integers(50, 200)] + rng.normal(0, 0.03, dmp.n), rng.uniform(0.01, 0.04)
            if min(np.linalg.norm(p - centre) for p in (dmp.y0, dmp.g)) - radius > 0.05:
                scene.append(Capsule.sphere(centre, radius))
        found.append(scene)
    return found


@pytest.mark.parametrize("form", FORMS)
def test_random_scenes(space: Dmp, form: str) -> None:
    made = scenes(space, FEW)
    hit = sum(avoiding(space, scene).distance(space.rollout(U).y).min() < CLEARANCE for scene in made)
    assert hit > 0.8 * len(made)  # the path itself does not keep the clearance
    assert sum(succeeds(avoiding(space, scene, form)) for scene in made) >= 0.99 * len(made)


@pytest.mark.parametrize("form", FORMS)
def test_head_on_point_and_capsule(plane: Dmp, form: str) -> None:
    """The path is a straight line, so the velocity points at the centre, and the start at the middle of a capsule."""
    middle = 0.5 * (plane.y0 + plane.g)
    assert succeeds(avoiding(plane, [Capsule.sphere(middle)], form))
    across = np.array([-0.2, 0.5]) / 8
    assert succeeds(avoiding(plane, [Capsule(middle - across, middle + across, 0.01)], form))


@pytest.mark.parametrize("form", FORMS)
def test_what_is_far_away_or_not_there_is_not_felt(space: Dmp, form: str) -> None:
    for scene in ([], [Capsule.sphere([0.2, 0.6, 0.1], 0.1)]):
        run, plain = avoiding(space, scene, form).rollout(U), space.rollout(U)
        np.testing.assert_allclose(run.y, plain.y, rtol=0, atol=1e-12)
        np.testing.assert_allclose(run.ydd, plain.ydd, rtol=0, atol=1e-9)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("v", [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [-0.3, 0.0, 0.0]])
def test_at_rest_nothing_is_added_and_towards_the_centre_it_is_finite(space: Dmp, form: str, v: list[float]) -> None:
    around = avoiding(space, [Capsule.sphere([0.25, 0.5, 0.0], 0.05)], form).around()
    for x in (0.1, 0.15, 0.25):  # within reach, nearer, in the centre
        added = around.add([x, 0.5, 0.0], v, [0.5, 0.5, 0.0], np.zeros(3))
        assert np.isfinite(added).all()
        assert v[0] or x > 0.1 or not added.any()  # at rest outside of the clearance


def test_the_steering_angle_is_that_of_the_paper(space: Dmp) -> None:
    """Hoffmann et al. (2009): ``gamma R v phi exp(-beta |phi|)`` with beta = 20 / pi."""
    around = avoiding(space, [Capsule.sphere([0.0, 0.07, 0.0], 0.05)]).around()  # its surface at the clearance
    phi = 0.3
    v = 0.02 * np.array([np.sin(phi), np.cos(phi), 0.0])
    side = np.array([np.cos(phi), -np.sin(phi), 0.0])
    wanted = 12.0 * phi * np.exp(-20.0 / np.pi * phi) * 0.02 * side
    push = around.add(np.zeros(3), v, np.ones(3), np.array([0.0, -9.0, 0.0])) - [0.0, -9.0, 0.0]  # no guard
    np.testing.assert_allclose(push, wanted, rtol=1e-12, atol=1e-15)


def test_fast_approach_is_braked_before_the_clearance(plane: Dmp) -> None:
    """Ten times as fast as the guard's own rate allows for."""
    near = avoiding(plane, [Capsule.sphere(0.5 * (plane.y0 + plane.g), 0.02)])
    t = np.linspace(0.0, 0.4, 801)
    run = near.rollout(t, duration=0.1)
    assert np.linalg.norm(plane.rollout(t, duration=0.1).yd, axis=1).max() > 15 * 0.08 * 5
    assert near.distance(run.y).min() > CLEARANCE - 1e-4


def test_an_arm_keeps_its_tool_and_its_elbow_clear(arm: Dmp) -> None:
    t = np.arange(0.0, 5.0, 0.004)
    tool = Capsule([0.0, 0.0, -0.05], [0.0, 0.0, 0.0], 0.01)
    elbow = Capsule.sphere(np.zeros(3), 0.03)
    links = kinematics.link_transforms(ROBOT, arm.rollout(t).y)
    tip = kinematics.forward(ROBOT, arm.rollout(t).y)[:, :3, 3]
    way = Capsule.sphere(tip[250] + [0.0, 0.0, 0.03], 0.02)
    beside = Capsule.sphere(links[300, 4, :3, 3] + [0.05, 0.0, 0.05], 0.02)
    for scene, parts in (([way], {}), ([way], {"tool": tool}), ([beside], {"links": {5: elbow}})):
        one = avoiding(arm, scene, robot=ROBOT, **parts)
        assert one.distance(arm.rollout(t).y).min() < CLEARANCE
        assert succeeds(one, t)


def test_distances_of_a_capsule(plane: Dmp, space: Dmp) -> None:
    one = avoiding(plane, [Capsule([0.0, 1.0], [1.0, 1.0], 0.1)])
    for point, distance in (([0.5, 2.0], 0.9), ([2.0, 1.0], 0.9), ([-1.0, 1.0], 0.9), ([0.5, 1.0], -0.1)):
        assert one.distance(point) == pytest.approx(distance)
    assert avoiding(space, []).distance(np.zeros((4, 3))).tolist() == [np.inf] * 4
    held = AvoidingDmp(
        fit_dmp(2 * U, ROBOT.q_home + S[:, None] * REACH, n_basis=8).value,
        [Capsule.sphere(kinematics.forward(ROBOT, ROBOT.q_home) @ [0, 0, 0.1, 1] @ np.eye(4)[:, :3], 0.01)],
        0.0, 0.05, robot=ROBOT, tool=Capsule([0.0, 0.0, -0.1], [0.0, 0.0, 0.03], 0.02),
    )  # fmt: skip
    assert held.distance(ROBOT.q_home) == pytest.approx(0.07 - 0.03)


def test_rows_of_a_plane_have_a_third_axis() -> None:
    rows = rows_of([Capsule([1.0, 2.0], [3.0, 4.0], 0.5, [6.0, 7.0]), Capsule.sphere([1.0, 2.0])], 2)
    assert rows.tolist() == [[1, 2, 0, 3, 4, 0, 0.5, 6, 7, 0], [1, 2, 0, 1, 2, 0, 0, 0, 0, 0]]


def test_bad_input_is_refused_by_a_sentence(space: Dmp, plane: Dmp, arm: Dmp) -> None:
    near = [Capsule.sphere(space.g + 0.01, 0.05)]
    for words, call in {
        "goal outside the clearance": lambda: avoiding(space, near).rollout(U),
        "start outside the clearance": lambda: avoiding(space, [Capsule.sphere(space.y0)]).stepper(),
        "space of 2 axes, got number 0 of 3": lambda: avoiding(plane, near),
        "finite point": lambda: Capsule.sphere([0.0, np.nan, 0.0]),
        "radius of 0 or more": lambda: Capsule.sphere([0.0, 0.0], -1.0),
        "y with 3 coordinates": lambda: avoiding(space, []).distance([0.0]),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
    for words, call in {
        "clearance < reach": lambda: AvoidingDmp(space, [], 0.2, 0.1),
        "2 or 3 coordinates": lambda: avoiding(arm, []),
        "of 7 coordinates": lambda: avoiding(space, [], robot=ROBOT),
        "links from 1 to 7, got 8": lambda: avoiding(arm, [], robot=ROBOT, links={8: Capsule.sphere(np.zeros(3))}),
        "joints of a robot": lambda: avoiding(space, []).controller(),
    }.items():
        with pytest.raises(ConfigError, match=words):
            call()
    with pytest.raises(UnknownName, match="form"):
        avoiding(space, [], "wall")


def test_what_is_no_list_of_capsules_is_refused() -> None:
    u = np.linspace(0.0, 1.0, 30)
    dmp, ball = fit_dmp(u, np.outer(u, [1.0, 1.0]), n_basis=6).value, Capsule.sphere([0.5, 0.2], 0.05)
    for obstacles in (ball, ["ball"], None, [None]):
        with pytest.raises(ArmlabError, match=r"^Expected (obstacles|capsules)"):
            AvoidingDmp(dmp, obstacles, 0.02, 0.1)  # type: ignore[arg-type]
        with pytest.raises(ArmlabError, match=r"^Expected capsules"):
            AvoidingDmp(dmp, [ball], 0.02, 0.1).stepper().place(obstacles)  # type: ignore[arg-type]
    for extra in ({"tool": ball}, {"links": {1: ball}}):
        with pytest.raises(ConfigError, match="only with a robot"):
            AvoidingDmp(dmp, [ball], 0.02, 0.1, **extra)  # type: ignore[arg-type]
