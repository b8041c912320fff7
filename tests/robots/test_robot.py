"""The frozen description: what it derives, what it refuses, what makes two robots equal."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest

from armlab import robots
from armlab.errors import RobotError
from armlab.lie import euler, se3
from armlab.robots import POSE_TOLERANCE, Mesh, Robot, inertia


@pytest.fixture(scope="module")
def yumi() -> Robot:
    return robots.load("yumi_left")


def forward(robot: Robot, q: np.ndarray) -> np.ndarray:
    """The law of the class, typed in."""
    T = robot.frames[0]
    for position, slides, frame in zip(q, robot.prismatic, robot.frames[1:]):
        Z = se3.from_rp(np.eye(3), [0, 0, position]) if slides else se3.from_rp(euler.rot_z(position))
        T = T @ Z @ frame
    return T


def test_frozen_and_read_only(yumi: Robot) -> None:
    with pytest.raises(FrozenInstanceError):
        yumi.name = "other"  # type: ignore[misc]
    arrays = [getattr(yumi, field.name) for field in fields(yumi)]
    for array in [*arrays, yumi.frames, yumi.screws, yumi.T_home]:
        if isinstance(array, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0


def test_it_copies_what_it_is_given() -> None:
    a = np.array([0.1, 0.2])
    robot = robots.from_dh("two", 0.0, a, 0.0, q_home=a)
    a[:] = 9
    np.testing.assert_array_equal(robot.q_home, [0.1, 0.2])
    assert replace(robot, q_home=[0.1, 0.2], joint_names=["joint_1", "joint_2"]) == robot


def test_frames_hold_mount_and_tool(yumi: Robot) -> None:
    T_base_mount, T_flange_tool = se3.exp([1, 2, 3, 0.1, 0.2, 0.3]), se3.exp([0, 0, 0.1, 0, 0, 0.5])
    moved = yumi.with_base(T_base_mount).with_tool(T_flange_tool)
    bare = yumi.with_base(np.eye(4))
    np.testing.assert_allclose(moved.T_home, T_base_mount @ bare.T_home @ T_flange_tool, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(moved.frames[1:-1], yumi.frames[1:-1])
    np.testing.assert_array_equal(moved.gravity, yumi.gravity)


def test_with_tool_replaces_the_tool(yumi: Robot) -> None:
    T_flange_tool = se3.exp([0, 0, 0.1, 0, 0, 0.5])
    twice = yumi.with_tool(se3.exp([1, 1, 1, 1, 1, 1])).with_tool(T_flange_tool)
    assert twice == yumi.with_tool(T_flange_tool)
    assert twice.with_tool(np.eye(4)) == yumi


def test_screws_and_home_are_the_product_of_exponentials(yumi: Robot) -> None:
    q = np.random.default_rng(0).uniform(-1, 1, yumi.n)
    lift = robots.from_dh("lift", [0.3, 0.1], 0.2, 0.1, prismatic=[True, False])
    for robot, position in ((yumi, q), (lift, q[:2])):
        T = np.eye(4)
        for xi, angle in zip(robot.screws, position):
            T = T @ se3.exp(xi * angle)
        np.testing.assert_allclose(T @ robot.T_home, forward(robot, position), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(lift.screws[0], [0, 0, 1, 0, 0, 0])


def test_chain_is_made_once_and_agrees(yumi: Robot) -> None:
    assert yumi.chain is yumi.chain
    np.testing.assert_allclose(yumi.chain.forward(yumi.q_home), forward(yumi, yumi.q_home), rtol=0, atol=1e-15)
    assert yumi.chain.n == yumi.n == 7


def test_equality_is_by_content(yumi: Robot) -> None:
    assert replace(yumi) == yumi
    assert hash(replace(yumi)) == hash(yumi)
    assert yumi != robots.load("yumi_right")
    assert yumi != "yumi_left"
    for field, value in (("name", "other"), ("source", "a guess"), ("q_home", np.zeros(7)), ("side", "")):
        assert replace(yumi, **{field: value}) != yumi, field


def test_joints_of_a_yumi_have_the_names_of_abb_robot_driver_in_ros(yumi: Robot) -> None:
    assert yumi.ros_joint_names == tuple(f"yumi_robl_joint_{k}" for k in range(1, 8))
    assert robots.load("yumi_right_urdf").ros_joint_names == tuple(f"yumi_robr_joint_{k}" for k in range(1, 8))
    assert replace(yumi, side="").ros_joint_names == yumi.joint_names
    assert robots.load("irb120").ros_joint_names == robots.load("irb120").joint_names


def test_hash_counts_numbers_not_words(yumi: Robot) -> None:
    assert len(yumi.hash) == 64
    assert replace(yumi, name="other", source="elsewhere", joint_names=tuple("abcdefg")).hash == yumi.hash
    nudged = yumi.links.copy()
    nudged[3, 0, 3] += 1e-9
    changes = {
        "links": nudged,
        "prismatic": np.array([True] + [False] * 6),
        "q_min": yumi.q_min - 1e-6,
        "gravity": np.array([0, 0, -9.81]),
        "coupling": np.eye(7),
        "abb_axes": (1, 2, 3, 4, 5, 6, 7),
        "T_base_mount": np.eye(4),
        "T_flange_tool": se3.from_rp(np.eye(3), [0, 0, 0.1]),
    }
    hashes = {replace(yumi, **{field: value}).hash for field, value in changes.items()}
    assert len(hashes | {yumi.hash}) == len(changes) + 1


def test_hash_does_not_see_the_last_digit_or_the_sign_of_zero(yumi: Robot) -> None:
    """Another machine's sine may differ in the last digit; its model files are still those of this robot."""
    links = yumi.links.copy()
    links[:, :3, :3] += np.spacing(links[:, :3, :3])
    assert replace(yumi, links=links).hash == yumi.hash
    zeros = [replace(yumi, q_home=zero * np.ones(7)) for zero in (0.0, -0.0)]
    assert zeros[0].hash == zeros[1].hash
    assert zeros[0].q_home.tobytes() == zeros[1].q_home.tobytes()


