"""Robots: fields, builders, products of exponentials, meshes, outline, refusals."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import ArmlabError, RobotError, ShapeError, UnknownName
from armlab.lie import se3, so3
from armlab.robots import Mesh, Robot, inertia
from armlab.robots.build import GRAVITY, RAMP_TIME
from armlab.robots.robot import arm_length, bends

FILE = "package://maker/link_1.stl"


@pytest.fixture(scope="module")
def yumi() -> Robot:
    return robots.load("yumi_left")


def test_frozen_and_read_only(yumi: Robot) -> None:
    with pytest.raises(FrozenInstanceError):
        yumi.name = "other"  # type: ignore[misc]
    arrays = [getattr(yumi, field.name) for field in fields(yumi)]
    for array in [*arrays, yumi.frames, yumi.screws, yumi.T_home]:
        if isinstance(array, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0


def test_it_copies_what_it_is_given_and_fills_in_the_rest() -> None:
    a = np.array([0.1, 0.2])
    robot = robots.from_dh("two", 0.0, a, 0.0, q_home=a)
    a[:] = 9
    np.testing.assert_array_equal(robot.q_home, [0.1, 0.2])
    assert replace(robot, q_home=[0.1, 0.2], joint_names=["joint_1", "joint_2"]) == robot
    assert np.isinf([robot.q_max, robot.qdd_max]).all()
    np.testing.assert_array_equal(robot.gravity, GRAVITY)
    np.testing.assert_array_equal(robot.coupling, np.eye(2))
    assert (robot.joint_names, robot.abb_axes, robot.side, robot.source) == (("joint_1", "joint_2"), (1, 2), "", "")
    limited = two(q_min=[0.5, -2], q_max=[1, -1], qd_max=[2.0, 3.0])
    np.testing.assert_array_equal(limited.q_home, [0.5, -1])
    np.testing.assert_array_equal(limited.qdd_max, np.array([2.0, 3.0]) / RAMP_TIME)
    assert repr(limited) == "Robot('r', 2 joints)"


def test_frames_hold_mount_and_tool(yumi: Robot) -> None:
    """For a robot with bodies and meshes; everything else stays the same."""
    T_base_mount, T_flange_tool = se3.exp([1, 2, 3, 0.1, 0.2, 0.3]), se3.exp([0, 0, 0.1, 0, 0, 0.5])
    pi = inertia.from_body(np.arange(1.0, 8.0), np.full((7, 3), 0.1), np.tile(np.eye(3), (7, 1, 1)))
    robot = replace(yumi, inertias=pi, tau_max=np.arange(1.0, 8.0), meshes=[[MESH], *[[]] * 7])
    moved = robot.with_base(T_base_mount).with_tool(T_flange_tool)
    bare = yumi.with_base(np.eye(4))
    np.testing.assert_allclose(moved.T_home, T_base_mount @ bare.T_home @ T_flange_tool, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(moved.frames[1:-1], yumi.frames[1:-1])
    assert replace(moved, T_base_mount=yumi.T_base_mount, T_flange_tool=yumi.T_flange_tool) == robot
    for T, sentence in (
        (2 * ONE, "to be a pose"),
        (np.diag([-1.0, 1, 1, 1]), "to be a pose"),  # a mirror
        (ONE + 2e-5 * np.eye(4, k=1), "orthonormal within 1e-05.*project the pose first"),
        (ONE * [1, 1, 1, np.nan], "NaN|be a pose"),
        (np.eye(3), r"to have shape \(4, 4\), got \(3, 3\)"),
        ("up", "to be real numbers, got 'up'"),
    ):
        for change, field in ((yumi.with_tool, "T_flange_tool"), (yumi.with_base, "T_base_mount")):
            with pytest.raises(RobotError, match=rf"Expected .*{field} of robot 'yumi_left'.*{sentence}"):
                change(T)


def test_equality_is_by_content(yumi: Robot) -> None:
    assert replace(yumi) == yumi
    assert hash(replace(yumi)) == hash(yumi)
    assert yumi != robots.load("yumi_right")
    assert yumi != "yumi_left"
    assert yumi.chain.n == 7  # the cached chain must not interfere
    for twin in (pickle.loads(pickle.dumps(yumi)), copy.deepcopy(yumi)):
        assert twin == yumi
        assert not twin.links.flags.writeable
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
    """Another machine's sine may differ in the last digit; its model files must still match this robot."""
    links = yumi.links.copy()
    links[:, :3, :3] += np.spacing(links[:, :3, :3])
    assert replace(yumi, links=links).hash == yumi.hash
    zeros = [replace(yumi, q_home=zero * np.ones(7)) for zero in (0.0, -0.0)]
    assert zeros[0].hash == zeros[1].hash
    assert zeros[0].q_home.tobytes() == zeros[1].q_home.tobytes()


