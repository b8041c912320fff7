"""URDF files that armlab writes, read by Pinocchio and MuJoCo: the same arm to the last digits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from armlab import robots
from armlab.errors import RobotError
from armlab.lie import se3
from armlab.robots import Mesh, Robot, inertia


def written(robot: Robot, tmp_path: Path) -> str:
    path = tmp_path / "robot.urdf"
    robots.save(robot, path)
    return path.read_text(encoding="utf-8")


def random_robot(seed: int, n: int) -> Robot:
    """Any frames, any joints, any bodies."""
    rng = np.random.default_rng(seed)
    squares = rng.standard_normal((n, 3, 3))
    squares = squares @ squares.swapaxes(1, 2)  # second moments: the inertia tr(S) 1 - S is that of a real body
    moments = squares.trace(axis1=1, axis2=2)[:, None, None] * np.eye(3) - squares
    bodies = rng.uniform(0.1, 9, n), rng.standard_normal((n, 3)), moments
    return robots.from_links(
        f"random {seed}",
        se3.exp(rng.standard_normal((n + 1, 6))),
        rng.random(n) < 0.4,
        q_min=rng.uniform(-3, -1, n),
        q_max=rng.uniform(1, 3, n),
        qd_max=rng.uniform(1, 3, n),
        tau_max=rng.uniform(1, 3, n),
        inertias=inertia.from_body(*bodies),
        T_base_mount=se3.exp(rng.standard_normal(6)),
        T_flange_tool=se3.exp(rng.standard_normal(6)),
        gravity=rng.standard_normal(3),
    )


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


@pytest.mark.parametrize("name", robots.names())
def test_the_library_is_the_same_in_pinocchio(name: str, tmp_path: Path) -> None:
    robot = robots.load(name)
    if np.isinf(robot.q_max).any():  # Pinocchio counts a joint without limits as two coordinates
        robot = replace(robot, q_min=np.full(robot.n, -3.0), q_max=np.full(robot.n, 3.0))
    assert_pinocchio_agrees(robot, written(robot, tmp_path), seed=0)


@pytest.mark.parametrize("seed", range(20))
def test_any_robot_is_the_same_in_pinocchio(seed: int, tmp_path: Path) -> None:
    robot = random_robot(seed, 1 + seed % 8)
    assert_pinocchio_agrees(robot, written(robot, tmp_path), seed)


def test_right_angles_do_not_lose_digits(tmp_path: Path) -> None:
    """Roll, pitch and yaw are singular at a pitch of 90 degrees, which robots are full of."""
    rng = np.random.default_rng(0)
    quarter = [se3.exp([0, 0, 0.1, *(np.pi / 2 * axis)]) for axis in np.vstack([np.eye(3), -np.eye(3)])]
    for nudge in (0.0, 1e-15, 1e-12, 1e-9, 1e-6):
        links = [quarter[i] @ se3.exp(nudge * rng.standard_normal(6)) for i in rng.integers(6, size=9)]
        robot = robots.from_links("square", links, q_min=np.full(8, -3), q_max=np.full(8, 3))
        assert_pinocchio_agrees(robot, written(robot, tmp_path), seed=1)


def test_mujoco_reads_it(tmp_path: Path) -> None:
    robot = random_robot(3, 6)
    model = mujoco.MjModel.from_xml_string(written(robot, tmp_path))
    data = mujoco.MjData(model)
    data.qpos[:] = q = np.random.default_rng(3).uniform(-1, 1, 6)
    model.opt.gravity[:] = robot.gravity
    mujoco.mj_forward(model, data)
    zero = np.zeros(6)
    np.testing.assert_allclose(
        data.qfrc_bias, robot.chain.rnea(q, zero, zero, robot.gravity, robot.inertias), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(model.jnt_range, np.stack([robot.q_min, robot.q_max], axis=1))


def test_limits_that_are_none(tmp_path: Path) -> None:
    """Turning without end is `continuous`; every other missing limit becomes 1e9, and a comment says so."""
    limits: robots.Details = {
        "q_min": [-np.inf, -np.inf, -np.inf],
        "q_max": [np.inf, np.inf, 1.0],
        "tau_max": [5, 6, 7],
    }
    text = written(robots.from_dh("r", 0.0, [1, 1, 1], 0.0, prismatic=[0, 1, 0], **limits), tmp_path)
    assert '<joint name="joint_1" type="continuous">' in text
    assert '<limit effort="5" velocity="1e9"/>' in text
    assert '<limit lower="-1e9" upper="1e9" effort="6" velocity="1e9"/>' in text
    assert '<limit lower="-1e9" upper="1" effort="7" velocity="1e9"/>' in text
    assert "limits of 1e9: none" in text
    assert pin.buildModelFromXML(text).nq == 4


def test_what_urdf_cannot_hold_is_in_the_comment(tmp_path: Path) -> None:
    text = written(robots.load("yumi_left"), tmp_path)
    comment = text[text.index("<!--") : text.index("-->")]
    for words in (
        "gravity in the axes of base [m/s^2]: 0 0 -9.80665",
        "gears G, q = G q_motor: 0.01 0",
        "home: 0 -2.2",
    ):
        assert words in comment
    assert "ABB's axes: 1 2 7 3 4 5 6" in comment
    assert "side: left" in comment
    assert "geometry: Robotlib.jl" in comment
    plain = written(robots.from_dh("r", 0.0, 1.0, 0.0), tmp_path)
    assert "gears" not in plain
    assert "ABB" not in plain


def test_meshes_and_awkward_names(tmp_path: Path) -> None:
    mesh = Mesh("collision", 'package://a"&<b>.stl', se3.exp([1, 2, 3, 0.1, 0.2, 0.3]), np.full(3, 0.001))
    robot = robots.from_dh(
        "a <b> & \"c\"", 0.0, 1.0, 0.0, joint_names=["base_to_mount"], source="-- a ---> b --", meshes=[[mesh], [mesh]]
    )  # fmt: skip
    text = written(robot, tmp_path)
    model = pin.buildModelFromXML(text)
    assert (model.name, model.names[1]) == (robot.name, "base_to_mount")
    assert text.count('filename=\'package://a"&amp;&lt;b&gt;.stl\' scale="0.001 0.001 0.001"') == 2
    assert text.count("<collision>") == 2
    again = robots.load(tmp_path / "robot.urdf")  # a stricter reader: "--" ends a comment too early
    assert (again.name, again.joint_names, again.meshes[1][0].file) == (robot.name, robot.joint_names, mesh.file)


def test_names_that_xml_cannot_hold_are_refused(tmp_path: Path) -> None:
    robot = robots.load("dh_test")
    with pytest.raises(RobotError, match=r"Expected text that XML can hold in robot 'a\\x00b', got 'a\\x00b'"):
        robots.save(replace(robot, name="a\0b"), tmp_path / "a.urdf")
    assert not (tmp_path / "a.urdf").exists()