def test_pickle_and_copy(yumi: Robot) -> None:
    assert yumi.chain.n == 7  # the cached chain must not stand in the way
    for twin in (pickle.loads(pickle.dumps(yumi)), copy.deepcopy(yumi)):
        assert twin == yumi
        assert not twin.links.flags.writeable


def test_repr(yumi: Robot) -> None:
    assert repr(yumi) == "Robot('yumi_left', 7 joints)"


def test_optional_numbers_count_in_the_hash_where_there_are_any(yumi: Robot) -> None:
    """Model files are bound to the hash: a robot that says nothing of torques and masses keeps the one it had."""
    assert yumi.hash == "dabb698bc5f5565c350e713f803600a5ebf2206271f2684ab6e7963726dd1029"
    assert np.isinf(yumi.tau_max).all()
    assert yumi.inertias is None
    assert yumi.meshes == ()
    mesh = Mesh("visual", "link.stl", np.eye(4), np.ones(3))
    shaped = replace(yumi, meshes=[[], [mesh], *[[]] * 6])
    assert shaped.hash == yumi.hash
    assert shaped != yumi
    assert shaped.meshes == ((), (mesh,), *[()] * 6)
    assert replace(yumi, meshes=[[]] * 8) == yumi
    heavy = replace(yumi, inertias=np.zeros((7, 10)))
    strong = replace(yumi, tau_max=[np.inf] * 6 + [5.0])
    assert len({yumi.hash, heavy.hash, strong.hash, replace(heavy, tau_max=strong.tau_max).hash}) == 4
    assert heavy != yumi
    assert replace(heavy) == heavy
    assert pickle.loads(pickle.dumps(shaped)) == shaped
    with pytest.raises(ValueError, match="read-only"):
        heavy.inertias[0, 0] = 1.0


def test_tool_and_base_keep_names_and_bodies(yumi: Robot) -> None:
    pi = inertia.from_body(np.arange(1.0, 8.0), np.full((7, 3), 0.1), np.tile(np.eye(3), (7, 1, 1)))
    mesh = Mesh("visual", "body.stl", np.eye(4), np.ones(3))
    robot = replace(yumi, inertias=pi, tau_max=np.arange(1.0, 8.0), meshes=[[mesh], *[[]] * 7])
    moved = robot.with_tool(se3.exp([0, 0, 0.1, 0, 0, 1])).with_base(se3.exp([1, 0, 0, 0, 1, 0]))
    assert moved.joint_names == yumi.joint_names
    assert (moved.name, moved.meshes) == (yumi.name, robot.meshes)
    np.testing.assert_array_equal(moved.inertias, pi)
    np.testing.assert_array_equal(moved.tau_max, robot.tau_max)


