"""The library against Pinocchio, which reads the joint origins of another source than the file was written from.

The tables are typed from public URDFs: ROS-Industrial (ABB, Universal Robots), OrebroUniversity/yumi, Franka's and
the LBR stack's own. A right angle that a source prints with eleven digits is a right angle here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio
import pytest

from armlab import kinematics, robots
from armlab.lie import se3, so3
from armlab.robots import Robot

H = np.pi / 2
X, Y, Z, DOWN_Y = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0)
LEVEL = (0, 0, 0)

Row = tuple[tuple[float, ...], tuple[float, ...], tuple[int, ...]]  # xyz, rpy, axis


def abb(*origins: tuple[float, float, float]) -> list[Row]:
    """Axes of ROS-Industrial's ABB arms; the flange comes last and looks along x."""
    axes = (Z, Y, Y, X, Y, X, None)
    return [(xyz, (0, H, 0) if axis is None else LEVEL, axis or Z) for xyz, axis in zip(origins, axes, strict=True)]


def yumi(side: int, rpy: tuple[float, float, float]) -> list[Row]:
    return [
        ((0.05355, 0.0725 * side, 0.41492), rpy, Z),
        ((0.03, 0, 0.1), (H, 0, 0), Z),
        ((-0.03, 0.17283, 0), (-H, 0, 0), Z),
        ((-0.04188, 0, 0.07873), (H, -H, 0), Z),
        ((0.0405, 0.16461, 0), (-H, 0, 0), Z),
        ((-0.027, 0, 0.10039), (H, 0, 0), Z),
        ((0.027, 0.029, 0), (-H, 0, 0), Z),
        (LEVEL, LEVEL, Z),
    ]


FRANKA: list[Row] = [
    ((0, 0, 0.333), LEVEL, Z),
    (LEVEL, (-H, 0, 0), Z),
    ((0, -0.316, 0), (H, 0, 0), Z),
    ((0.0825, 0, 0), (H, 0, 0), Z),
    ((-0.0825, 0.384, 0), (-H, 0, 0), Z),
    (LEVEL, (H, 0, 0), Z),
    ((0.088, 0, 0), (H, 0, 0), Z),
    ((0, 0, 0.107), LEVEL, Z),
]
TABLES: dict[str, list[Row]] = {  # one row per joint and one for the flange
    "irb120": abb(LEVEL, (0, 0, 0.29), (0, 0, 0.27), (0, 0, 0.07), (0.302, 0, 0), (0.072, 0, 0), LEVEL),
    "irb1200": abb((0, 0, 0.3991), LEVEL, (0, 0, 0.448), (0, 0, 0.042), (0.451, 0, 0), (0.082, 0, 0), LEVEL),
    "irb1200_7_70": abb((0, 0, 0.3991), LEVEL, (0, 0, 0.350), (0, 0, 0.042), (0.351, 0, 0), (0.082, 0, 0), LEVEL),
    "irb2400": abb(LEVEL, (0.1, 0, 0.615), (0, 0, 0.705), (0, 0, 0.135), (0.755, 0, 0), LEVEL, (0.085, 0, 0)),
    "irb7600": abb(LEVEL, (0.41, 0, 0.78), (0, 0, 1.075), (0, 0, 0.165), (1.056, 0, 0), (0.25, 0, 0), LEVEL),
    "irb7600_150_350": abb(LEVEL, (0.41, 0, 0.78), (0, 0, 1.075), (0, 0, 0.165), (2.012, 0, 0), (0.25, 0, 0), LEVEL),
    "yumi_left_urdf": yumi(1, (0.9781, -0.5716, 2.3180)),
    "yumi_right_urdf": yumi(-1, (-0.9795, -0.5682, -2.3155)),
    "ur5e": [  # as printed: nine digits of a right angle
        ((0, 0, 0.1625), LEVEL, Z),
        (LEVEL, (1.570796327, 0, 0), Z),
        ((-0.425, 0, 0), LEVEL, Z),
        ((-0.3922, 0, 0.1333), LEVEL, Z),
        ((0, -0.0997, -2.044881182297852e-11), (1.570796327, 0, 0), Z),
        ((0, 0.09959999999999999, -2.042830148012698e-11), (1.570796326589793, np.pi, np.pi), Z),
        (LEVEL, LEVEL, Z),
    ],
    "panda": FRANKA,
    "fr3": FRANKA,
    "iiwa14": [
        ((0, 0, 0.1475), LEVEL, Z),
        ((0, -0.01, 0.2125), LEVEL, Y),
        ((0, 0.01, 0.228), LEVEL, Z),
        ((0, 0.0105, 0.192), LEVEL, DOWN_Y),
        ((0, -0.0105, 0.2075), LEVEL, Z),
        ((0, -0.0707, 0.1925), LEVEL, Y),
        ((0, 0.0707, 0.091), LEVEL, Z),
        ((0, 0, 0.035), LEVEL, Z),
    ],
}
AGREE = {"ur5e": 1e-9}  # where two sources do not agree to 1e-12, to what they do


