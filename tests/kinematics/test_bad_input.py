"""Every function of a posture refuses the same invalid postures with a message, and keeps NaN where it was given."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import ConfigError, RobotError, ShapeError, UnknownName
from armlab.robots import Robot

ROBOT = robots.load("yumi_left")
HOME = ROBOT.q_home

OF_BATCHES: dict[str, Callable[[Robot, Any], Any]] = {
    "forward": kinematics.forward,
    "link_transforms": kinematics.link_transforms,
    "jacobian": kinematics.jacobian,
    "pose of forward_jacobian": lambda robot, q: kinematics.forward_jacobian(robot, q)[0],
    "jacobian in tool axes": lambda robot, q: kinematics.jacobian(robot, q, frame="tool"),
    "jacobian_derivative": lambda robot, q: kinematics.jacobian_derivative(robot, q, np.ones_like(q)),
    "parameter_jacobian": kinematics.parameter_jacobian,
    "singular_values": kinematics.singular_values,
    "manipulability": kinematics.manipulability,
    "manipulability_gradient": kinematics.manipulability_gradient,
    "axes of ellipsoid": lambda robot, q: kinematics.ellipsoid(robot, q).axes,
}
OF_ONE: dict[str, Callable[[Robot, Any], Any]] = {"self_motion": kinematics.self_motion}


def goal(**changes: float) -> np.ndarray:
    """The tool's pose at home with entries changed: goal(a03=2) has 2 in row 0, column 3."""
    T = kinematics.forward(ROBOT, HOME).copy()
    for key, value in changes.items():
        T[int(key[1]), int(key[2])] = value
    return T


def named(*tables: dict[str, Any]) -> pytest.MarkDecorator:
    cases = {name: value for table in tables for name, value in table.items()}
    return pytest.mark.parametrize("function", cases.values(), ids=cases.keys())


@named(OF_BATCHES, OF_ONE)
@pytest.mark.parametrize("shape", [(6,), (0,), (3, 8), ()])
def test_wrong_joint_count(function: Callable, shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=r"Expected q .*7.*, got .*\.$"):
        function(ROBOT, np.zeros(shape))


@named(OF_BATCHES)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_stays_in_its_sample(function: Callable, bad: float) -> None:
    """In a batch with one broken sample, the other samples do not change."""
    q = np.random.default_rng(0).uniform(ROBOT.q_min, ROBOT.q_max, (9, 7))
    broken = q.copy()
    broken[4, 2] = bad
    whole, holed = function(ROBOT, q), function(ROBOT, broken)
    others = np.arange(9) != 4
    np.testing.assert_array_equal(holed[others], whole[others])
    np.testing.assert_array_equal(function(ROBOT, q[3]), whole[3])
    assert len(function(ROBOT, q[:0])) == 0
    assert np.isnan(holed[4]).any()


@pytest.mark.parametrize("part", ["pose", "position", "rotation"])
@pytest.mark.parametrize("prismatic", [False, True])
def test_nothing_is_known_of_a_posture_that_is_not(part: Any, prismatic: bool) -> None:
    """The Jacobian of a single joint is constant, but it is NaN where the joint is NaN."""
    robot = robots.from_dh("one", 0.0, [0.0], 0.0, prismatic=[prismatic], q_min=[-1.0], q_max=[1.0])
    q = np.array([[0.5], [np.nan]])
    values = [kinematics.manipulability(robot, q, part), kinematics.singular_values(robot, q, part)]
    values += [kinematics.manipulability_gradient(robot, q, part), kinematics.jacobian(robot, q)]
    for value in values:
        assert np.isfinite(value[0]).all()
        assert np.isnan(value[1]).any()


@pytest.mark.parametrize(
    "word", ["flange", "", "Base", None, 0, ["pose"], np.zeros((6, 7)), np.array(["base", "pose"])]
)
def test_unknown_words(word: Any) -> None:
    calls: list[tuple[str, Callable[[], Any]]] = [
        ("base, tool", lambda: kinematics.forward_jacobian(ROBOT, HOME, frame=word)),
        ("base, tool", lambda: kinematics.jacobian(ROBOT, HOME, frame=word)),
        ("base, tool", lambda: kinematics.jacobian_derivative(ROBOT, HOME, HOME, frame=word)),
        ("pose, position, rotation", lambda: kinematics.manipulability(ROBOT, HOME, part=word)),
        ("position, rotation", lambda: kinematics.ellipsoid(ROBOT, HOME, part=word)),
        ("force, velocity", lambda: kinematics.ellipsoid(ROBOT, HOME, kind=word)),
        ("axis, pose, position", lambda: kinematics.self_motion(ROBOT, HOME, task=word)),
    ]
    for function, T in ((kinematics.inverse, goal()), (kinematics.inverse_path, goal()[None])):
        calls.append(("axis, direction, pose, position", partial(function, ROBOT, T, task=word)))
        if word is not None:
            words = "limits, manipulability, mid_range, posture"
            calls.append((words, partial(function, ROBOT, T, objective=word)))
    for known, call in calls:
        with pytest.raises(UnknownName, match=f"Known: {known}"):
            call()