def test_optional_numbers_count_in_the_hash_where_there_are_any(yumi: Robot) -> None:
    """Model files are bound to the hash: a robot without torque limits and masses keeps its earlier hash."""
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


BODY = inertia.from_body(1.0, [0.1, 0, 0], np.diag([1.0, 2.0, 2.5]))
MESH = Mesh("visual", "link.stl", np.eye(4), np.ones(3))
LIMITS = {"q_min": [-1.0, -1.0], "q_max": [1.0, 1.0], "qd_max": [1.0, 1.0]}


def test_a_rotation_that_is_off_is_refused() -> None:
    links = np.tile(np.eye(4), (2, 1, 1))
    links[1, 0, 1] = 2 * so3.ROTATION_TOLERANCE
    with pytest.raises(RobotError, match=r"Expected links\[1\] of robot 'r' to be a pose.*project the pose first"):
        robots.from_links("r", links)
    links[1, 0, 1] = so3.ROTATION_TOLERANCE / 2
    assert se3.is_pose(robots.from_links("r", links).links, 1e-14).all()


@pytest.mark.parametrize("digits", [6, 8, 12])
def test_rounded_poses_are_projected(digits: int) -> None:
    """Rounded to eight decimals, as poses are printed; rotations orthonormal to 1e-9 keep their bits."""
    T = se3.exp(np.random.default_rng(1).normal(size=6))
    arm = robots.load("ur5e").with_tool(np.round(T, digits)).with_base(np.round(T, digits))
    np.testing.assert_allclose(arm.T_flange_tool, T, rtol=0, atol=2 * 10.0**-digits)
    assert se3.is_pose(np.stack([arm.T_flange_tool, arm.T_base_mount]), 1e-9).all()
    if digits == 12:
        np.testing.assert_array_equal(arm.T_flange_tool, np.round(T, digits))


def dh_matrix(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    """The textbook DH matrix, entry by entry."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]])


def craig_matrix(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    """Craig, Introduction to Robotics, equation 3.6."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st, 0, a], [st * ca, ct * ca, -sa, -sa * d], [st * sa, ct * sa, ca, ca * d], [0, 0, 0, 1]])


def product(matrix, table: np.ndarray, prismatic: np.ndarray, q: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    for (alpha, a, d, offset), slides, position in zip(table.T, prismatic, q):
        T = T @ matrix(offset + position * (not slides), d + position * slides, a, alpha)
    return T


@pytest.mark.parametrize("modified", [False, True])
def test_from_dh_equals_the_textbook_product(modified: bool) -> None:
    """Random robots of 2 to 9 joints, revolute and prismatic; tests/laws has a thousand of them in all forms."""
    rng = np.random.default_rng(0)
    matrix = craig_matrix if modified else dh_matrix
    for _ in range(100):
        n = int(rng.integers(2, 10))
        table = rng.uniform(-np.pi, np.pi, (4, n)) * [[1], [0.3], [0.3], [1]]
        prismatic = rng.random(n) < 0.3
        robot = robots.from_dh("random", *table, prismatic=prismatic, modified=modified)
        q = rng.uniform(-3, 3, n)
        np.testing.assert_allclose(
            kinematics.forward(robot, q), product(matrix, table, prismatic, q), atol=1e-12, rtol=0
        )


def test_limits_that_look_like_degrees_are_doubted() -> None:
    with pytest.warns(
        UserWarning, match=r"'r' within four revolutions, got joint_2 \(-170 to 170 rad\)\. If these are d"
    ):
        robot = robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, q_min=[-3.0, -170.0], q_max=[3.0, 170.0])
    assert robot.q_max[1] == 170.0
    turns = 2.0 * np.pi * np.array([1.1, 4.0, 96.0, np.inf])  # 400 degrees; an ABB wrist; unlimited
    robots.from_dh("wide", 0.0, np.ones(4), 0.0, q_min=-turns, q_max=turns)
    robots.from_dh("slide", 0.0, 1.0, 0.0, prismatic=[True], q_min=[0.0], q_max=[100.0])


def test_angles_of_a_table_that_look_like_degrees_are_doubted() -> None:
    with pytest.warns(UserWarning, match=r"one revolution, got alpha of 90 rad in the DH table of 'two links'\. If th"):
        robots.from_dh("two links", 90.0, [1.0, 1.0], 0.0)
    with pytest.warns(UserWarning, match="got offset of 180 rad"):
        robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, [0.0, -180.0])
    robots.from_dh("r", [2.0 * np.pi, -np.pi], [1.0, 1.0], 0.0, [-np.pi, 2.0 * np.pi])


