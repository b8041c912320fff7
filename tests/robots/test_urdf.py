"""URDF read and written."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from armlab import robots
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.lie import euler, se3
from armlab.robots import Mesh, Robot, inertia, urdf
from armlab.robots.build import GRAVITY, Details
from armlab.robots.urdf import Mimic, Tree
from armlab.robots.urdf.tree import Follow, Joint, Link

from ..dynamics.test_rigid_body import random_robot as random_chain

TWO_ARMS = """<?xml version="1.0"?>
<robot name="two arms" xmlns:xacro="somewhere">
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="body"><visual><geometry>
    <mesh filename="package://maker/body.stl" scale="0.001 0.001 0.001"/></geometry></visual></link>
  <joint name="left_mount" type="fixed">
    <parent link="body"/><child link="left_base"/><origin xyz="0 0.3 1" rpy="-0.5 0 0"/>
  </joint>
  <link name="left_base"/>
  <joint name="left_turn" type="revolute">
    <parent link="left_base"/><child link="left_1"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 2"/>
    <limit lower="-2.5" upper="2.5" effort="40" velocity="3"/>
    <dynamics damping="0.5" friction="1"/>
  </joint>
  <link name="left_1">
    <inertial><mass value="2"/><origin xyz="0 0 0.05"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial>
    <visual><origin xyz="0 0 0.05"/><geometry><mesh filename="left_1.obj"/></geometry></visual>
    <visual><geometry><box size="1 1 1"/></geometry></visual>
    <collision><geometry><mesh filename="left_1.obj"/></geometry></collision>
  </link>
  <joint name="left_slide" type="prismatic">
    <parent link="left_1"/><child link="left_2"/>
    <origin xyz="0.1 0 0" rpy="0 0 1.2"/><axis xyz="1 1 0"/>
    <limit lower="0" upper="0.4" effort="100" velocity="0.5"/>
  </joint>
  <link name="left_2">
    <inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
  </link>
  <joint name="left_cup" type="fixed"><parent link="left_2"/><child link="cup"/><origin xyz="0 0 0.2"/></joint>
  <link name="cup">
    <inertial><mass value="0.5"/><origin xyz="0 0 0.1" rpy="0.3 0 0"/>
      <inertia ixx="0.003" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.001"/></inertial>
  </link>
  <joint name="right_turn" type="continuous">
    <parent link="body"/><child link="right_1"/><origin xyz="0 -0.3 1"/><limit effort="0" velocity="2"/>
  </joint>
  <link name="right_1"/>
  <joint name="finger_a" type="prismatic">
    <parent link="right_1"/><child link="tip_a"/><origin xyz="0 0.01 0"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.03" effort="5" velocity="0.1"/>
  </joint>
  <joint name="finger_b" type="prismatic">
    <parent link="right_1"/><child link="tip_b"/><origin xyz="0 -0.01 0"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="0.03" effort="5" velocity="0.1"/>
    <mimic joint="finger_a" multiplier="1.5" offset="0.002"/>
  </joint>
  <link name="tip_a"/>
  <link name="tip_b"/>
  <transmission name="t"><joint name="left_turn"/><actuator name="m"/></transmission>
  <gazebo reference="left_1"><joint name="left_turn"/></gazebo>