BODY = inertia.from_body(1.0, [0.1, 0, 0], np.diag([1.0, 2.0, 2.5]))
MESH = Mesh("visual", "link.stl", np.eye(4), np.ones(3))
LIMITS = {"q_min": [-1.0, -1.0], "q_max": [1.0, 1.0], "qd_max": [1.0, 1.0]}


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (
            {"q_max": [1, -2]},
            r"Expected q_min below q_max at joint 2 \(joint_2\) of robot 'r', got q_min -1, q_max -2",
        ),
        ({"q_min": [-1, np.nan]}, r"Expected numbers in q_min of robot 'r', got NaN at joint 2 \(joint_2\)\."),
        (
            {"q_home": [0, 3]},
            r"inside the limits at joint 2 \(joint_2\) of robot 'r', got q_home 3, q_min -1",
        ),
        ({"q_home": [np.inf, 0], "q_max": [np.inf, 1]}, "Expected a finite home position at joint 1"),
        ({"qd_max": [0, 1]}, "Expected a positive speed limit at joint 1"),
        ({"qdd_max": [1, -1]}, "Expected a positive acceleration limit at joint 2"),
        ({"tau_max": [1, 0]}, r"Expected a positive torque limit at joint 2 \(joint_2\) of robot 'r', got tau_max 0"),
        ({"tau_max": [1, np.nan]}, "Expected numbers in tau_max of robot 'r', got NaN at joint 2"),
        ({"inertias": [BODY]}, r"Expected inertias of robot 'r' \(2 joints\) to have shape \(2, 10\), got \(1, 10\)"),
        ({"inertias": [BODY, np.full(10, np.nan)]}, "Expected numbers in inertias of robot 'r', got NaN at index"),
        (
            {"inertias": [BODY, [np.inf] * 10]},
            "Expected the inertia of a body for link 2 of robot 'r', got .* not finite",
        ),
        ({"inertias": [BODY, -BODY]}, "Expected the inertia of a body for link 2 of robot 'r', got a mass of -1 kg"),
        ({"inertias": [[0, 1] + [0] * 8, BODY]}, "body for link 1 of robot 'r', got moments without a mass"),
        (
            {"inertias": [BODY, inertia.from_body(1.0, [0, 0, 0], np.diag([-1e-3, 1, 1]))]},
            r"body for link 2 of robot 'r', got principal moments \[-0.001",
        ),
        ({"meshes": [["link.stl"], [], []]}, "Expected a robots.Mesh in meshes of robot 'r', got 'link.stl'"),
        ({"meshes": [[MESH], []]}, "Expected meshes in robot 'r' of the mount and 2 links, got 2 tuples"),
        ({"q_min": [0, 0, 0]}, r"Expected q_min of robot 'r' \(2 joints\) to have shape \(2,\), got \(3,\)\."),
        ({"gravity": [0, 0]}, r"to have shape \(3,\), got \(2,\)"),
        ({"gravity": [0, 0, np.inf]}, "Expected a finite gravity"),
        ({"gravity": [0, 0, np.nan]}, r"Expected numbers in gravity of robot 'r', got NaN at index \(2,\)\."),
        ({"coupling": np.ones((2, 2))}, "Expected a coupling of robot 'r' that can be inverted"),
        (
            {"T_base_mount": 2 * np.eye(4)},
            "Expected T_base_mount of robot 'r' to be a pose with a rotation",
        ),
        ({"T_flange_tool": np.zeros((4, 4))}, "Expected T_flange_tool of robot 'r' to be a pose"),
        ({"T_flange_tool": np.eye(3)}, r"to have shape \(4, 4\), got \(3, 3\)"),
        ({"joint_names": ["a"]}, r"Expected 2 different joint_names of robot 'r', got \['a'\]\."),
        ({"joint_names": ["a", "a"]}, "Expected 2 different joint_names"),
        ({"abb_axes": [1, 3]}, r"Expected abb_axes of robot 'r' to hold 1 to 2 once each, got \[1, 3\]\."),
        ({"abb_axes": [1, 1]}, "Expected 2 different abb_axes"),
        ({"side": "up"}, 'to be "left", "right" or "", got \'up\'.'),
    ],
)
def test_contradictions_are_refused_with_a_sentence(wrong: dict, sentence: str) -> None:
    with pytest.raises(RobotError, match=sentence):
        robots.from_dh("r", [0.0, 0.0], 1.0, 0.0, **(LIMITS | wrong))


def test_a_rotation_that_is_off_is_refused() -> None:
    links = np.tile(np.eye(4), (2, 1, 1))
    links[1, 0, 1] = 2 * POSE_TOLERANCE
    with pytest.raises(RobotError, match=r"Expected links\[1\] of robot 'r' to be a pose.*Project it first"):
        robots.from_links("r", links)
    links[1, 0, 1] = POSE_TOLERANCE / 2
    assert robots.from_links("r", links).n == 1


def test_an_inertia_that_no_body_has_but_that_moves_is_accepted() -> None:
    """Published descriptions break the triangle inequality; every mass matrix is positive all the same."""
    flat = inertia.from_body(1.0, [0, 0, 0], np.diag([1.0, 1.0, 3.0]))
    rounded = inertia.from_body(1.0, [0, 0, 0], np.diag([-1e-7, 1.0, 1.0]))
    assert robots.from_dh("r", [0.0, 0.0], 1.0, 0.0, inertias=[flat, rounded]).inertias is not None


def test_no_joints_are_refused() -> None:
    with pytest.raises(RobotError, match="Expected at least one joint for robot 'r'"):
        robots.from_links("r", np.eye(4)[None])
