"""Robots of the library: tables, limits, and vendors' URDF."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest

from armlab import kinematics, robots
from armlab.lie import quaternion, se3, so3
from armlab.robots import Robot, inertia

RIGHT_ANGLE = np.pi / 2
TABLES = {  # alpha, a, d, offset: typed in from the sources, not read from the files
    "irb2400": (
        np.array([-1, 0, -1, -1, 1, 0]) * RIGHT_ANGLE,
        [0.100, 0.705, 0.135, 0, 0, 0],
        [0.615, 0, 0, 0.755, 0, 0.085],
        np.array([0, -1, 0, 2, 0, 0]) * RIGHT_ANGLE,
    ),
    "irb7600": (
        np.array([-1, 0, -1, 1, -1, 0]) * RIGHT_ANGLE,
        [0.410, 1.075, 0.165, 0, 0, 0],
        [0.780, 0, 0, 1.056, 0, 0.250],
        np.array([0, -1, 0, 0, 0, 2]) * RIGHT_ANGLE,
    ),
    "yumi": (
        np.array([-1, 1, -1, 1, -1, 1, 0]) * RIGHT_ANGLE,
        [-0.030, 0.030, 0.0405, -0.0405, 0.0135, -0.027, 0],
        [0.110, 0, 0.2465, 0, 0.265, 0, 0.032],
        np.array([0, 0, 0, 1, 0, 0, 0]) * RIGHT_ANGLE,
    ),
    "dh_test": (
        [0.001, 0.002, 0.003, 0.004, 0.005, 0.006],
        [0, 0, 0, 0, 0, 0],
        [0.780, 0.010, 0.020, 1.056, 0.030, 0.250],
        [0, 0, 0, 0, 0, 0],
    ),
}
MOUNTS = {
    "yumi_left": ((0.82888, -0.31402, 0.40801, -0.2188), (0.0476, 0.0700, 0.4115)),
    "yumi_right": ((0.82888, 0.31402, 0.40801, 0.2188), (0.0476, -0.0700, 0.4115)),
}
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
H = np.pi / 2
X, Y, Z, DOWN_Y = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0)
LEVEL = (0, 0, 0)

Row = tuple[tuple[float, ...], tuple[float, ...], tuple[int, ...]]  # xyz, rpy, axis


def table(name: str) -> tuple:
    return TABLES["yumi" if name in MOUNTS else name]


def mount(name: str) -> np.ndarray:
    if name not in MOUNTS:
        return np.eye(4)
    wxyz, p = MOUNTS[name]
    return se3.from_rp(quaternion.to_matrix(wxyz), p)


def dh_product(name: str, q: np.ndarray) -> np.ndarray:
    """The mount, then A_1 ... A_n with the matrix of the textbooks; q (N, n)."""
    T = np.broadcast_to(mount(name), (len(q), 4, 4))
    for alpha, a, d, offset, position in zip(*table(name), q.T):
        ct, st = np.cos(position + offset), np.sin(position + offset)
        ca, sa, zero, one = np.cos(alpha), np.sin(alpha), np.zeros(len(q)), np.ones(len(q))
        rows = [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [zero, sa * one, ca * one, d * one],
            [zero, zero, zero, one],
        ]
        T = T @ np.moveaxis(np.array(rows), -1, 0)
    return T


def product_of_exponentials(screws: np.ndarray, T_home: np.ndarray, q: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    for xi, position in zip(screws, q.T):
        T = T @ se3.exp(position[:, None] * xi)
    return T @ T_home


def local_product(poses: np.ndarray, screws: np.ndarray, q: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    for pose, xi, position in zip(poses, screws, q.T):
        T = T @ pose @ se3.exp(position[:, None] * xi)
    return T @ poses[-1]


@pytest.mark.parametrize("name", ["dh_test", "irb2400", "irb7600", "yumi_left", "yumi_right"])
def test_dh_poe_and_local_poe_agree(name: str) -> None:
    """Seven ways to the same pose on 1000 random configurations, the textbook product being the reference."""
    robot = robots.load(name)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (1000, robot.n))
    local = robots.to_local_poe(robot)
    poses = {
        "kinematics": kinematics.forward(robot, q),
        "screws": product_of_exponentials(robot.screws, robot.T_home, q),
        "local screws": local_product(*local, q),
        "from_poe": kinematics.forward(robots.from_poe(name, robot.screws, robot.T_home), q),
        "from_local_poe": kinematics.forward(robots.from_local_poe(name, *local), q),
        "from_dh": kinematics.forward(robots.from_dh(name, *table(name), T_base_mount=mount(name)), q),
    }
    expected = dh_product(name, q)
    for way, T in poses.items():
        np.testing.assert_allclose(T, expected, atol=1e-12, rtol=0, err_msg=way)


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
    """A model file is bound to the hash of its robot; what has changed on purpose is compared with its source again."""
    assert {name: robots.load(name).hash[:16] for name in robots.names()} == HASHES


REACH = {"irb120": 0.58, "irb1200": 0.90, "irb1200_7_70": 0.70, "irb7600": 2.55, "irb7600_150_350": 3.50}


@pytest.mark.parametrize("name", REACH)
def test_reach_is_that_of_the_type_name(name: str) -> None:
    """ABB names an arm after the largest distance of its wrist from axis 1."""
    robot = robots.load(name)
    q = np.zeros((200, 200, 6))
    q[..., 1], q[..., 2] = np.meshgrid(*np.linspace(robot.q_min[1:3], robot.q_max[1:3], 200).T, indexing="ij")
    wrist = kinematics.link_transforms(robot, q)[..., 4, :3, 3]
    assert np.hypot(wrist[..., 0], wrist[..., 1]).max() == pytest.approx(REACH[name], abs=0.005)


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
BODIES = {  # as published, frames of TABLES: mass, centre, Ixx Ixy Ixz Iyy Iyz Izz about it, roll of their axes [deg]
    "ur5e": """
        3.761  0      -0.00193 -0.02561  0.00700210  0.00000073 -0.00001053 0.00648091  0.00049994 0.00657286  90
        8.058 -0.2125  0        0.11336  0.01505885 -0.00005400  0.00000563 0.33388086 -0.00000181 0.33247207   0
        2.846 -0.2422  0        0.0265   0.00399632 -0.00001365  0.00137272 0.07879254 -0.00000660 0.07848510   0
        1.37   0      -0.01634 -0.0018   0.00165491 -0.00000282 -0.00000438 0.00135962  0.00010157 0.00126279  90
        1.3    0       0.01634 -0.0018   0.00135617 -0.00000274  0.00000444 0.00127827 -0.00005048 0.00096614 -90
        0.365  0       0       -0.001159 0.00018694  0.00000006 -0.00000017 0.00018908 -0.00000092 0.00025756   0""",
    "panda": """
        4.970684  0.003875  0.002081 -0.04762  0.70337  -0.000139  0.006772 0.70661   0.019169 0.009117 0
        0.646926 -0.003141 -0.02872   0.003495 0.007962 -0.003925  0.010254 0.02811   0.000704 0.025995 0
        3.228604  0.027518  0.039252 -0.066502 0.037242 -0.004761 -0.011396 0.036155 -0.012805 0.01083  0
        3.587895 -0.05317   0.104419  0.027454 0.025853  0.007796 -0.001332 0.019552  0.008641 0.028323 0
        1.225946 -0.011953  0.041065 -0.038437 0.035549 -0.002117 -0.004037 0.029474  0.000229 0.008627 0
        1.666555  0.060149 -0.014117 -0.010517 0.001964  0.000109 -0.001158 0.004354  0.000341 0.005433 0
        0.735522  0.010517 -0.004252  0.061597 0.012516 -0.000428 -0.001196 0.010027 -0.000741 0.004815 0""",
    "fr3": """
        2.9274653454  0.0000004128 -0.0181251324 -0.0386035970
            0.023927316485 1.3317903456e-5 -0.00011404774919 0.022482161328 -0.0019950320628 0.0063500982585 0
        2.9355370338  0.0031828864 -0.0743221644  0.0088146084
            0.041938946258 0.00020257331521 0.0040777842272 0.02514514885 -0.0042252158007 0.061702144729 0
        2.2449013699  0.0407015686 -0.0048200565 -0.0289730823
            0.024101425472 0.002404694559 -0.0028562692701 0.019740532667 -0.0021042126839 0.019044494482 0
        2.6155955791 -0.0459100965  0.0630492960 -0.0085187868
            0.034529983219 0.01322552266 0.010151429985 0.028881621933 -0.00097628338707 0.041254711711 0
        2.3271207594 -0.0016039605  0.0292536262 -0.0972965990
            0.051610278464 -0.0057151733878 -0.0035673167626 0.047877297134 0.010673985109 0.016423625579 0
        1.8170376524  0.0597131221 -0.0410294666 -0.0101692726
            0.0054123335944 0.0061934563603 0.0014219289306 0.014058329546 -0.0013140753741 0.016080817924 0
        0.6271432862  0.0045225817  0.0086261921 -0.0161633251
            0.0002109238915 -2.4332991145e-5 4.5644803938e-5 0.00017718568002 8.7440702232e-5 5.9931905997e-5 0""",
    "iiwa14": """
        5.289529 0       -0.033795  0.132404 0.042462  0       0      0.042838  0.006341 0.01587  0
        5.688888 0.000136 0.047548  0.076322 0.055182 -3.3e-5  5.6e-5 0.053983  0.010034 0.016523 0
        3.461245 0        0.034913  0.123108 0.02172   0       0      0.02073  -0.003845 0.007701 0
        4.122995 0       -0.039793  0.086944 0.03241   0       0      0.030758 -0.006022 0.009883 0
        1.563756 0       -0.029824  0.076267 0.008677  0       0      0.007297  0.002869 0.003935 0
        2.457878 0        0.07102   0.00495  0.007227  0       0      0.006958  0.000318 0.004734 0
        0.265331 3e-6    -2e-6      0.013782 0.000175  0       0      0.000175  0        0.000306 0""",
}
AGREE = {"ur5e": 1e-9}  # where two sources do not agree to 1e-12, to what they do


def bodies(name: str) -> np.ndarray:
    return np.array(BODIES[name].split(), dtype=float).reshape(-1, 11)


def inertial(body: np.ndarray) -> str:
    mass, x, y, z, *inertia, roll = body.tolist()
    entries = " ".join(f'{key}="{value}"' for key, value in zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), inertia))
    origin = f'<origin xyz="{x} {y} {z}" rpy="{np.deg2rad(roll)} 0 0"/>'
    return f'<inertial>{origin}<mass value="{mass}"/><inertia {entries}/></inertial>'


def urdf(rows: list[Row], links: np.ndarray | tuple = ()) -> str:
    """A chain of revolute joints and a fixed flange."""
    text = ['<robot name="r"><link name="l0"/>']
    for i, (xyz, rpy, axis) in enumerate(rows, 1):
        kind = "fixed" if i == len(rows) else "revolute"
        numbers = [" ".join(repr(float(number)) for number in numbers) for numbers in (xyz, rpy, axis)]
        text.append(
            f'<link name="l{i}">{inertial(links[i - 1]) if i <= len(links) else ""}</link>'
            f'<joint name="j{i}" type="{kind}"><parent link="l{i - 1}"/><child link="l{i}"/>'
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


@pytest.mark.parametrize("name", TABLES_URDF)
def test_forward_is_that_of_another_source(name: str) -> None:
    """1000 configurations inside the limits."""
    robot = robots.load(name)
    q = inside(robot, 1000)
    tolerance = AGREE.get(name, 1e-12)
    np.testing.assert_allclose(kinematics.forward(robot, q), flanges(TABLES_URDF[name], q), atol=tolerance, rtol=0)


def test_every_robot_has_another_source() -> None:
    """The ancestor's YuMi has its own tables in test_library.py; DH_test is no robot."""
    assert set(robots.names()) - set(TABLES_URDF) == {"dh_test", "yumi_left", "yumi_right"}