NO_SEARCH = {
    "maxiter": [-1, 1.5, "x", None, 10**6 + 1, 2**31 - 1, 10**30, np.ones(2)],
    "starts": [0, -1, 1.5, "x", None, 2**31, [1]],
    "damping": [0.0, -1, np.nan, np.inf, "x", None, 1j, [1.0], np.ones(2)],
    "tol": [-1e-9, np.nan, "x", None, 1j, (1, 2, 3), (1e-9, np.nan), ("x", 1), [], np.ones(2)],
}


@pytest.mark.parametrize("name", NO_SEARCH)
def test_numbers_of_a_search_that_are_none(name: str) -> None:
    for value in NO_SEARCH[name]:
        for function, T in ((kinematics.inverse, goal()), (kinematics.inverse_path, goal()[None])):
            with pytest.raises(ConfigError, match=rf"^Expected {name} to be an? (integer|number) .*, got .*\.$"):
                function(ROBOT, T, **{name: value})


WRONG = [  # invalid arguments to `kinematics.inverse`
    ({"T_base_tool": np.eye(3)}, ShapeError, r"T_base_tool of shape \(\.\.\., 4, 4\), got \(3, 3\)"),
    ({"T_base_tool": np.zeros(4)}, ShapeError, r"T_base_tool of shape \(\.\.\., 4, 4\), got \(4,\)"),
    ({"T_base_tool": np.zeros((5, 3, 4))}, ShapeError, r"T_base_tool of shape \(\.\.\., 4, 4\), got \(5, 3, 4\)"),
    ({"q0": np.zeros(5)}, ShapeError, r"q0 of shape \(7,\) or one posture per goal of T_base_tool \(4, 4\), got"),
    ({"q0": np.zeros((2, 7))}, ShapeError, r"q0 of shape \(7,\) or one posture per goal"),
    ({"q0": np.full(7, np.inf)}, ShapeError, "finite joint positions, got NaN or Inf in q0"),
    ({"q0": "home"}, ShapeError, "q0"),
    ({"posture": np.zeros(6), "objective": "posture"}, ShapeError, r"Expected posture of shape \(7,\)"),
    ({"task": "axis", "axis": (0, 0, 0)}, ShapeError, "axis to be a direction"),
    ({"task": "axis", "axis": (0, np.nan, 1)}, ShapeError, "axis to be a direction"),
    ({"axis": (0, 0)}, ShapeError, r"axis of shape \(3,\), got \(2,\)"),
    ({"axis": None}, ShapeError, "axis to be an array of real numbers, got NoneType"),
    ({"seed": None}, ConfigError, "seed to be an integer"),
    ({"seed": -1}, ConfigError, r"seed to be an integer from 0 to 2\^64 - 1, got -1"),
    ({"threads": 1.5}, ConfigError, "threads to be an integer from 1 to 256"),
    *(
        ({"T_base_tool": np.stack([goal(), goal(), T])}, ShapeError, r"finite .* T_base_tool\[2\] that is not")
        for T in (1.001 * goal(a33=1 / 1.001), goal() @ np.diag([1.0, 1, -1, 1]), goal(a30=0.1), goal(a33=0),
                  goal(a03=np.nan), goal(a12=np.nan), goal(a23=np.inf), np.zeros((4, 4)))
    ),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "error", "words"), WRONG)
def test_arguments_of_the_inverse(arguments: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        kinematics.inverse(ROBOT, **({"T_base_tool": goal()} | arguments))


def test_a_posture_without_its_objective() -> None:
    """The posture would have no effect."""
    objectives: tuple[Any, ...] = (None, "limits", "mid_range", "manipulability")
    for objective in objectives:
        for function, T in ((kinematics.inverse, goal()), (kinematics.inverse_path, goal()[None])):
            with pytest.raises(ConfigError, match=r'^Expected objective="posture" with a posture, got objective='):
                function(ROBOT, T, objective=objective, posture=HOME)


def test_nothing_or_words_for_numbers() -> None:
    functions = (kinematics.forward, kinematics.self_motion, kinematics.inverse, kinematics.inverse_path)
    for value in (None, "home", ["a"] * 7, 1j * HOME, [[1, 2], [3]], {}):
        for function in functions:
            with pytest.raises(ShapeError, match=r"^Expected (q|T_base_tool) [^\n]*\.$"):
                function(ROBOT, value)
    for qd in (np.zeros(6), np.zeros((2, 6)), 0.0):
        with pytest.raises(ShapeError, match=r"Expected qd of .*7.*, got"):
            kinematics.jacobian_derivative(ROBOT, HOME, qd)
    with pytest.raises(ShapeError, match=r"Expected q to be \(7,\) finite numbers"):
        kinematics.self_motion(ROBOT, np.where(np.arange(7) == 2, np.nan, HOME))
    for function in (kinematics.forward, kinematics.jacobian):
        for threads in (0, 2.5):
            with pytest.raises(ConfigError, match="threads to be an integer from 1 to 256"):
                function(ROBOT, HOME, threads=threads)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"out to be a tuple of 2 arrays"):
        kinematics.forward_jacobian(ROBOT, HOME, out=np.empty((4, 4)))  # type: ignore[arg-type]
    for function in (*OF_BATCHES.values(), *functions):
        with pytest.raises(
            RobotError, match=r"^Expected a Robot, got 'yumi_left'\. Load the robot first: robots\.load"
        ):
            function("yumi_left", HOME)