def urdf(rows: list[Row]) -> str:
    """A chain of revolute joints and a fixed flange."""
    text = ['<robot name="r"><link name="l0"/>']
    for i, (xyz, rpy, axis) in enumerate(rows, 1):
        kind = "fixed" if i == len(rows) else "revolute"
        numbers = [" ".join(repr(float(number)) for number in numbers) for numbers in (xyz, rpy, axis)]
        text.append(
            f'<link name="l{i}"/><joint name="j{i}" type="{kind}"><parent link="l{i - 1}"/><child link="l{i}"/>'
            f'<origin xyz="{numbers[0]}" rpy="{numbers[1]}"/><axis xyz="{numbers[2]}"/>'
            '<limit lower="-9" upper="9" effort="1" velocity="1"/></joint>'
        )
    return "".join([*text, "</robot>"])


def flanges(rows: list[Row], q: np.ndarray) -> np.ndarray:
    """Pinocchio's flange poses (N, 4, 4)."""
    model = pinocchio.buildModelFromXML(urdf(rows))
    data, frame = model.createData(), model.getFrameId(f"l{len(rows)}")
    poses = np.empty((len(q), 4, 4))
    for pose, position in zip(poses, q):
        pinocchio.framesForwardKinematics(model, data, position)
        pose[:] = data.oMf[frame].homogeneous
    return poses