</robot>
"""
ONE_ARM = TWO_ARMS.replace('turn" type="continuous"', 'turn" type="fixed"')
ONE_ARM = ONE_ARM.replace('_a" type="prismatic"', '_a" type="fixed"').replace(
    '_b" type="prismatic"', '_b" type="fixed"'
)


@pytest.fixture(scope="module")
def tree() -> Tree:
    return urdf.parse(TWO_ARMS)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_a_tree_holds(tree: Tree) -> None:
    assert repr(tree) == "Tree('two arms', 8 links, 7 joints)"
    assert tree.root == "body"
    assert tree.tips == ("cup", "tip_a", "tip_b")
    assert tree.tips_below("right_1") == ("tip_a", "tip_b")
    assert tree.tips_below("left_2") == ()
    joint = tree.parent_joints["left_2"]
    assert isinstance(joint, Joint)
    line = 1 + TWO_ARMS[: TWO_ARMS.index('<joint name="left_slide"')].count("\n")
    assert (joint.name, joint.kind, joint.parent, joint.line) == ("left_slide", "prismatic", "left_1", line)
    assert joint.moves
    np.testing.assert_array_equal(joint.axis, [1, 1, 0])
    assert [joint.name for joint in tree.child_joints["right_1"]] == ["finger_a", "finger_b"]
    assert tree.child_joints["tip_b"] == ()
    link = next(link for link in tree.links if link.name == "left_1")
    assert isinstance(link, Link)
    pi = inertia.from_body(2.0, [0, 0, 0.05], np.diag([0.02, 0.02, 0.01]))
    np.testing.assert_allclose(link.inertia, pi, rtol=0, atol=1e-17)
    assert [mesh.kind for mesh in link.meshes] == ["visual", "collision"]
    with pytest.raises(FrozenInstanceError):
        tree.name = "other"  # type: ignore[misc]


def test_a_chain_has_what_its_branch_has(tree: Tree) -> None:
    robot = tree.chain("body", "cup", name="left")
    assert (robot.name, robot.joint_names) == ("left", ("left_turn", "left_slide"))
    np.testing.assert_array_equal(robot.prismatic, [False, True])
    np.testing.assert_array_equal([robot.q_min, robot.q_max], [[-2.5, 0], [2.5, 0.4]])
    np.testing.assert_array_equal([robot.qd_max, robot.tau_max], [[3, 0.5], [40, 100]])
    np.testing.assert_array_equal(robot.gravity, GRAVITY)
    assert robot.source.splitlines() == [
        "geometry: the URDF text, from 'body' to 'cup'",
        "gravity: assumption: z of 'body' points up",
        "accelerations: assumption: full speed is reached in 0.1 s",
    ]
    mount = se3.from_rp(euler.rot_x(-0.5), [0, 0.3, 1]) @ se3.from_rp(np.eye(3), [0, 0, 0.1])
    np.testing.assert_allclose(robot.links[0], mount, rtol=0, atol=1e-15)
    z = robot.links[1][:3, 2]  # the slide is along (1, 1, 0) of a frame turned by 1.2 about z
    np.testing.assert_allclose(z, [np.cos(np.pi / 4 + 1.2), np.sin(np.pi / 4 + 1.2), 0], rtol=0, atol=1e-15)


def test_meshes_move_with_their_links(tree: Tree) -> None:
    robot = tree.chain("left_base", "cup")
    foot, first, second = robot.meshes
    assert foot == (Mesh("visual", "package://maker/body.stl", foot[0].T_link_mesh, np.full(3, 0.001)),)
    T_base_body = se3.inv(se3.from_rp(euler.rot_x(-0.5), [0, 0.3, 1]))
    np.testing.assert_allclose(foot[0].T_link_mesh, T_base_body, rtol=0, atol=1e-15)
    assert [(mesh.kind, mesh.file) for mesh in first] == [("visual", "left_1.obj"), ("collision", "left_1.obj")]
    np.testing.assert_array_equal(first[0].T_link_mesh[:3, 3], [0, 0, 0.05])
    assert second == ()
    assert tree.chain("right_1", "tip_a").meshes == ()


def test_gravity_follows_the_base(tree: Tree) -> None:
    tilted = tree.chain("left_base", "cup")
    np.testing.assert_allclose(tilted.gravity, euler.rot_x(0.5) @ GRAVITY, rtol=0, atol=1e-15)
    assert "gravity: assumption: z of 'body' points up\n" in tilted.source
    hand = tree.chain("right_1", "tip_a")
    assert "gravity: assumption: z of 'body' points up and right_turn at 0" in hand.source


def test_what_is_left_out_is_said(tree: Tree) -> None:
    robot = tree.chain("body", "tip_b")
    assert robot.inertias is None
    assert "omitted branches behind: finger_a" in robot.source.splitlines()
    assert "mimic joints: finger_b" in robot.source.splitlines()
    across = tree.chain("cup", "tip_a")
    assert "unknown mass behind: left_turn, right_turn, finger_a" in across.source
    assert across.joint_names == ("left_slide", "left_turn", "right_turn", "finger_a")


def test_a_speed_or_effort_of_zero_is_none_known(tree: Tree) -> None:
    robot = tree.chain("body", "right_1")
    np.testing.assert_array_equal(robot.tau_max, [np.inf])
    np.testing.assert_array_equal([robot.q_min, robot.q_max, robot.qd_max], [[-np.inf], [np.inf], [2]])
    assert np.isinf(urdf.parse(TWO_ARMS.replace('velocity="2"', 'velocity="0"')).chain("body", "right_1").qd_max)


@pytest.mark.parametrize("word", ["1e9", "1000000000000", "inf", "+INF", "Infinity"])
def test_limits_that_are_none(word: str) -> None:
    robot = urdf.parse(TWO_ARMS.replace('upper="2.5" effort="40" velocity="3"', f'upper="{word}"')).chain(tip="cup")
    assert [robot.q_max[0], robot.qd_max[0], robot.tau_max[0]] == [np.inf] * 3
    assert robot.q_min[0] == -2.5


def test_joints_that_follow() -> None:
    text = TWO_ARMS.replace("</robot>", """
  <joint name="thumb" type="revolute"><parent link="tip_b"/><child link="nail"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="finger_a" multiplier="-20"/></joint>
  <link name="nail"/></robot>""")  # fmt: skip
    tree = urdf.parse(text)
    robot = tree.chain("right_1", "nail")
    assert robot.joint_names == ("finger_b", "thumb")
    mimic = tree.mimic(robot.joint_names)
    assert isinstance(mimic, Mimic)
    assert mimic.names == ("finger_a",)
    np.testing.assert_array_equal(mimic.matrix, [[1.5], [-20]])
    np.testing.assert_array_equal(mimic.offset, [0.002, 0])
    np.testing.assert_allclose(mimic.positions([[0.01], [0.02]]), [[0.017, -0.2], [0.032, -0.4]], rtol=0, atol=1e-16)
    with pytest.raises(ShapeError, match=r"positions of the free joints finger_a, shape \(\.\.\., 1\), got \(2,\)"):
        mimic.positions([0.0, 1.0])


def test_followers_of_followers() -> None:
    text = TWO_ARMS.replace('<limit effort="0" velocity="2"/>', '<mimic joint="finger_b" multiplier="2" offset="1"/>')
    tree = urdf.parse(text)
    assert tree.parent_joints["right_1"].follows == Follow("finger_b", 2.0, 1.0)
    mimic = tree.mimic(["right_turn", "left_turn", "finger_b", "finger_a"])
    assert mimic.names == ("finger_a", "left_turn")
    x, y = 0.01, 0.5
    b = 1.5 * x + 0.002
    np.testing.assert_allclose(mimic.positions([x, y]), [2 * b + 1, y, b, x], rtol=0, atol=1e-16)
    with pytest.raises(UnknownName, match=r"Expected the name of a joint of the URDF text, got 'finger_c'.*'finger_"):
        tree.mimic(["finger_c"])


def test_read_and_load(tmp_path: Path) -> None:
    path = written(tmp_path, ONE_ARM)
    assert urdf.read(path).tips == ("cup",)
    robot = robots.load(path)
    assert robot == robots.load(str(path), base="body", tip="cup") == urdf.read(path).chain()
    assert "geometry: arm.urdf, from 'body' to 'cup'" in robot.source
    assert str(tmp_path) not in robot.source
    robots.save(robot, tmp_path / "arm.toml")
    assert robots.load(tmp_path / "arm.toml") == robot


def test_limits_in_degrees_are_doubted_and_a_wrist_of_more_than_a_turn_is_not() -> None:
    arm = """<robot name="arm"><link name="a"/><link name="b"/><joint name="turn" type="{}"><parent link="a"/>
      <child link="b"/><axis xyz="0 0 1"/><limit lower="-{}" upper="{}" velocity="3"/></joint></robot>"""
    with pytest.warns(
        UserWarning, match=r"limits of robot 'arm' within four revolutions, got turn \(-170 to 170 rad\)"
    ):
        urdf.parse(arm.format("revolute", 170, 170)).chain()
    for kind, limit in (("revolute", 7.0), ("prismatic", 170), ("continuous", 170), ("revolute", 1e16)):
        urdf.parse(arm.format(kind, limit, limit)).chain()


def test_there_and_back(tmp_path: Path, tree: Tree) -> None:
    """A written URDF read back: frames, limits, bodies and meshes; mount and tool are now part of the links."""
    robot = (
        tree.chain("body", "cup").with_tool(se3.exp([0.1, 0.2, 0.3, 1, 2, 1])).with_base(se3.exp([1, 1, 0, 0, 1, 0]))
    )
    robots.save(robot, tmp_path / "again.urdf")
    again = robots.load(tmp_path / "again.urdf")
    np.testing.assert_allclose(again.frames, robot.frames, rtol=0, atol=1e-15)
    np.testing.assert_allclose(again.inertias, robot.inertias, rtol=0, atol=1e-15)
    for field in ("q_min", "q_max", "qd_max", "tau_max", "prismatic"):
        np.testing.assert_array_equal(getattr(again, field), getattr(robot, field))
    assert (again.name, again.joint_names) == (robot.name, robot.joint_names)
    for mesh, other in zip(sum(again.meshes[1:], ()), sum(robot.meshes[1:], ()), strict=True):
        assert (mesh.kind, mesh.file) == (other.kind, other.file)
        np.testing.assert_allclose(mesh.T_link_mesh, other.T_link_mesh, rtol=0, atol=1e-15)
    T_mount_mesh = robot.meshes[0][0].T_link_mesh
    T_base_mesh = robot.T_base_mount @ T_mount_mesh
    np.testing.assert_allclose(again.meshes[0][0].T_link_mesh, T_base_mesh, rtol=0, atol=1e-15)


def test_refusals_of_arms_and_files(tmp_path: Path, tree: Tree) -> None:
    path, table = written(tmp_path, TWO_ARMS), tmp_path / "a.toml"
    robots.save(robots.load("dh_test"), table)
    none = "Expected a moving joint between '{}' and '{}' of the URDF text, got none"
    only = "Expected base, tip and lock only with a URDF, got base, tip or lock with"
    cases = [
        (RobotError, r"one moving branch below link 'body' of .*arm\.urdf, got several: cup, tip_a, tip_b\. Select",
         lambda: robots.load(path)),
        (RobotError, r"below link 'right_1' .* got several: tip_a, tip_b", lambda: robots.load(path, base="right_1")),
        (RobotError, r"one moving branch below link 'cup' .* got none", lambda: robots.load(path, base="cup")),
        (UnknownName, r"name of a link of the URDF text, got 'cups'\. Known: body, cup.*Did you mean 'cup'",
         lambda: tree.chain(tip="cups")),
        (UnknownName, "got 'bodi'", lambda: tree.chain("bodi", "cup")),
        (RobotError, none.format("cup", "left_2"), lambda: tree.chain("cup", "left_2")),
        (RobotError, none.format("cup", "cup"), lambda: tree.chain("cup", "cup")),
        (RobotError, only, lambda: robots.load("yumi_left", tip="tool")),
        (RobotError, only, lambda: robots.load(table, tip="tool")),
        (RobotError, r"Expected a URDF file at .*absent\.urdf, got: .*No such file",
         lambda: robots.load(tmp_path / "absent.urdf")),
        (RobotError, r"Expected a URDF, got arm\.urdf\.xacro\. Expand it first: xacro arm",
         lambda: robots.load("arm.urdf.xacro")),
        # the structure is checked wherever a tree comes from
        (RobotError, "the child of joint 'left_mount' to be one of the links",
         lambda: replace(tree, links=[link for link in tree.links if link.name != "left_base"])),
        (RobotError, r"Expected text that XML can represent in robot 'a\\x00b', got 'a\\x00b'",
         lambda: robots.save(replace(robots.load("dh_test"), name="a\0b"), tmp_path / "b.urdf")),
    ]  # fmt: skip
    for error, words, call in cases:
        with pytest.raises(error, match=words):
            call()
    assert not (tmp_path / "b.urdf").exists()
    assert robots.load(path, base="left_base").joint_names == ("left_turn", "left_slide")


def test_an_inertia_of_no_body_is_said(tree: Tree) -> None:
    odd = urdf.parse(TWO_ARMS.replace('izz="0.01"/></inertial>\n    <visual>', 'izz="0.05"/></inertial>\n    <visual>'))
    with pytest.warns(
        UserWarning, match=r"to satisfy the triangle inequality.*'left_1' \(line 16\)\. These inertias are used"
    ):
        robot = odd.chain("body", "cup")
    assert robot.inertias is not None
    odd.chain("body", "right_1")  # parts outside the arm do not matter
    placeholder = urdf.parse(TWO_ARMS.replace('<mass value="0.5"/>', '<mass value="0"/>'))
    with pytest.warns(
        UserWarning, match=r"a nonzero mass for every link with an inertia.*mass 0 in 'cup' \(line \d+\)"
    ):
        bare = placeholder.chain("body", "cup")
    assert bare.inertias is not None
    assert bare.inertias[-1, 0] == robot.inertias[-1, 0] - 0.5


def test_a_rotation_may_be_a_quaternion() -> None:
    """URDF 1.2 allows quat_xyzw instead of rpy."""
    text = """<robot name="r"><link name="a"/><link name="b"/>
      <joint name="j" type="continuous"><parent link="a"/><child link="b"/><origin {}/></joint></robot>"""
    quarter = urdf.parse(text.format('quat_xyzw="0 0 0.7071067811865476 0.7071067811865476"')).joints[0]
    np.testing.assert_allclose(quarter.T_parent_child[:3, :2], [[0, -1], [1, 0], [0, 0]], rtol=0, atol=1e-15)
    with pytest.raises(RobotError, match=r"Expected quat_xyzw of length 1 .*line 2, got 1 1 1 1\. Correct it"):
        urdf.parse(text.format('quat_xyzw="1 1 1 1"'))
    with pytest.raises(RobotError, match=r"Expected either rpy or quat_xyzw of <origin> .*line 2, got both"):
        urdf.parse(text.format('rpy="0 0 0" quat_xyzw="0 0 0 1"'))


def urdf_of(robot: Robot, tmp_path: Path) -> str:
    path = tmp_path / "robot.urdf"
    robots.save(robot, path)
    return path.read_text(encoding="utf-8")


def random_robot(seed: int, n: int) -> Robot:
    """Random frames, joints, bodies and limits."""
    draw = np.random.default_rng(seed).uniform([[-3], [1], [1], [1]], [[-1], [3], [3], [3]], (4, n))
    return replace(random_chain(seed, n), **dict(zip(("q_min", "q_max", "qd_max", "tau_max"), draw)))


def assert_pinocchio_agrees(robot: Robot, text: str, seed: int) -> None:
    model = pin.buildModelFromXML(text)
    model.gravity.linear = robot.gravity
    data = model.createData()
    np.testing.assert_array_equal(model.lowerPositionLimit, robot.q_min)
    np.testing.assert_array_equal(model.upperPositionLimit, robot.q_max)
    np.testing.assert_array_equal(model.velocityLimit, np.where(np.isinf(robot.qd_max), 1e9, robot.qd_max))
    np.testing.assert_array_equal(model.effortLimit, np.where(np.isinf(robot.tau_max), 1e9, robot.tau_max))
    assert tuple(model.names)[1:] == robot.ros_joint_names
    rng = np.random.default_rng(seed)
    for _ in range(3):
        q, qd, qdd = rng.uniform(-1, 1, (3, robot.n))
        pin.framesForwardKinematics(model, data, q)
        T_base_tool = data.oMf[model.getFrameId("tool")].homogeneous
        np.testing.assert_allclose(robot.chain.forward(q), T_base_tool, rtol=0, atol=1e-12)
        T_base_link = [data.oMf[model.getFrameId(f"link_{i + 1}")].homogeneous for i in range(robot.n)]
        np.testing.assert_allclose(robot.chain.link_transforms(q), T_base_link, rtol=0, atol=1e-12)
        if robot.inertias is not None:
            tau = robot.chain.rnea(q, qd, qdd, robot.gravity, robot.inertias)
            np.testing.assert_allclose(tau, pin.rnea(model, data, q, qd, qdd), rtol=0, atol=1e-10 * np.abs(tau).max())


@pytest.mark.parametrize("seed", range(8))
def test_any_robot_is_the_same_in_pinocchio(seed: int, tmp_path: Path) -> None:
    robot = random_robot(seed, 1 + seed % 8)
    assert_pinocchio_agrees(robot, urdf_of(robot, tmp_path), seed)


def test_right_angles_do_not_lose_digits(tmp_path: Path) -> None:
    """Roll, pitch and yaw are singular at a pitch of 90 degrees, which is common in robots."""
    rng = np.random.default_rng(0)
    quarter = [se3.exp([0, 0, 0.1, *(np.pi / 2 * axis)]) for axis in np.vstack([np.eye(3), -np.eye(3)])]
    for nudge in (0.0, 1e-15, 1e-12, 1e-9, 1e-6):
        links = [quarter[i] @ se3.exp(nudge * rng.standard_normal(6)) for i in rng.integers(6, size=9)]
        robot = robots.from_links("square", links, q_min=np.full(8, -3), q_max=np.full(8, 3))
        assert_pinocchio_agrees(robot, urdf_of(robot, tmp_path), seed=1)


def test_limits_that_are_none_written(tmp_path: Path) -> None:
    """Unlimited rotation is `continuous`; every other missing limit becomes 1e9, and a comment says so."""
    limits: Details = {"q_min": [-np.inf, -np.inf, -np.inf], "q_max": [np.inf, np.inf, 1.0], "tau_max": [5, 6, 7]}
    text = urdf_of(robots.from_dh("r", 0.0, [1, 1, 1], 0.0, prismatic=[0, 1, 0], **limits), tmp_path)
    assert '<joint name="joint_1" type="continuous">' in text
    assert '<limit effort="5" velocity="1e9"/>' in text
    assert '<limit lower="-1e9" upper="1e9" effort="6" velocity="1e9"/>' in text
    assert '<limit lower="-1e9" upper="1" effort="7" velocity="1e9"/>' in text
    assert "limits of 1e9: none" in text
    assert pin.buildModelFromXML(text).nq == 4


def test_what_urdf_cannot_hold_is_in_the_comment(tmp_path: Path) -> None:
    text = urdf_of(robots.load("yumi_left"), tmp_path)
    comment = text[text.index("<!--") : text.index("-->")]
    for words in ("0 0 -9.80665", "gears G, q = G q_motor: 0.01 0", "home: 0 -2.2", "ABB's axes: 1 2 7", "side: left"):
        assert words in comment
    assert "gears" not in urdf_of(robots.from_dh("r", 0.0, 1.0, 0.0), tmp_path)


def test_meshes_and_awkward_names(tmp_path: Path) -> None:
    mesh = Mesh("collision", 'package://a"&<b>.stl', se3.exp([1, 2, 3, 0.1, 0.2, 0.3]), np.full(3, 0.001))
    robot = robots.from_dh(
        "a <b> & \"c\"", 0.0, 1.0, 0.0, joint_names=["base_to_mount"], source="-- a ---> b --", meshes=[[mesh], [mesh]]
    )  # fmt: skip
    text = urdf_of(robot, tmp_path)
    model = pin.buildModelFromXML(text)
    assert (model.name, model.names[1]) == (robot.name, "base_to_mount")
    assert text.count('filename=\'package://a"&amp;&lt;b&gt;.stl\' scale="0.001 0.001 0.001"') == 2
    assert text.count("<collision>") == 2
    again = robots.load(tmp_path / "robot.urdf")  # a stricter reader: "--" ends a comment too early
    assert (again.name, again.joint_names, again.meshes[1][0].file) == (robot.name, robot.joint_names, mesh.file)
