"""Inverse kinematics: exact inside the limits, quick, deterministic, and honest about what it cannot do."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import lie, robots
from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.kinematics import forward, inverse, jacobian, singular_values
from armlab.robots import Robot

ARMS = ["yumi_left", "yumi_right", "irb2400", "irb7600", "ur5e"]
TASKS = ("pose", "position", "axis", "direction")
FIELDS = ("q", "success", "position_error", "rotation_error", "iterations", "starts", "reason", "slope")


def reachable(robot: Robot, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Postures uniform inside the limits, and their poses."""
    q = np.random.default_rng(seed).uniform(robot.q_min, robot.q_max, (count, robot.n))
    return q, forward(robot, q)


def errors(robot: Robot, q: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance and angle from the tool to the goals, not by the solver's own account."""
    found = forward(robot, q)
    return np.linalg.norm(found[..., :3, 3] - T[..., :3, 3], axis=-1), lie.so3.angle(found[..., :3, :3], T[..., :3, :3])


def axis_angle(robot: Robot, q: np.ndarray, T: np.ndarray, axis: np.ndarray) -> np.ndarray:
    now, wanted = (poses[..., :3, :3] @ axis for poses in (forward(robot, q), T))
    return np.arctan2(np.linalg.norm(np.cross(now, wanted), axis=-1), np.vecdot(now, wanted))


def inside(robot: Robot, q: np.ndarray) -> bool:
    return bool(np.all((robot.q_min <= q) & (q <= robot.q_max)))


def part_solved(robot: Robot, count: int, seed: int) -> float:
    """Part of random reachable poses that are solved to 1e-9 inside the limits; the solver's word for it is checked."""
    _, T = reachable(robot, count, seed)
    result = inverse(robot, T)
    position, rotation = errors(robot, result.q, T)
    assert inside(robot, result.q)
    exact = (position <= 1e-9 + 1e-14) & (rotation <= 1e-9 + 1e-14)
    np.testing.assert_array_equal(exact, result.success)
    np.testing.assert_array_equal(result.reason == "solved", result.success)
    np.testing.assert_allclose(result.position_error, position, rtol=0, atol=1e-14)
    np.testing.assert_allclose(result.rotation_error, rotation, rtol=0, atol=1e-14)
    return float(np.mean(exact))


@pytest.mark.parametrize("name", ARMS)
def test_random_reachable_poses_are_solved_from_random_starts(name: str) -> None:
    assert part_solved(robots.load(name), 500, seed=1) >= 0.998  # at most one of 500


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_ten_thousand_reachable_poses(name: str) -> None:
    """The bar is 99.9 %. 0.3 s per arm."""
    assert part_solved(robots.load(name), 10_000, seed=5) >= 0.999


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
    """From within 0.1 rad of regular postures the error falls below 1e-11 in at most 6 iterations, mostly in 4."""
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


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right"])
def test_the_recipe_for_get_kinematic_functions(name: str) -> None:
    """One line gives the ancestor's three functions; inverse of forward is the posture it starts from."""
    fkine, jac, ikine = (partial(f, robots.load(name)) for f in (forward, jacobian, inverse))
    q = np.array([-0.3, -1.2, 0.7, 0.4, 1.0, 0.5, -0.2])
    assert jac(q).shape == (6, 7)
    found = ikine(fkine(q), q)
    np.testing.assert_array_equal(found.q, q)
    assert found.iterations == 0
    np.testing.assert_allclose(fkine(ikine(fkine(q)).q), fkine(q), rtol=0, atol=2e-9)


def test_tasks_that_leave_joints_free() -> None:
    """Errors of what is asked for are within the tolerance; what is not asked for is NaN."""
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


def test_direction_against_that_of_the_goal() -> None:
    """Half a turn away there is no shortest way; one is taken."""
    robot = robots.load("irb2400")
    T = forward(robot, np.zeros(6))
    T[:3, :3] = T[:3, :3] @ lie.euler.rot_x(np.pi)
    assert inverse(robot, T, np.zeros(6), task="direction", starts=1).success


def test_tolerances_of_position_and_rotation() -> None:
    robot = robots.load("yumi_left")
    result = inverse(robot, reachable(robot, 50, seed=8)[1], tol=(1e-3, 0.02))
    assert result.success.all()
    assert 1e-6 < result.position_error.max() <= 1e-3
    assert 1e-3 < result.rotation_error.max() <= 0.02


def test_an_axis_of_any_length_is_a_direction() -> None:
    """Of 1e200 the square is infinite."""
    robot = robots.load("irb2400")
    _, T = reachable(robot, 5, seed=9)
    wanted = inverse(robot, T, task="axis", axis=(0.6, 0.0, -0.8)).q
    for length in (1e200, 1e-8):
        axis = np.array([0.6, 0.0, -0.8]) * length
        np.testing.assert_allclose(inverse(robot, T, task="axis", axis=axis).q, wanted, rtol=0, atol=1e-9)


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


def test_the_same_seed_gives_the_same_answer() -> None:
    robot = robots.load("irb7600")
    _, T = reachable(robot, 40, seed=6)
    state = np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002
    first, again, other = (inverse(robot, T, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.q, again.q)
    assert np.any(first.q != other.q)
    np.testing.assert_array_equal(inverse(robot, T).q, inverse(robots.load("irb7600"), T, threads=2).q)
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # type: ignore[index]  # noqa: NPY002


def test_starts_are_kept_to() -> None:
    """One posture for all goals, one per goal; outside the limits it is moved to them."""
    robot = robots.load("yumi_left")
    q, T = reachable(robot, 30, seed=7)
    np.testing.assert_array_equal(inverse(robot, T, q).q, q)
    one = inverse(robot, T, robot.q_home, starts=1)
    np.testing.assert_array_equal(one.q, inverse(robot, T, np.tile(robot.q_home, (30, 1)), starts=1).q)
    beyond = inverse(robot, T, robot.q_max + 1.0)
    np.testing.assert_array_equal(beyond.q, inverse(robot, T, robot.q_max).q)


def test_read_only_input_and_input_unchanged() -> None:
    robot = robots.load("irb2400")
    q, T = reachable(robot, 3, seed=1)
    arrays = (T, q + 0.1, np.array([0.0, 0.0, 1.0]))
    copies = [a.copy() for a in arrays]
    for array in arrays:
        array.flags.writeable = False
    result = inverse(robot, arrays[0], arrays[1], task="axis", axis=arrays[2])
    assert result.success.all()
    for array, copy in zip(arrays, copies):
        np.testing.assert_array_equal(array, copy)
    plain = inverse(robot, T.tolist(), (q + 0.1).tolist(), task="axis")
    np.testing.assert_array_equal(plain.q, result.q)


def test_results_are_frozen() -> None:
    result = inverse(robots.load("irb2400"), np.eye(4)[None], history=True)
    for name in (*FIELDS, "history"):
        assert not getattr(result, name).flags.writeable
    with pytest.raises(AttributeError):
        result.q = np.zeros(6)  # type: ignore[misc]


def test_no_goals() -> None:
    robot = robots.load("irb2400")
    result = inverse(robot, np.empty((0, 4, 4)), np.empty((0, 6)), history=True, strict=True)
    assert result.q.shape == (0, 6)
    assert result.success.shape == (0,)
    assert result.report() == "0 of 0 goals solved."


@st.composite
def chains(draw: st.DrawFn) -> tuple[Robot, np.ndarray]:
    """Random robots of 2 to 9 joints, revolute and prismatic, with limits, without, or with some; and a posture."""
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
@settings(max_examples=60)
def test_any_chain(case: tuple[Robot, np.ndarray], task: str, moved: bool) -> None:
    """The result is finite, inside the limits and tells the truth; the posture itself is found again."""
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


def spoilt(entry: tuple[int, ...], value: float) -> np.ndarray:
    T = np.tile(np.eye(4), (2, 3, 1, 1))
    T[entry] = value
    return T


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        ({"T_base_tool": np.eye(3)}, ShapeError, r"T_base_tool of shape \(\.\.\., 4, 4\), got \(3, 3\)"),
        ({"T_base_tool": np.zeros(4)}, ShapeError, r"T_base_tool of shape \(\.\.\., 4, 4\), got \(4,\)"),
        ({"T_base_tool": "home"}, ShapeError, "T_base_tool to be an array of real numbers"),
        ({"T_base_tool": spoilt((1, 2, 0, 3), np.nan)}, ShapeError, r"finite poses .* got T_base_tool\[1, 2\] that is"),
        ({"T_base_tool": spoilt((0, 1, 2, 3), np.inf)}, ShapeError, r"finite poses .* got T_base_tool\[0, 1\] that is"),
        ({"T_base_tool": spoilt((1, 0, 0, 0), 1.1)}, ShapeError, r"orthonormal .* got T_base_tool\[1, 0\] that is not"),
        ({"T_base_tool": spoilt((1, 0, 2, 2), -1)}, ShapeError, r"orthonormal .* got T_base_tool\[1, 0\] that is not"),
        ({"T_base_tool": spoilt((1, 0, 3, 0), 1)}, ShapeError, r"last row 0 0 0 1, got T_base_tool\[1, 0\]"),
        ({"T_base_tool": 2.0 * np.eye(4)}, ShapeError, "got T_base_tool that is not"),
        ({"q0": np.zeros(5)}, ShapeError, r"q0 of shape \(6,\) or one posture per goal of T_base_tool \(4, 4\), got"),
        ({"q0": np.zeros((2, 6))}, ShapeError, r"q0 of shape \(6,\) or one posture per goal"),
        ({"q0": np.full(6, np.nan)}, ShapeError, "finite joint positions, got others in q0"),
        ({"posture": np.zeros(7), "objective": "posture"}, ShapeError, r"Expected posture of shape \(6,\)"),
        ({"task": "axis", "axis": (0, 0, 0)}, ShapeError, "axis to be a direction"),
        ({"task": "axis", "axis": (0, np.nan, 1)}, ShapeError, "axis to be a direction"),
        ({"axis": (0, 0)}, ShapeError, r"axis of shape \(3,\), got \(2,\)"),
        ({"maxiter": -1}, ConfigError, r"maxiter to be an integer from 0 to 1000000, got -1\."),
        ({"maxiter": 1.5}, ConfigError, "maxiter to be an integer"),
        ({"starts": 0}, ConfigError, "starts to be an integer of at least 1, got 0"),
        ({"starts": 2**40}, ConfigError, "starts to be an integer"),
        ({"tol": -1e-9}, ConfigError, r"tol to be a number of at least 0, or \(position, rotation\), got -1e-09"),
        ({"tol": (1e-9, np.nan)}, ConfigError, "tol to be a number"),
        ({"tol": (1e-9, 1e-9, 1e-9)}, ConfigError, "tol to be a number"),
        ({"tol": "small"}, ConfigError, "tol to be a number"),
        ({"damping": 0.0}, ConfigError, r"damping to be a number above 0, got 0\.0"),
        ({"damping": None}, ConfigError, "damping to be a number"),
        ({"axis": None}, ShapeError, "axis to be an array of real numbers, got NoneType"),
        ({"seed": None}, ConfigError, "seed to be an integer"),
        ({"seed": ""}, ConfigError, "seed to be an integer"),
        ({"seed": -1}, ConfigError, r"seed to be an integer from 0 to 2\^64 - 1, got -1"),
        ({"seed": 1.5}, ConfigError, "seed to be an integer"),
        ({"threads": 0}, ConfigError, "threads to be an integer from 1 to 256, got 0"),
        (
            {"task": "wrist"},
            UnknownName,
            r"task of inverse kinematics, got 'wrist'\. Known: axis, direction, pose, position",
        ),
        (
            {"objective": "speed"},
            UnknownName,
            r"an objective of inverse kinematics, got 'speed'\. Known: limits, manipulability, mid_range",
        ),
    ],
)
def test_wrong_arguments(arguments: dict, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        inverse(robots.load("irb2400"), **({"T_base_tool": np.eye(4)} | arguments))
