"""Robots of the library: numbers, sources, reach and bodies."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest

from armlab import kinematics, robots
from armlab.lie import quaternion, se3, so3
from armlab.robots import Robot, inertia

HASHES = {  # of geometry, limits, gears, efforts and bodies, each compared with its source when it was typed in
    "dh_test": "788c5573fd9f2951",
    "fr3": "8db74429c8343a75",
    "iiwa14": "3289daa054e06279",
    "irb120": "89d7c32e832dc510",
    "irb1200": "42f8e879bf1f5f14",
    "irb1200_7_70": "9d090681865bb912",
    "irb2400": "013c6a80e18c0263",
    "irb7600": "1a10273a4c90bdfe",
    "irb7600_150_350": "339f170ace98068e",
    "panda": "9d4cb8d878756521",
    "ur5e": "ff615878a330fa5d",
    "yumi_left": "dabb698bc5f5565c",
    "yumi_left_urdf": "0214976bc8652e33",
    "yumi_right": "eaa77b0ee4c88ac1",
    "yumi_right_urdf": "e6bdb6c6587f7f11",
}


# Flange at q = 0.1, 0.2, ... without base and tool: position, quaternion, Jacobian times ones; from the ancestor
REFERENCE = {
    "irb2400": ((1.008172909263, 0.117103629855, 0.993752325411),
                (0.211028318172, 0.368777489968, 0.876431648514, 0.226578413148),
                (-0.118314250945, 1.074968536053, -1.716423864621, 1.304361026368, 3.254234528159, 0.054062664636)),
    "irb7600": ((1.755516164724, 0.223047761078, 1.270034689313),
                (0.211028318172, 0.368777489968, 0.876431648514, 0.226578413148),
                (-0.494523405289, 1.925092727513, -2.583373807096, 1.304361026368, 3.254234528159, 0.054062664636)),
    "yumi_right": ((0.331411094284, 0.137184725458, 0.194369240091),
                   (0.045721044770, 0.321374739775, 0.907606846868, 0.266228612697),
                   (-0.349855990704, 0.628741526053, -0.652366329789, 0.641429313372, 3.629494786012, 1.077111066362)),
}  # fmt: skip


@pytest.mark.parametrize("name", REFERENCE)
def test_reference_numbers(name: str) -> None:
    robot, (p, wxyz, J_ones) = robots.load(name).with_base(np.eye(4)), REFERENCE[name]
    q = 0.1 * np.arange(1, robot.n + 1)
    T = kinematics.forward(robot, q)
    np.testing.assert_allclose(T[:3, 3], p, rtol=0, atol=1e-12)
    assert so3.angle(T[:3, :3], quaternion.to_matrix(wxyz)) < 5e-12
    np.testing.assert_allclose(kinematics.jacobian(robot, q) @ np.ones(robot.n), J_ones, rtol=0, atol=2e-12)


def test_yumi_at_home() -> None:
    """The golden flange of the force specification; the right arm mirrors the left."""
    left, right = (robots.load(name) for name in ("yumi_left", "yumi_right"))
    T_base_flange = kinematics.forward(left, left.q_home)
    np.testing.assert_allclose(T_base_flange[:3, 3], (-0.018163, 0.186292, 0.195626), rtol=0, atol=5e-7)
    wxyz = quaternion.from_matrix(T_base_flange[:3, :3])
    np.testing.assert_allclose(wxyz, (0.066013, 0.842423, -0.111212, 0.523065), rtol=0, atol=5e-7)
    mirrored = kinematics.forward(right, right.q_home)[:3, 3] * (1, -1, 1)
    np.testing.assert_allclose(mirrored, T_base_flange[:3, 3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(left.q_home), (0, -130, 135, 30, 0, 40, 0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", robots.names())
def test_every_number_states_its_source(name: str) -> None:
    robot = robots.load(name)
    stated = [line.split(": ")[0] for line in robot.source.split("\n")]
    needed = {"robot", "geometry", "limits", "gravity"}
    if np.isfinite(robot.qd_max).all():
        needed |= {"speeds", "accelerations", "home", "gears"}
    if not np.array_equal(robot.T_base_mount, np.eye(4)):
        needed |= {"mount"}
    if np.isfinite(robot.tau_max).any():
        needed |= {"efforts"}
    if robot.inertias is not None:
        needed |= {"inertias"}
    assert needed <= set(stated)
    assert stated[0] == "robot", "what it is comes first: lists show it"
    assert robot.name == name


def test_no_number_of_the_library_has_changed() -> None:
    """A model file is bound to the hash of its robot; numbers changed on purpose are checked against their source."""
    assert {name: robots.load(name).hash[:16] for name in robots.names()} == HASHES


def inside(robot: Robot, count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(robot.q_min, robot.q_max, (count, robot.n))


@pytest.mark.parametrize("name", ["fr3", "iiwa14", "panda", "ur5e"])
def test_bodies_are_possible_and_can_be_held(name: str) -> None:
    """No negative density, and enough torque to move against gravity everywhere."""
    robot = robots.load(name)
    assert ("inertias: estimate, not the vendor's" in robot.source) == (name in ("panda", "iiwa14"))
    assert robot.inertias is not None
    assert (robot.inertias[:, 0] > 0).all()
    moments = inertia.principal_moments(robot.inertias)
    assert (moments > 0).all()
    assert (moments[:, 0] + moments[:, 1] > moments[:, 2]).all()
    zero = np.zeros(robot.n)
    gravity = [robot.chain.rnea(q, zero, zero, robot.gravity, robot.inertias) for q in inside(robot, 1000)]
    assert (np.abs(gravity).max(axis=0) < 0.9 * robot.tau_max).all()


def test_centres_of_the_ur5e_in_the_frames_of_its_vendor() -> None:
    """The article on DH parameters gives them in frame i of its table, behind link i."""
    centres = [(0, -0.02561, 0.00193), (0.2125, 0, 0.11336), (0.15, 0, 0.0265)]
    centres += [(0, -0.0018, 0.01634), (0, 0.0018, 0.01634), (0, 0, -0.001159)]
    robot = robots.load("ur5e")
    assert robot.inertias is not None
    centre = inertia.to_body(robot.inertias).centre
    for i in range(6):
        np.testing.assert_allclose(se3.inv(robot.links[i + 1])[:3] @ [*centre[i], 1], centres[i], rtol=0, atol=1e-9)


H = np.pi / 2
X, Y, Z, DOWN_Y = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0)
LEVEL = (0, 0, 0)
Row = tuple[tuple[float, ...], tuple[float, ...], tuple[int, ...]]  # xyz, rpy, axis


def abb(*origins: tuple[float, float, float]) -> list[Row]:
    """Axes of ROS-Industrial's ABB arms; the flange comes last and points along x."""
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
TABLES_URDF: dict[str, list[Row]] = {  # one row per joint and one for the flange
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


def flanges(rows: list[Row], q: np.ndarray) -> np.ndarray:
    """Pinocchio's flange poses (N, 4, 4) of revolute joints and a fixed flange."""
    model, frames = pinocchio.Model(), []
    for i, (xyz, rpy, axis) in enumerate(rows[:-1]):
        joint = pinocchio.JointModelRevoluteUnaligned(np.array(axis, dtype=float))
        frames.append(model.addJoint(i, joint, placement(xyz, rpy), f"j{i}"))
    last = placement(*rows[-1][:2]).homogeneous
    data, poses = model.createData(), np.empty((len(q), 4, 4))
    for pose, position in zip(poses, q):
        pinocchio.forwardKinematics(model, data, position)
        pose[:] = data.oMi[frames[-1]].homogeneous @ last
    return poses


def placement(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> pinocchio.SE3:
    return pinocchio.SE3(pinocchio.rpy.rpyToMatrix(*rpy), np.array(xyz, dtype=float))


@pytest.mark.parametrize("name", TABLES_URDF)
def test_forward_is_that_of_another_source(name: str) -> None:
    """100 configurations inside the limits."""
    robot = robots.load(name)
    q = inside(robot, 100)
    tolerance = 1e-9 if name == "ur5e" else 1e-12  # precision of the sources
    np.testing.assert_allclose(kinematics.forward(robot, q), flanges(TABLES_URDF[name], q), atol=tolerance, rtol=0)


def test_every_robot_has_another_source() -> None:
    """The ancestor's YuMi is held to its reference numbers; DH_test is not a real robot."""
    assert set(robots.names()) - set(TABLES_URDF) == {"dh_test", "yumi_left", "yumi_right"}