def inside(robot: Robot, count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(robot.q_min, robot.q_max, (count, robot.n))


@pytest.mark.parametrize("name", TABLES)
def test_forward_is_that_of_another_source(name: str) -> None:
    """1000 configurations inside the limits."""
    robot = robots.load(name)
    q = inside(robot, 1000)
    tolerance = AGREE.get(name, 1e-12)
    np.testing.assert_allclose(kinematics.forward(robot, q), flanges(TABLES[name], q), atol=tolerance, rtol=0)


def test_every_robot_has_another_source() -> None:
    """The ancestor's YuMi has its own tables in test_library.py; DH_test is no robot."""
    assert set(robots.names()) - set(TABLES) == {"dh_test", "yumi_left", "yumi_right"}


def test_franka_in_the_convention_of_its_vendor() -> None:
    """The modified table of the interface documentation, flange in the last row."""
    alpha, a = [0, -H, H, H, -H, H, H], [0, 0, 0, 0.0825, -0.0825, 0, 0.088]
    vendor = robots.from_dh("vendor", alpha, a, [0.333, 0, 0.316, 0, 0.384, 0, 0.107], modified=True)
    for name in ("panda", "fr3"):
        q = inside(robots.load(name), 100)
        np.testing.assert_allclose(kinematics.forward(robots.load(name), q), kinematics.forward(vendor, q), atol=1e-14)


LIMITS = {  # degrees; rounded as a URDF in rad prints them
    "irb120": ((-165, -110, -110, -160, -120, -400), (165, 110, 70, 160, 120, 400), (250, 250, 250, 320, 320, 420)),
    "irb1200": ((-170, -100, -200, -270, -130, -360), (170, 130, 70, 270, 130, 360), (288, 240, 300, 400, 405, 600)),
    "irb1200_7_70": (
        (-170, -100, -200, -270, -130, -360),
        (170, 135, 70, 270, 130, 360),
        (288, 240, 300, 400, 405, 600),
    ),
    "irb7600_150_350": (
        (-180, -60, -180, -300, -100, -360),
        (180, 85, 60, 300, 100, 360),
        (100, 60, 60, 100, 100, 190),
    ),
    "ur5e": ((-360,) * 6, (360,) * 6, (180,) * 6),
    "panda": (
        (-166.0, -101.0, -166.0, -176.0, -166.0, -1.0, -166.0),
        (166.0, 101.0, 166.0, -4.0, 166.0, 215.0, 166.0),
        (124.6, 124.6, 124.6, 124.6, 149.5, 149.5, 149.5),
    ),
    "fr3": (
        (-157.2, -102.2, -166.2, -174.3, -160.8, 31.2, -172.8),
        (157.2, 102.2, 166.2, -8.7, 160.8, 258.8, 172.8),
        (150.1, 150.1, 150.1, 150.1, 301.4, 239.5, 301.4),
    ),
    "iiwa14": (
        (-170, -120, -170, -120, -170, -120, -175),
        (170, 120, 170, 120, 170, 120, 175),
        (85, 85, 100, 75, 130, 135, 135),
    ),
}


@pytest.mark.parametrize("name", LIMITS)
def test_limits_and_speeds(name: str) -> None:
    robot = robots.load(name)
    for field, degrees in zip((robot.q_min, robot.q_max, robot.qd_max), LIMITS[name], strict=True):
        np.testing.assert_allclose(np.rad2deg(field), degrees, atol=0.06)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_two_yumis(side: str) -> None:
    """Same angles, same posture: flanges turned by half a turn about their own axis, centimetres apart."""
    ancestor, urdf_set = robots.load(f"yumi_{side}"), robots.load(f"yumi_{side}_urdf")
    for field in ("q_min", "q_max", "qd_max", "q_home", "coupling"):
        np.testing.assert_array_equal(getattr(ancestor, field), getattr(urdf_set, field))
    assert (ancestor.abb_axes, ancestor.joint_names) == (urdf_set.abb_axes, urdf_set.joint_names)

    q = np.concatenate([np.zeros((1, 7)), inside(ancestor, 2000)])
    T_a, T_b = kinematics.forward(ancestor, q), kinematics.forward(urdf_set, q)
    apart = np.linalg.norm(T_a[:, :3, 3] - T_b[:, :3, 3], axis=1)
    assert apart[0] == pytest.approx(0.0113, abs=1e-4)
    assert 0.004 < apart.min() < apart.max() < 0.0235
    half_turn = np.diag([-1.0, -1.0, 1.0])
    turned = so3.angle(T_a[:, :3, :3], T_b[:, :3, :3] @ half_turn)
    np.testing.assert_allclose(np.rad2deg(turned), {"left": 0.163, "right": 0.067}[side], atol=1e-3)


@pytest.mark.parametrize("side", ["left", "right"])
def test_axis_1_of_the_two_yumis_is_one_line(side: str) -> None:
    """Their mounts lie on it, 7 to 10 mm apart."""
    T_a, T_b = (robots.load(name).T_base_mount for name in (f"yumi_{side}", f"yumi_{side}_urdf"))
    T = se3.inv(T_a) @ T_b
    assert abs(T[2, 3]) == pytest.approx(0.0073, abs=5e-4)
    assert np.linalg.norm(T[:2, 3]) < 3e-4
    assert np.rad2deg(np.arccos(T[2, 2])) < 0.2


def test_without_the_second_length_of_the_wrist_the_yumis_nearly_agree() -> None:
    """Most of the distance is the 13.5 mm between axes 4 and 5: 0.027 m in the URDF, half of it in Robotlib.jl."""
    urdf_set = robots.load("yumi_left_urdf")
    links = urdf_set.links.copy()
    links[5, 0, 3] = -0.0135
    q = inside(urdf_set, 2000)
    T_a = kinematics.forward(robots.load("yumi_left"), q)
    T_b = kinematics.forward(replace(urdf_set, links=links), q)
    assert np.linalg.norm(T_a[:, :3, 3] - T_b[:, :3, 3], axis=1).max() < 0.011


REACH = {"irb120": 0.58, "irb1200": 0.90, "irb1200_7_70": 0.70, "irb7600": 2.55, "irb7600_150_350": 3.50}


@pytest.mark.parametrize("name", REACH)
def test_reach_is_that_of_the_type_name(name: str) -> None:
    """ABB names an arm after the largest distance of its wrist from axis 1."""
    robot = robots.load(name)
    q = np.zeros((200, 200, 6))
    q[..., 1], q[..., 2] = np.meshgrid(*np.linspace(robot.q_min[1:3], robot.q_max[1:3], 200).T, indexing="ij")
    wrist = kinematics.link_transforms(robot, q)[..., 4, :3, 3]
    assert np.hypot(wrist[..., 0], wrist[..., 1]).max() == pytest.approx(REACH[name], abs=0.005)


@pytest.mark.parametrize("name", ["iiwa14", "ur5e"])
def test_home_points_the_tool_down(name: str) -> None:
    robot = robots.load(name)
    np.testing.assert_allclose(kinematics.forward(robot, robot.q_home)[:3, 2], [0, 0, -1], atol=1e-15)