def random_screws(rng: np.random.Generator, n: int) -> np.ndarray:
    """Unit axes through random points; about a third are prismatic."""
    axis = rng.standard_normal((n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    slides = rng.random((n, 1)) < 0.3
    return np.where(slides, np.hstack([axis, 0 * axis]), np.hstack([np.cross(rng.standard_normal((n, 3)), axis), axis]))


def test_the_ancestors_test_robot() -> None:
    """Robotlib.jl's runtests.jl: axes z y y x y x. It takes v = -p × w, so its axes go through the points -p."""
    axes = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], dtype=float)
    points = -np.array([[0, 0, 0], [0, 0, 0.3], [0, 0, 1], [1, 0, 1], [1, 0, 1], [1, 0, 1]])
    T_home = [[0, -1, 0, 1.2], [0, 0, -1, 0], [1, 0, 0, 1], [0, 0, 0, 1.0]]
    robot = robots.from_poe("runtests", np.hstack([np.cross(points, axes), axes]), T_home)
    p = kinematics.forward(robot, 0.1 * np.arange(1, 7))[:3, 3]
    np.testing.assert_allclose(p, (1.447748001821, -1.054251457784, -1.879210347845), rtol=0, atol=1e-12)


def test_normalise_screw() -> None:
    np.testing.assert_allclose(robots.normalise_screw([1, 2, 3, 0, 0, 2]), [0.5, 1, 0, 0, 0, 1])
    np.testing.assert_allclose(robots.normalise_screw([1, 2, 3, 0, 0, 2], keep_pitch=True), [0.5, 1, 1.5, 0, 0, 1])
    np.testing.assert_allclose(robots.normalise_screw([0, 3, 4, 0, 0, 0]), [0, 0.6, 0.8, 0, 0, 0])
    rough = random_screws(np.random.default_rng(4), 50) * 1.3
    before = rough.copy()
    np.testing.assert_allclose(robots.normalise_screw(rough), before / 1.3, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(rough, before)
    assert robots.normalise_screw(rough.reshape(5, 10, 6)).shape == (5, 10, 6)


def test_equal_by_content_and_read_only() -> None:
    T_link_mesh = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    mesh = Mesh("collision", FILE, T_link_mesh, np.array([0.001, 0.001, -0.001]))
    twin = pickle.loads(pickle.dumps(mesh))
    assert twin == mesh
    assert hash(twin) == hash(mesh)
    assert mesh != Mesh("visual", FILE, T_link_mesh, mesh.scale)
    assert mesh != Mesh("collision", FILE, np.eye(4), mesh.scale)
    assert mesh != FILE
    T_link_mesh[0, 3] = 9.0
    assert mesh.T_link_mesh[0, 3] != 9.0
    for array in (twin.T_link_mesh, twin.scale):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


def test_a_stretched_arm_is_as_long_as_its_links_and_strokes_together() -> None:
    limits = {"q_min": [-2, -2, 0, -3], "q_max": [2, 2, 0.3, 3]}
    alpha, a, d = [0, np.pi, 0, 0], [0.4, 0.3, 0, 0], [0.5, 0, 0, 0.05]
    scara = robots.from_dh("scara", alpha, a, d, prismatic=[0, 0, 1, 0], **limits)
    assert arm_length(scara) == pytest.approx(np.hypot(0.5, 0.4) + 0.3 + 0.3 + 0.05)


ONE = np.eye(4)
LINKS = np.tile(ONE, (3, 1, 1))
TURN = [[0, 0, 0, 0, 0, 1]]


def two(**details: Any) -> Robot:
    return robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, **details)


