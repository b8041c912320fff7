"""The robots of the library: DH = POE = local POE, and the ancestors' reference numbers."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.lie import quaternion, se3, so3

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
REFERENCE = [  # robot, q, flange position, quaternion, Jacobian times ones; no base, no tool
    ("irb2400", "0", (0.94, 0, 1.455), (0.707106781187, 0, 0.707106781187, 0), (0.975, 0.94, -1.765, 2, 3, 1)),
    (
        "irb2400",
        "1",
        (0.191167092398, 0.409118746404, 0.227535681278),
        (0.424304327966, -0.460032598173, -0.662885695216, 0.410996838146),
        (-1.065199851629, -0.687568621463, -0.051544723256, -2.889699298619, 1.511704837576, -0.561567787807),
    ),
    (
        "irb2400",
        "ramp",
        (1.008172909263, 0.117103629855, 0.993752325411),
        (0.211028318172, 0.368777489968, 0.876431648514, 0.226578413148),
        (-0.118314250945, 1.074968536053, -1.716423864621, 1.304361026368, 3.254234528159, 0.054062664636),
    ),
    ("irb7600", "0", (1.716, 0, 2.02), (0.707106781187, 0, 0.707106781187, 0), (1.405, 1.716, -2.862, 2, 3, 1)),
    (
        "irb7600",
        "ramp",
        (1.755516164724, 0.223047761078, 1.270034689313),
        (0.211028318172, 0.368777489968, 0.876431648514, 0.226578413148),
        (-0.494523405289, 1.925092727513, -2.583373807096, 1.304361026368, 3.254234528159, 0.054062664636),
    ),
    ("yumi", "0", (0.3375, 0, 0.4105), (0.707106781187, 0, 0.707106781187, 0), (0.3815, 0.6615, -0.6965, 2, 3, 2)),
    (
        "yumi",
        "1",
        (-0.146050539634, 0.148793967124, -0.001080158344),
        (0.591201825354, 0, -0.646448463285, 0.482270449038),
        (-0.332963909040, -0.579088957297, 0.146185385520, -3.092758901510, 1.085560310987, 2.018584811360),
    ),
    (
        "yumi",
        "ramp",
        (0.331411094284, 0.137184725458, 0.194369240091),
        (0.045721044770, 0.321374739775, 0.907606846868, 0.266228612697),
        (-0.349855990704, 0.628741526053, -0.652366329789, 0.641429313372, 3.629494786012, 1.077111066362),
    ),
    (
        "dh_test",
        "ramp",
        (0.005390156511, -0.007951414380, 2.145958053711),
        (0.497526583654, 0.008114369439, 0.001848901767, 0.867408806232),
        None,
    ),
]


def configuration(word: str, n: int) -> np.ndarray:
    return 0.1 * np.arange(1, n + 1) if word == "ramp" else np.full(n, float(word))


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


@pytest.mark.parametrize(("name", "word", "p", "wxyz", "J_ones"), REFERENCE)
def test_reference_numbers(name: str, word: str, p: tuple, wxyz: tuple, J_ones: tuple | None) -> None:
    """Flange poses and Jacobians that an independent port of the ancestor computed."""
    robot = robots.load("yumi_right" if name == "yumi" else name).with_base(np.eye(4))
    q = configuration(word, robot.n)
    T = kinematics.forward(robot, q)
    np.testing.assert_allclose(T[:3, 3], p, rtol=0, atol=1e-12)
    assert so3.angle(T[:3, :3], quaternion.to_matrix(wxyz)) < 5e-12
    if J_ones is not None:
        np.testing.assert_allclose(kinematics.jacobian(robot, q) @ np.ones(robot.n), J_ones, rtol=0, atol=2e-12)


@pytest.mark.parametrize(("name", "side"), [("yumi_left", 1), ("yumi_right", -1)])
def test_yumi_in_its_body(name: str, side: int) -> None:
    robot = robots.load(name)
    zero = kinematics.forward(robot, np.zeros(7))
    np.testing.assert_allclose(zero[:3, 3], (0.574481437601, 0.001500332069 * side, 0.422465683052), rtol=0, atol=1e-12)


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


def test_yumi_limits_gears_and_order() -> None:
    robot = robots.load("yumi_left")
    np.testing.assert_allclose(np.rad2deg(robot.q_min), (-168.5, -143.5, -168.5, -123.5, -290, -88, -229))
    np.testing.assert_allclose(np.rad2deg(robot.q_max), (168.5, 43.5, 168.5, 80, 290, 138, 229))
    np.testing.assert_allclose(np.rad2deg(robot.qd_max), (180, 180, 180, 180, 400, 400, 400))
    np.testing.assert_allclose(robot.qdd_max, robot.qd_max / 0.1)
    gears = [1 / 100, 1 / 100, 1 / 100, -1 / 100, 1 / 100, -1 / 101, 1 / 100]
    np.testing.assert_array_equal(robot.coupling, np.diag(gears))
    assert robot.abb_axes == (1, 2, 7, 3, 4, 5, 6)
    assert (robot.side, robots.load("yumi_right").side) == ("left", "right")


@pytest.mark.parametrize(
    ("name", "low", "high", "speed"),
    [
        ("irb2400", (-180, -100, -60, -200, -120, -400), (180, 110, 65, 200, 120, 400), (150, 150, 150, 360, 360, 450)),
        ("irb7600", (-180, -60, -180, -300, -100, -360), (180, 85, 60, 300, 100, 360), (100, 60, 60, 100, 100, 190)),
    ],
)
def test_irb_limits(name: str, low: tuple, high: tuple, speed: tuple) -> None:
    robot = robots.load(name)
    for field, degrees in ((robot.q_min, low), (robot.q_max, high), (robot.qd_max, speed)):
        np.testing.assert_allclose(np.rad2deg(field), degrees)


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


def test_names_of_the_library() -> None:
    assert robots.names() == (
        "dh_test", "fr3", "iiwa14", "irb120", "irb1200", "irb1200_7_70", "irb2400", "irb7600", "irb7600_150_350",
        "panda", "ur5e", "yumi_left", "yumi_left_urdf", "yumi_right", "yumi_right_urdf",
    )  # fmt: skip