def test_franka_in_the_convention_of_its_vendor() -> None:
    """The modified table of the interface documentation, flange in the last row."""
    alpha, a = [0, -H, H, H, -H, H, H], [0, 0, 0, 0.0825, -0.0825, 0, 0.088]
    vendor = robots.from_dh("vendor", alpha, a, [0.333, 0, 0.316, 0, 0.384, 0, 0.107], modified=True)
    for name in ("panda", "fr3"):
        q = inside(robots.load(name), 100)
        np.testing.assert_allclose(
            kinematics.forward(robots.load(name), q), kinematics.forward(vendor, q), rtol=0, atol=1e-14
        )


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
    np.testing.assert_allclose(np.rad2deg(turned), {"left": 0.163, "right": 0.067}[side], rtol=0, atol=1e-3)


@pytest.mark.parametrize("name", BODIES)
def test_torques_of_the_published_bodies(name: str) -> None:
    """Pinocchio gets the bodies in the frames and about the points in which they are published; ten digits are kept."""
    robot = robots.load(name)
    model = pinocchio.buildModelFromXML(urdf(TABLES_URDF[name], bodies(name)))
    model.gravity.linear = robot.gravity
    data, rng = model.createData(), np.random.default_rng(1)
    for q in inside(robot, 50):
        qd, qdd = rng.uniform(-1, 1, (2, robot.n)) * robot.qd_max
        expected = pinocchio.rnea(model, data, q, qd, qdd)
        tau = robot.chain.rnea(q, qd, qdd, robot.gravity, robot.inertias)
        np.testing.assert_allclose(tau, expected, atol=2e-8, rtol=0)


def test_only_published_bodies_are_in_the_library() -> None:
    assert {name for name in robots.names() if robots.load(name).inertias is not None} == set(BODIES)
    for name in ("panda", "iiwa14"):
        assert "inertias: estimate, not the vendor's" in robots.load(name).source


@pytest.mark.parametrize("name", BODIES)
def test_bodies_are_possible_and_can_be_held(name: str) -> None:
    """No negative density, and gravity leaves torque to move with, everywhere."""
    robot = robots.load(name)
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
