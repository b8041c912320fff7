"""Obstacles: avoided with the requested clearance, in the plane, in space and with an arm; no effect from afar."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import ShapeError
from armlab.motion import Dmp, fit_dmp
from armlab.motion.obstacles import FORMS, AvoidingDmp, AvoidingStepper, Capsule

from .conftest import arm

U = np.linspace(0.0, 1.0, 251)
S = U**3 * (10 - 15 * U + 6 * U**2)
T = np.linspace(0.0, 3.0, 401)
SCENES = 60
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
def joints() -> Dmp:
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
    made = scenes(space, SCENES)
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


def test_the_steering_angle_is_that_of_the_paper(space: Dmp) -> None:
    """Hoffmann et al. (2009): ``gamma R v phi exp(-beta |phi|)`` with beta = 20 / pi."""
    around = avoiding(space, [Capsule.sphere([0.0, 0.07, 0.0], 0.05)])._around()  # its surface at the clearance
    phi = 0.3
    v = 0.02 * np.array([np.sin(phi), np.cos(phi), 0.0])
    side = np.array([np.cos(phi), -np.sin(phi), 0.0])
    wanted = 12.0 * phi * np.exp(-20.0 / np.pi * phi) * 0.02 * side
    push = around.add(np.zeros(3), v, np.ones(3), np.array([0.0, -9.0, 0.0])) - [0.0, -9.0, 0.0]  # no guard
    np.testing.assert_allclose(push, wanted, rtol=1e-12, atol=1e-15)


def test_fast_approach_is_braked_before_the_clearance(plane: Dmp) -> None:
    """Ten times faster than the guard's own rate allows."""
    near = avoiding(plane, [Capsule.sphere(0.5 * (plane.y0 + plane.g), 0.02)])
    t = np.linspace(0.0, 0.4, 801)
    run = near.rollout(t, duration=0.1)
    assert np.linalg.norm(plane.rollout(t, duration=0.1).yd, axis=1).max() > 15 * 0.08 * 5
    assert near.distance(run.y).min() > CLEARANCE - 1e-4


def test_an_arm_keeps_its_tool_and_its_elbow_clear(joints: Dmp) -> None:
    t = np.arange(0.0, 5.0, 0.004)
    tool = Capsule([0.0, 0.0, -0.05], [0.0, 0.0, 0.0], 0.01)
    elbow = Capsule.sphere(np.zeros(3), 0.03)
    links = kinematics.link_transforms(ROBOT, joints.rollout(t).y)
    tip = kinematics.forward(ROBOT, joints.rollout(t).y)[:, :3, 3]
    way = Capsule.sphere(tip[250] + [0.0, 0.0, 0.03], 0.02)
    beside = Capsule.sphere(links[300, 4, :3, 3] + [0.05, 0.0, 0.05], 0.02)
    for scene, parts in (([way], {}), ([way], {"tool": tool}), ([beside], {"links": {5: elbow}})):
        one = avoiding(joints, scene, robot=ROBOT, **parts)
        assert one.distance(joints.rollout(t).y).min() < CLEARANCE
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


PERIOD = 0.004


@pytest.fixture(scope="module")
def swing() -> Dmp:
    q = ROBOT.q_home + S[:, None] * [1.1, 0.1, 0.2, 0.2, -0.3, 0.4, 0.2]
    return fit_dmp(2 * U, q, n_basis=20, scaling="none").value


def test_steps_are_the_rollout(space: Dmp) -> None:
    one = AvoidingDmp(space, [Capsule.sphere([0.25, 0.1, 0.1], 0.03)], 0.02, 0.1)
    run, stepper = one.rollout(PERIOD), one.stepper()
    assert isinstance(stepper, AvoidingStepper)
    for _ in range(2):
        steps = [stepper.state, *(stepper.step(PERIOD) for _ in run.t[1:])]
        np.testing.assert_allclose(steps, np.stack([run.y, run.yd, run.ydd], axis=1), rtol=0, atol=1e-10)
        stepper.reset()