BAD: dict[str, tuple[Callable[[], object], type[ArmlabError], str]] = {
    "a number": (lambda: robots.from_links("r", 3.0), RobotError, "Expected at least one joint for robot 'r'"),
    "one pose": (lambda: robots.from_links("r", ONE), RobotError, "Expected links of robot 'r' .* got"),
    "NaN in a link": (lambda: robots.from_links("r", LINKS * np.nan), RobotError, "Expected numbers in links"),
    "scaled link": (lambda: robots.from_links("r", 2 * LINKS), RobotError, r"Expected links\[0\] of robot 'r'"),
    "one flag for two joints": (
        lambda: robots.from_links("r", LINKS, [True]), RobotError,
        r"Expected `prismatic` of robot 'r' \(2 joints\) to have shape \(2,\), got \(1,\)\.",
    ),
    "a matrix of angles": (
        lambda: robots.from_dh("r", np.zeros((2, 2)), 0, 0), RobotError,
        r"Expected alpha in the DH table of 'r' to be one column \(n,\), got shape \(2, 2\)\.",
    ),
    "columns of two lengths": (lambda: robots.from_dh("r", 0, [1, 2], [1, 2, 3]), RobotError, "equal length"),
    "screws of five": (lambda: robots.from_poe("r", np.ones((2, 5)), ONE), RobotError, r"screws of shape \(n, 6\)"),
    "NaN in a screw": (lambda: robots.from_poe("r", np.full((1, 6), np.nan), ONE), RobotError, "for joint 1"),
    "a home that is none": (lambda: robots.from_poe("r", TURN, 2 * ONE), RobotError, "Expected T_home of robot 'r'"),
    "poses missing": (lambda: robots.from_local_poe("r", ONE[None], TURN), RobotError, r"\(n\+1, 4, 4\)"),
    "no limits": (lambda: two(q_min=None), RobotError, "Expected q_min of robot 'r' to be real numbers, got None"),
    "no source": (lambda: two(source=None), RobotError, "Expected text in source of robot 'r', got None"),
    "nine inertial numbers": (lambda: two(inertias=np.zeros((2, 9))), RobotError, r"shape \(2, 10\), got \(2, 9\)"),
    "no names": (lambda: two(joint_names=None), RobotError, "Expected joint_names of robot 'r' to be a list or tuple"),
    "axes that are no counts": (lambda: two(abb_axes=[1.0, 2.0]), RobotError, r"to be integers, got \[1\.0, 2\.0\]"),
    "meshes not by link": (lambda: two(meshes=[1, 2, 3]), RobotError, "Expected meshes of one link of robot 'r'"),
    "half a flag": (lambda: robots.from_links("r", LINKS, [1, 0.5]), RobotError, "Expected Booleans in prismatic"),
    "a convention by name": (
        lambda: robots.from_dh("r", 0, [1, 2], 0, modified="standard"), RobotError,  # type: ignore[arg-type]
        "Expected `modified` of robot 'r' to be True or False, got 'standard'",
    ),
    "33 joints": (lambda: robots.from_dh("r", 0, np.ones(33), 0), RobotError, "Expected at most 32 joints for robot"),
    "one scale": (
        lambda: robots.Mesh("visual", "a.stl", ONE, 2.0), RobotError,  # type: ignore[arg-type]
        "Expected 3 finite, non-zero scale factors for mesh 'a.stl'",
    ),
    "a name for a robot": (
        lambda: robots.to_local_poe("irb120"), RobotError,  # type: ignore[arg-type]
        r"Expected a Robot, got 'irb120'\. Load the robot first: robots\.load\('irb120'\)\.",
    ),
    "nothing to save": (lambda: robots.save(None, "r.toml"), RobotError, "Expected a Robot, got None"),  # type: ignore[arg-type]
    "nowhere to save": (lambda: robots.save(two(), None), RobotError, "Expected a file path"),  # type: ignore[arg-type]
    "no path at all": (lambda: robots.urdf.read(None), RobotError, "Expected a URDF file at None"),  # type: ignore[arg-type]
    "a path for a text": (
        lambda: robots.urdf.parse(Path("a.urdf")), RobotError,  # type: ignore[arg-type]
        "Expected the text of a URDF, got .*For a file, call urdf.read",
    ),
    "a number for a name": (lambda: robots.load(3), UnknownName, "got '3'. Known: dh_test"),  # type: ignore[arg-type]
    "a misspelt detail": (lambda: two(q_maxx=[1.0, 1.0]), RobotError, "got 'q_maxx'"),
    "no screw": (lambda: robots.normalise_screw(np.zeros(6)), ShapeError, "of nonzero length"),
    "a screw with NaN": (lambda: robots.normalise_screw([0, 0, 0, 0, 0, np.nan]), ShapeError, "not finite"),
    "three of a screw": (
        lambda: robots.normalise_screw([1, 2, 3]), ShapeError, r"screws of shape \(\.\.\., 6\), got \(3,\)\.",
    ),
    "a long screw": (
        lambda: robots.from_poe("r", [[0, 0, 0, 0, 0, 2.0]], ONE), RobotError,
        "for joint 1 of robot 'r', got length 2 and pitch 0 m/rad. Use robots",
    ),
    "a screw with pitch": (
        lambda: robots.from_poe("r", [[0, 0, 1, 0, 0, 1]], ONE), RobotError, "got length 1 and pitch 1 m/rad",
    ),
    **{f"mesh with {key} {value!r}": (
        lambda key=key, value=value: replace(MESH, **{key: value}),
        RobotError, words,
    ) for key, value, words in (
        ("kind", "picture", 'Expected "visual" or "collision" as the kind of mesh .* got \'picture\''),
        ("file", "", "Expected the file name of a mesh, got \'\'"),
        ("file", 5, "Expected the file name of a mesh, got 5"),
        ("T_link_mesh", 2 * ONE, r"Expected a pose \(4, 4\) for mesh"),
        ("scale", (1, 0, 1), "Expected 3 finite, non-zero scale factors for mesh"),
        ("scale", "one", "Expected scale of mesh .* to be real numbers, got \'one\'"),
    )},
    **{words: (lambda wrong=wrong: two(**(LIMITS | wrong)), RobotError, words) for wrong, words in (
        ({"q_home": [np.inf, 0], "q_max": [np.inf, 1]}, "Expected a finite home position at joint 1"),
        ({"qdd_max": [1, -1]}, "Expected a positive acceleration limit at joint 2"),
        ({"inertias": [BODY, np.full(10, np.nan)]}, "Expected numbers in inertias of robot 'r', got NaN at index"),
        ({"inertias": [BODY, [np.inf] * 10]}, "Expected a consistent inertia of link 2 of robot 'r', got .* not"),
        ({"inertias": [[0, 1] + [0] * 8, BODY]}, "inertia of link 1 of robot 'r', got moments without a mass"),
        ({"inertias": [BODY, inertia.from_body(1.0, [0, 0, 0], np.diag([-1e-3, 1, 1]))]}, r"moments \[-0.001"),
        ({"meshes": [["link.stl"], [], []]}, "Expected a robots.Mesh in the meshes of robot 'r', got 'link.stl'"),
        ({"meshes": [[MESH], []]}, "Expected meshes of the mount and 2 links in robot 'r', got 2 tuples"),
        ({"gravity": [0, 0, np.inf]}, "Expected finite gravity"),
        ({"gravity": [0, 0, np.nan]}, r"Expected numbers in gravity of robot 'r', got NaN at index \(2,\)\."),
        ({"joint_names": ["a"]}, r"Expected 2 different joint_names for robot 'r', got \['a'\]\."),
        ({"abb_axes": [1, 3]}, r"Expected `abb_axes` of robot 'r' to contain 1 to 2 exactly once each, got \[1, 3\]\."),
        ({"side": "up"}, 'to be "left", "right" or "", got \'up\'.'),
        ({"qd_max": [1.0, 2.0, 3.0]}, r"qd_max of robot 'r' \(2 joints\) to have shape \(2,\), got \(3,\)"),
        ({"q_home": [0.5, np.nan]}, r"Expected numbers in q_home of robot 'r', got NaN at joint 2 \(joint_2\)\."),
        ({"tau_max": "many"}, "Expected tau_max of robot 'r' to be real numbers, got 'many'"),
    )},
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_one_sentence(case: str) -> None:
    make, error, sentence = BAD[case]
    with pytest.raises(error, match=sentence) as caught:
        make()
    message = str(caught.value)
    assert message.endswith((".", "?"))  # "Did you mean ...?"
    assert "\n" not in message
    assert len(message) < 500


def test_bends_of_a_link() -> None:
    """Axis z through the origin and an axis y have a common normal, parallel axes the foot of a perpendicular."""
    z, y, b = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([0.3, 0.1, 0.5])
    np.testing.assert_allclose(bends(np.zeros(3), z, b, y), [[0.0, 0.0, 0.5], [0.3, 0.0, 0.5]], atol=1e-15, rtol=0)
    np.testing.assert_allclose(bends(np.zeros(3), z, b, z), [[0.0, 0.0, 0.5]], atol=1e-15, rtol=0)
