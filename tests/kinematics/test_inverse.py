"""Inverse kinematics: solutions, objectives, reasons of failure."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import kinematics, lie, robots
from armlab.errors import NotConverged
from armlab.kinematics import forward, inverse, jacobian, manipulability, singular_values
from armlab.kinematics.dexterity import manipulability_gradient
from armlab.kinematics.inverse import IkSolution
from armlab.robots import Robot

TASKS = ("pose", "position", "axis", "direction")
FIELDS = ("q", "success", "position_error", "rotation_error", "iterations", "starts", "reason", "slope")
ARMS_LIBRARY = [name for name in robots.names() if name != "dh_test"]
COUNT = 800
COUNT_OBJECTIVES = 150
OBJECTIVES = ("posture", "mid_range", "limits", "manipulability")
ROWS = {"pose": slice(0, 6), "position": slice(0, 3)}
YUMI = "yumi_left"


def reachable(robot: Robot, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Postures distributed uniformly within the limits, and their poses."""
    q = np.random.default_rng(seed).uniform(robot.q_min, robot.q_max, (count, robot.n))
    return q, forward(robot, q)


def errors(robot: Robot, q: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance and angle from the tool to the goals, computed independently of the solver."""
    found = forward(robot, q)
    return np.linalg.norm(found[..., :3, 3] - T[..., :3, 3], axis=-1), lie.so3.angle(found[..., :3, :3], T[..., :3, :3])


def axis_angle(robot: Robot, q: np.ndarray, T: np.ndarray, axis: np.ndarray) -> np.ndarray:
    now, wanted = (poses[..., :3, :3] @ axis for poses in (forward(robot, q), T))
    return np.arctan2(np.linalg.norm(np.cross(now, wanted), axis=-1), np.vecdot(now, wanted))


def inside(robot: Robot, q: np.ndarray) -> bool:
    return bool(np.all((robot.q_min <= q) & (q <= robot.q_max)))


def test_numeric_example_of_the_ancestor() -> None:
    """IRB 7600 from q = 1, goal moved by (0.1, 0.1, 0.1) m in base axes, then turned by 1 degree about its z axis."""
    robot = robots.load("irb7600").with_base(np.eye(4)).with_tool(np.eye(4))
    T = forward(robot, np.ones(6))
    T[:3, 3] += 0.1
    T[:3, :3] = T[:3, :3] @ lie.euler.rot_z(np.deg2rad(1.0))
    found = inverse(robot, T, np.ones(6), starts=1, tol=1e-12)
    wanted = (0.974117541152, 0.837125380334, 0.930496390320, 0.868829972477, 1.132254977044, 1.236310321013)
    assert found.success
    np.testing.assert_allclose(found.q, wanted, rtol=0, atol=2e-12)
    assert found.iterations <= 6


@pytest.mark.parametrize("name", ["yumi_left", "irb2400", "ur5e"])
def test_convergence_is_quadratic(name: str) -> None:
    """From starts within 0.1 rad of regular postures, errors fall below 1e-11 in at most 6 iterations, mostly in 4."""
    robot, rng = robots.load(name), np.random.default_rng(4)
    q, T = reachable(robot, 1000, seed=4)
    away = rng.normal(size=q.shape)
    start = np.clip(q + 0.1 * away / np.linalg.norm(away, axis=1, keepdims=True), robot.q_min, robot.q_max)
    regular = singular_values(robot, q)[:, -1] > 0.03
    assert regular.mean() > 0.5
    result = inverse(robot, T[regular], start[regular], tol=1e-11, starts=1, history=True)
    assert result.success.all()
    assert result.iterations.max() <= 6
    assert np.median(result.iterations) <= 4
    assert result.history is not None
    first, second, third = np.log(np.linalg.norm(result.history[:, 1:4], axis=-1)).T
    exact = third > np.log(1e-13)  # not yet rounding
    assert 1.8 < np.median((third - second)[exact] / (second - first)[exact]) < 2.2


def test_history_is_of_the_start_that_gave_the_result() -> None:
    robot = robots.load("yumi_left")
    result = inverse(robot, reachable(robot, 20, seed=9)[1], history=True, maxiter=30)
    assert result.history is not None
    assert result.history.shape == (20, 31, 2)
    assert np.any(result.starts > 1)
    for path, position, rotation in zip(result.history, result.position_error, result.rotation_error):
        known = path[~np.isnan(path[:, 0])]
        np.testing.assert_array_equal(known[-1], (position, rotation))
        assert np.isnan(path[len(known) :]).all()
        assert len(known) >= 2
    assert inverse(robot, np.eye(4)).history is None


def test_tasks_that_leave_joints_free() -> None:
    """Errors of the task's components are within the tolerance; those of all others are NaN."""
    robot, axis = robots.load("irb2400"), np.array([0.6, 0.0, -0.8])
    _, T = reachable(robot, 100, seed=3)
    for task in TASKS:
        found = inverse(robot, T, task=task, axis=5.0 * axis)
        assert found.success.all()
        assert inside(robot, found.q)
        position, rotation = errors(robot, found.q, T)
        turned = axis_angle(robot, found.q, T, axis)
        has_position, turn = task != "direction", {"pose": rotation, "position": None}.get(task, turned)
        np.testing.assert_allclose(found.position_error, position if has_position else np.nan, rtol=0, atol=1e-14)
        np.testing.assert_allclose(found.rotation_error, np.nan if turn is None else turn, rtol=0, atol=1e-14)
        assert np.nanmax(np.stack([found.position_error, found.rotation_error])) <= 1e-9
        assert task == "pose" or np.median(rotation) > 0.1  # free joints were used


def test_a_batch_is_a_loop() -> None:
    robot = robots.load("yumi_right")
    q, T = reachable(robot, 12, seed=2)
    T[5, :3, 3] += 5.0
    for options in ({}, {"objective": "limits"}, {"seed": 9, "task": "position", "objective": "posture"}):
        batch = inverse(robot, T.reshape(3, 4, 4, 4), (q + 0.05).reshape(3, 4, 7), threads=2, **options)
        assert batch.q.shape == (3, 4, 7)
        assert batch.reason.shape == (3, 4)  # type: ignore[union-attr]
        for k in range(12):
            one = inverse(robot, T[k], q[k] + 0.05, **options)
            for name in FIELDS:
                np.testing.assert_array_equal(getattr(batch, name)[k // 4, k % 4], getattr(one, name))


@st.composite
def chains(draw: st.DrawFn) -> tuple[Robot, np.ndarray]:
    """Random robots of 2 to 9 joints, revolute and prismatic, with all, some or no limits; and a posture."""
    n = draw(st.integers(2, 9))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    table = rng.uniform(-np.pi, np.pi, (4, n)) * [[1], [0.3], [0.3], [1]]
    if draw(st.booleans()):
        table = np.round(table / (np.pi / 2)) * (np.pi / 2)  # right angles and parallel axes: singular everywhere
    prismatic = rng.random(n) < 0.3
    low, high = np.where(prismatic, -0.5, -2.0), np.where(prismatic, 0.4, 1.5)
    unlimited = rng.random((2, n)) < draw(st.sampled_from([0.0, 0.5, 1.0]))
    low, high = np.where(unlimited[0], -np.inf, low), np.where(unlimited[1], np.inf, high)
    mount, tool = lie.se3.exp(rng.standard_normal((2, 6)))
    robot = robots.from_dh(
        "random", *table, prismatic=prismatic, T_base_mount=mount, T_flange_tool=tool, q_min=low, q_max=high
    )
    return robot, np.clip(rng.uniform(-3, 3, n) * np.where(prismatic, 0.2, 1.0), low, high)


@given(chains(), st.sampled_from(TASKS), st.booleans())
@settings(max_examples=40)
def test_any_chain(case: tuple[Robot, np.ndarray], task: str, moved: bool) -> None:
    """The result is finite, inside the limits and correctly reported; the posture itself is found again."""
    robot, q = case
    T, axis = forward(robot, q), np.array([0.0, 0.6, 0.8])
    assert inverse(robot, T, q, task=task, axis=axis, starts=1).success  # type: ignore[arg-type]
    if moved:
        T[:3, 3] += 0.5
    result = inverse(robot, T, task=task, axis=axis, starts=20)  # type: ignore[arg-type]
    assert np.isfinite(result.q).all()
    assert inside(robot, result.q)
    position, rotation = errors(robot, result.q, T)
    if task in ("axis", "direction"):
        rotation = axis_angle(robot, result.q, T, axis)
    exact = (task == "direction" or position <= 1e-9 + 1e-14) and (task == "position" or rotation <= 1e-9 + 1e-14)
    assert bool(result.success) == exact
    assert result.reason in ("solved", "out of reach", "limits", "iterations")


def solved(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return, for each posture, whether its pose is reached again by any posture, inside the limits and to 1e-9."""
    T_base_tool = kinematics.forward(robot, q)
    solution = kinematics.inverse(robot, T_base_tool)
    assert ((solution.q >= robot.q_min) & (solution.q <= robot.q_max)).all()
    position, rotation = errors(robot, solution.q, T_base_tool)
    exact = (position <= 1e-9 + 1e-14) & (rotation <= 1e-9 + 1e-14)
    np.testing.assert_array_equal(exact, solution.success)
    np.testing.assert_array_equal(solution.reason == "solved", solution.success)
    np.testing.assert_allclose(solution.position_error, position, rtol=0, atol=1e-14)
    np.testing.assert_allclose(solution.rotation_error, rotation, rtol=0, atol=1e-14)
    return exact


@pytest.mark.parametrize("name", ARMS_LIBRARY)
def test_random_poses(name: str) -> None:
    """All 10 000 poses were solved on each of the fourteen arms, after 1.2 to 1.8 starts on average; straight wrists
    too."""
    robot = robots.load(name)
    q = np.random.default_rng(0).uniform(robot.q_min, robot.q_max, (COUNT, robot.n))
    assert solved(robot, q).mean() >= 0.999
    bend = robot.n - 2
    q[: COUNT // 4, bend] = np.clip(0.0, robot.q_min[bend], robot.q_max[bend])
    assert solved(robot, q[: COUNT // 4]).mean() >= 0.999


@pytest.mark.parametrize("name", ARMS_LIBRARY)
def test_every_joint_at_a_limit(name: str) -> None:
    """2^n corners of the joint limits: all were found within 100 starts, except 1 of 128 on the URDF YuMi."""
    robot = robots.load(name)
    corners = np.array(list(itertools.product(*zip(robot.q_min, robot.q_max))))
    assert solved(robot, corners).mean() >= 0.98


def planar(*lengths: float, **limits: tuple[float, ...]) -> Robot:
    """All joint axes along z, so that the workspace follows from elementary geometry."""
    zeros = np.zeros(len(lengths))
    return robots.from_dh("planar", zeros, lengths, zeros, zeros, **limits)  # type: ignore[arg-type]


def at(x: float, y: float, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


REACH = planar(1.0, 0.5)
NEAREST = np.sqrt(1.25 + np.cos(1)) - np.sqrt(1.25 + np.cos(2))
BENT = planar(1.0, 0.5, q_min=(-np.pi, 0.5), q_max=(np.pi, 1.0))


@pytest.mark.parametrize(("robot", "T", "q0", "options", "reason", "least"), [
    # beyond the links' length, inside the shortest reach, off the plane: distances are known
    (REACH, at(3.0, 0.0), (0.1, 0.2), {}, "out of reach", 1.5),
    (REACH, at(0.2, 0.0), (0.1, 0.2), {}, "out of reach", 0.3),
    (REACH, at(0.6, 0.6, 0.1), (0.1, 0.2), {}, "out of reach", 0.1),
    (REACH, at(0.6, 0.6, 0.1), (0.1, 0.2), {"starts": 1}, "out of reach", 0.1),
    (REACH, at(1.5 + 1e-6, 0.0), (0.1, 0.2), {}, "out of reach", 1e-6),
    # the elbow would have to bend by 2 rad; at its limit the distance is that of the two circles
    (BENT, forward(REACH, (0.3, 2.0)), (0.3, 0.7), {}, "limits", NEAREST),
    (BENT, forward(REACH, (0.3, 2.0)), (0.3, 0.7), {"starts": 1}, "limits", 0.0),
    # the goal lies on the stretched arm: no joint can move towards it, but another start reaches it
    (REACH, at(1.2, 0.0), (0.0, 0.0), {"starts": 1}, "singular", 0.3),
    (REACH, at(1.2, 0.0), (0.0, 0.0), {}, "solved", 0.0),
    (REACH, forward(REACH, (0.3, 1.0)), (-2.0, 0.5), {"maxiter": 2, "starts": 1}, "iterations", 0.0),
    (REACH, at(1.5, 0.0), (0.3, 0.5), {"starts": 1}, "solved", 0.0),  # the farthest point within reach
])  # fmt: skip
def test_why_not(robot: Robot, T: np.ndarray, q0: tuple, options: dict, reason: str, least: float) -> None:
    """Without a solution, the nearest posture is returned with the true reason."""
    result = inverse(robot, T, q0, task="position", **options)
    assert result.reason == reason
    assert bool(result.success) == (reason == "solved")
    assert inside(robot, result.q)
    distance = np.linalg.norm(forward(robot, result.q)[:3, 3] - T[:3, 3])
    np.testing.assert_allclose(result.position_error, distance, rtol=0, atol=1e-14)
    if (reason != "iterations" and options.get("starts") != 1) or reason == "singular":
        assert least - 1e-9 <= distance <= least * (1 + 1e-3) + 1e-9
    assert reason == "solved" or f"Not solved ({reason}" in result.report()


def test_unreachable_poses_end_soon_and_stay_finite() -> None:
    robot = robots.load("yumi_left")
    T = reachable(robot, 30, seed=3)[1]
    T[::2, :3, 3] += 0.4
    T[1::2, :3, 3] *= 1e6
    result = inverse(robot, T, maxiter=50, starts=30)
    assert np.isfinite(result.q).all()
    assert inside(robot, result.q)
    assert (result.reason[1::2] == "out of reach").all()  # type: ignore[index]
    assert result.iterations.max() <= 50 * (30 + 1 + 10)


def test_turns_are_taken_back_into_the_limits() -> None:
    """A joint with a range of more than one revolution: the solution outside the limits has an equivalent inside."""
    robot = planar(1.0, 0.5, q_min=(-4.0, 3.3), q_max=(4.0, 6.0))
    result = inverse(robot, forward(robot, (0.5, 4.0)), (0.4, 3.3), task="position")
    assert result.success
    assert inside(robot, result.q)


def test_reports() -> None:
    robot = robots.load("irb2400")
    T = reachable(robot, 4, seed=1)[1]
    one = inverse(robot, forward(robot, robot.q_home), robot.q_home)
    assert repr(one) == "IkSolution(Solved to within 0 m and 0 rad in 0 iterations from 1 start.)"
    np.testing.assert_array_equal(one.q, robot.q_home)
    T[2, 0, 3] += 10.0
    text = inverse(robot, T.reshape(2, 2, 4, 4)).report()
    assert text.startswith("3 of 4 goals solved to within ")
    assert text.endswith("; not solved: 1 out of reach, first at index 1, 0.")
    none = inverse(robot, np.empty((0, 4, 4)), np.empty((0, 6)), history=True, strict=True)
    assert (none.q.shape, none.success.shape, none.report()) == ((0, 6), (0,), "0 of 0 goals solved.")
    assert inverse(robot, T[2:3]).report() == "0 of 1 goals solved; not solved: 1 out of reach, first at index 0."


def test_strict_raises_with_the_result() -> None:
    robot = robots.load("irb2400")
    T = forward(robot, robot.q_home)
    assert inverse(robot, T, strict=True).success
    T[0, 3] += 10.0
    with pytest.raises(NotConverged, match="out of reach") as caught:
        inverse(robot, T, strict=True)
    best = caught.value.best
    assert isinstance(best, IkSolution)
    np.testing.assert_array_equal(best.q, inverse(robot, T).q)


def scaled(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Joint positions scaled to -1 to 1 between the limits."""
    return (2.0 * q - robot.q_max - robot.q_min) / (robot.q_max - robot.q_min)


def gradient(robot: Robot, q: np.ndarray, objective: str, task: str) -> np.ndarray:
    """Gradients (N, n) of the objectives, implemented again from the documentation of `inverse`."""
    x, slope = scaled(robot, q), 2.0 / (robot.q_max - robot.q_min)
    if objective == "posture":
        return q - robot.q_home
    if objective == "mid_range":
        return slope * x
    if objective == "limits":
        largest = np.abs(x).max(axis=1, keepdims=True)
        up, down = np.exp(1000.0 * (x - largest)), np.exp(1000.0 * (-x - largest))
        return slope * ((up - down) / (up + down).sum(axis=1, keepdims=True) + 1e-3 * x)
    w = manipulability(robot, q, task)  # type: ignore[arg-type]
    return -manipulability_gradient(robot, q, task) / w[:, None]  # type: ignore[arg-type]


def left_slope(robot: Robot, q: np.ndarray, g: np.ndarray, rows: slice) -> float:
    """Slope along the self-motion of the joints not held at a limit, from singular vectors."""
    free = np.ones(robot.n, dtype=bool)
    for _ in range(robot.n):
        J = jacobian(robot, q)[rows][:, free]
        null = np.linalg.svd(J)[2][J.shape[0] :]
        along = np.zeros(robot.n)
        along[free] = null.T @ (null @ g[free])
        pressed = free & (((q >= robot.q_max) & (along < 0)) | ((q <= robot.q_min) & (along > 0)))
        if not pressed.any():
            return float(np.linalg.norm(along))
        free &= ~pressed
    return 0.0


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("task", ["pose", "position"])
def test_pose_is_exact_and_no_slope_is_left(objective: str, task: str) -> None:
    robot = robots.load(YUMI)
    T = reachable(robot, COUNT_OBJECTIVES, seed=1)[1]
    result = inverse(robot, T, task=task, objective=objective)  # type: ignore[arg-type]
    assert result.success.all()
    assert ((robot.q_min <= result.q) & (result.q <= robot.q_max)).all()
    assert result.position_error.max() <= 1e-9
    assert task == "position" or result.rotation_error.max() <= 1e-9
    g = gradient(robot, result.q, objective, task)
    left = np.array([left_slope(robot, *row, ROWS[task]) for row in zip(result.q, g)])
    assert left.max() <= 1e-6
    assert result.slope.max() <= 1e-6
    at_limit = ((result.q == robot.q_min) | (result.q == robot.q_max)).any(axis=1)
    assert at_limit.mean() < 0.7  # the others had to come to rest


def test_objectives_are_better_than_the_plain_solution() -> None:
    robot = robots.load(YUMI)
    T = reachable(robot, COUNT_OBJECTIVES, seed=2)[1]
    plain = inverse(robot, T)
    assert np.isnan(plain.slope).all()
    away = [np.linalg.norm(q - robot.q_home, axis=1) for q in (inverse(robot, T, objective="posture").q, plain.q)]
    assert np.all(away[0] <= away[1] + 1e-9)
    middle = [np.linalg.norm(scaled(robot, q), axis=1) for q in (inverse(robot, T, objective="mid_range").q, plain.q)]
    assert np.all(middle[0] <= middle[1] + 1e-9)
    w = [manipulability(robot, q) for q in (inverse(robot, T, objective="manipulability").q, plain.q)]
    assert np.all(w[0] >= w[1] * (1 - 1e-6) - 1e-9)
    assert np.mean(w[0]) > 1.1 * np.mean(w[1])


@pytest.mark.parametrize("name", [YUMI, "panda", "iiwa14"])
def test_limits_are_avoided(name: str) -> None:
    """On 99 % of the poses, the smallest distance to a limit relative to the range is at least that of the plain
    solution."""
    robot = robots.load(name)
    T = reachable(robot, 400, seed=3)[1]
    near = [np.abs(scaled(robot, inverse(robot, T, objective=o).q)).max(axis=1) for o in ("limits", None)]
    assert np.mean(near[0] <= near[1] + 1e-9) >= 0.99
    assert np.median(near[1] - near[0]) > 0.02


def test_the_posture_that_is_asked_for() -> None:
    """The default posture is the start of the search; one posture for all goals, or one per goal."""
    robot = robots.load(YUMI)
    rng = np.random.default_rng(4)
    q = rng.uniform(0.8 * robot.q_min, 0.8 * robot.q_max, (20, 7))
    T = forward(robot, q)
    near = q + rng.uniform(-0.05, 0.05, q.shape)
    each = inverse(robot, T, near, objective="posture")
    np.testing.assert_array_equal(each.q, inverse(robot, T, near, objective="posture", posture=near).q)
    assert np.all(np.linalg.norm(each.q - near, axis=1) <= np.linalg.norm(q - near, axis=1) + 1e-9)
    np.testing.assert_array_equal(
        inverse(robot, T, objective="posture").q, inverse(robot, T, objective="posture", posture=robot.q_home).q
    )
    same = inverse(robot, T, q, objective="posture", posture=q)
    np.testing.assert_allclose(same.q, q, rtol=0, atol=1e-12)


def test_five_of_six_joints_for_an_axis() -> None:
    """A tool that may turn about its axis is a redundant task on six joints."""
    robot = robots.load("irb2400")
    T = reachable(robot, 50, seed=6)[1]
    result = inverse(robot, T, task="axis", objective="limits")
    assert result.success.all()
    assert result.slope.max() <= 1e-6
    turned = forward(robot, result.q)
    np.testing.assert_allclose(turned[:, :3, 2:], T[:, :3, 2:], rtol=0, atol=2e-9)
    assert np.abs(turned[:, :3, 0] - T[:, :3, 0]).max() > 0.1


def test_what_is_left_beside_a_singular_posture_is_called_so() -> None:
    """A wrist 1e-7 rad from straight: nearly all poses are solved, and the rest are not reported as out of reach or
    limits."""
    robot = robots.load("ur5e")
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (100, 6))
    q[:, 4] = 1e-7
    found = inverse(robot, forward(robot, q))
    assert set(found.reason) <= {"solved", "singular"}
    assert found.success.sum() >= 95
    assert found.rotation_error.max() < 1e-6


def gen3() -> Robot:
    """A seven-axis Kinova Gen3: the published joint frames, with millimetre offsets at the elbow."""
    origins = [
        (np.pi, 0.0, 0.15643),
        (np.pi / 2, 0.005375, -0.12838),
        (-np.pi / 2, -0.21038, -0.006375),
        (np.pi / 2, 0.006375, -0.21038),
        (-np.pi / 2, -0.20843, -0.006375),
        (np.pi / 2, 0.00017505, -0.10593),
        (-np.pi / 2, -0.10593, -0.00017505),
        (np.pi, 0.0, -0.061525),
    ]
    links = [lie.se3.from_rp(lie.so3.exp([turn, 0.0, 0.0]), [0.0, y, z]) for turn, y, z in origins]
    limit = np.array([np.inf, 2.41, np.inf, 2.66, np.inf, 2.23, np.inf])
    return robots.from_links("gen3", links, q_min=-limit, q_max=limit)


@pytest.mark.parametrize("bend", ["straight", "nearly", "both"])
def test_beside_a_singular_elbow_reachable_poses_are_solved_or_called_singular(bend: str) -> None:
    """First-order steps left 7 of 1000 unsolved, some as "out of reach"; 11 from a nearby start; now none."""
    robot, rng = gen3(), np.random.default_rng(5)
    q = rng.uniform(np.maximum(robot.q_min, -np.pi), np.minimum(robot.q_max, np.pi), (1000, 7))
    q[:, 3] = 0.0 if bend == "straight" else 10.0 ** rng.uniform(-9, -2, 1000)
    if bend == "both":
        q[:, 5] = q[:, 3]
    T = forward(robot, q)
    found = inverse(robot, T)
    assert set(found.reason) <= {"solved", "singular"}
    assert found.success.sum() >= 997
    assert max(found.position_error.max(), found.rotation_error.max()) < 1e-4
    near = inverse(robot, T, q0=q + 0.1 * rng.standard_normal(q.shape), starts=1)
    assert set(near.reason) <= {"solved", "singular"}
    assert near.success.sum() >= 999
    np.testing.assert_allclose(forward(robot, near.q)[near.success], T[near.success], rtol=0, atol=4e-9)


@pytest.mark.parametrize("digits", [8, 6])
def test_goals_with_few_digits_are_solved_as_the_nearest_poses(digits: int) -> None:
    robot = robots.load("yumi_left")
    T = np.round(reachable(robot, 20, seed=8)[1], digits)
    found = inverse(robot, T)
    assert found.success.all()
    np.testing.assert_allclose(forward(robot, found.q), lie.se3.project(T)[0], rtol=0, atol=3e-9)
    arm = robot.with_tool(T[0])
    assert lie.se3.is_pose(arm.T_flange_tool, 1e-14)