def test_a_new_goal_within_the_clearance_is_refused(space: Dmp) -> None:
    """The obstacle's current position counts; the motion to such a goal would never finish. The old goal stays."""
    stepper = AvoidingDmp(space, [Capsule.sphere([0.25, 0.3, 0.1], 0.03)], 0.02, 0.1).stepper()
    free, taken = [0.6, 0.1, 0.1], [0.25, 0.26, 0.1]
    stepper.change_goal(free)
    outside = r"goal to be outside the clearance of every obstacle, got a distance of 0\.01"
    with pytest.raises(ShapeError, match=outside):
        stepper.change_goal(taken)
    with pytest.raises(ShapeError, match="3 coordinates"):
        stepper.change_goal([0.1])
    np.testing.assert_array_equal(stepper.goal, free)
    stepper.place([])
    stepper.change_goal(taken)
    np.testing.assert_array_equal(stepper.goal, taken)


def test_order_of_the_steps(space: Dmp) -> None:
    """Fourth order where only the smooth steering terms act."""
    one = AvoidingDmp(space, [Capsule.sphere([0.25, 0.2, 0.1], 0.03)], 0.0, 0.15)
    ends = [one.rollout(np.linspace(0.0, 0.6, N)).y[-1] for N in (201, 401, 801, 3201)]
    assert np.abs(ends[-1] - space.rollout([0.0, 0.6]).y[-1]).max() > 1e-4  # it acted
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert errors[0] / errors[2] > 16**2 * 0.4


def test_an_obstacle_that_moves_is_made_way_for(space: Dmp) -> None:
    """It comes from the side at 0.4 m/s; its position is given every 0.1 s, or only once with its velocity."""
    velocity = np.array([0.0, -0.4, 0.0])
    for told in (25, 10_000):
        stepper = AvoidingDmp(space, [], 0.02, 0.1).stepper()
        seen = []
        for k in range(500):
            if k % told == 0:
                stepper.place([Capsule.sphere([0.25, 0.3, 0.1] + velocity * k * PERIOD, 0.03, velocity)])
            stepper.step(PERIOD)
            seen.append(stepper.distance)
        where = np.array([0.25, 0.3, 0.1]) + velocity * 2.0
        assert seen[-1] == pytest.approx(np.linalg.norm(stepper.state[0] - where) - 0.03, abs=1e-9)
        assert min(seen) > 0.02 - 1e-4
        np.testing.assert_allclose(stepper.state[0], space.g, atol=1e-3)


def test_a_controller_goes_around_what_is_put_in_its_way(swing: Dmp) -> None:
    path = swing.rollout(PERIOD).y
    one = AvoidingDmp(swing, [], 0.02, 0.1, robot=ROBOT)
    controller, yumi = one.controller(), arm()
    assert "distance" in controller.columns()
    least = []
    for k in range(1000):
        if k == 50:
            there = kinematics.forward(ROBOT, path[250])[:3, 3] + np.array([0.0, 0.0, 0.03])
            controller.place([Capsule.sphere(there, 0.02)])
        record = yumi.packet(controller, PERIOD).record
        least.append(float(record["distance"]))
        assert not controller.clamped.any()
    assert np.isinf(least[:50]).all()
    assert 0.02 - 1e-4 < min(least[50:]) < 0.025
    np.testing.assert_allclose(yumi.q, swing.g, atol=2e-3)
    assert controller.done


def test_a_start_within_the_clearance_ends_the_run_with_the_reason(swing: Dmp) -> None:
    controller, yumi = AvoidingDmp(swing, [], 0.02, 0.1, robot=ROBOT).controller(), arm()
    controller.place([Capsule.sphere(kinematics.forward(ROBOT, ROBOT.q_home)[:3, 3])])
    assert yumi.packet(controller, PERIOD).ends
    assert controller.reason.startswith("Expected the start to be outside the clearance")


def test_a_controller_keeps_its_goal_where_the_new_one_is_within_the_clearance(swing: Dmp) -> None:
    controller, yumi = AvoidingDmp(swing, [], 0.02, 0.1, robot=ROBOT).controller(), arm()
    yumi.packet(controller, PERIOD)
    new = swing.g + 0.1
    controller.place([Capsule.sphere(kinematics.forward(ROBOT, new)[:3, 3])])
    with pytest.raises(ShapeError, match="Expected the goal to be outside the clearance"):
        controller.goal = new
    np.testing.assert_array_equal(controller.goal, swing.g)
