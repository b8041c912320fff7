"""Forward kinematics of the library robots: published reference numbers."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, lie, robots
from armlab.errors import ConfigError, ShapeError
from armlab.kinematics.forward import forward, link_transforms

RAMP = np.arange(1, 8) / 10
S = 0.707106781187

# Flange, without mount and tool: robot, q, p [m], quaternion wxyz (parity numbers of the ancestor, 12 digits).
REFERENCE = [
    ("irb2400", np.zeros(6), (0.94, 0, 1.455), (S, 0, S, 0)),
    (
        "irb2400",
        np.ones(6),
        (0.191167092398, 0.409118746404, 0.227535681278),
        (0.424304327966, -0.460032598173, -0.662885695216, 0.410996838146),
    ),
    (
        "irb2400",
        RAMP[:6],
        (1.008172909263, 0.117103629855, 0.993752325411),
        (0.211028318172, 0.368777489968, 0.876431648514, 0.226578413148),
    ),
    ("irb7600", np.zeros(6), (1.716, 0, 2.02), (S, 0, S, 0)),
    (
        "irb7600",
        RAMP[:6],
        (1.755516164724, 0.223047761078, 1.270034689313),
        (0.211028318172, 0.368777489968, 0.876431648514, 0.226578413148),
    ),
    ("yumi_left", np.zeros(7), (0.3375, 0, 0.4105), (S, 0, S, 0)),
    (
        "yumi_right",
        np.ones(7),
        (-0.146050539634, 0.148793967124, -0.001080158344),
        (0.591201825354, 0, -0.646448463285, 0.482270449038),
    ),
    (
        "yumi_left",
        RAMP,
        (0.331411094284, 0.137184725458, 0.194369240091),
        (0.045721044770, 0.321374739775, 0.907606846868, 0.266228612697),
    ),
    (
        "dh_test",
        RAMP[:6],
        (0.005390156511, -0.007951414380, 2.145958053711),
        (0.497526583654, 0.008114369439, 0.001848901767, 0.867408806232),
    ),
]


@pytest.mark.parametrize(("name", "q", "p", "quaternion"), REFERENCE)
def test_forward_gives_the_reference_numbers(name: str, q: np.ndarray, p: tuple, quaternion: tuple) -> None:
    robot = robots.load(name).with_base(np.eye(4)).with_tool(np.eye(4))
    T_base_tool = forward(robot, q)
    np.testing.assert_allclose(T_base_tool[:3, 3], p, rtol=0, atol=1e-12)
    wxyz = lie.quaternion.from_matrix(T_base_tool[:3, :3])
    np.testing.assert_allclose(wxyz * np.sign(wxyz @ quaternion), quaternion, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("name", "sign"), [("yumi_left", 1.0), ("yumi_right", -1.0)])
def test_forward_includes_the_mount(name: str, sign: float) -> None:
    T_base_tool = forward(robots.load(name), np.zeros(7))
    np.testing.assert_allclose(
        T_base_tool[:3, 3], [0.574481437601, sign * 0.001500332069, 0.422465683052], rtol=0, atol=1e-12
    )


def test_forward_keeps_leading_axes_and_fills_out() -> None:
    robot = robots.load("yumi_left")
    q = np.random.default_rng(0).uniform(robot.q_min, robot.q_max, (3, 5, 7))
    out = np.empty((3, 5, 4, 4))
    assert kinematics.forward(robot, q, out) is out
    np.testing.assert_array_equal(out[2, 3], forward(robot, q[2, 3]))
    assert forward(robot, np.zeros((0, 7))).shape == (0, 4, 4)
    with pytest.raises(ShapeError, match=r"Expected q of shape \(\.\.\., 7\), got \(6,\)"):
        forward(robot, np.zeros(6))


def test_link_transforms_lead_to_the_tool() -> None:
    robot = robots.load("yumi_right")
    T_base_link = link_transforms(robot, RAMP)
    assert T_base_link.shape == (7, 4, 4)
    np.testing.assert_allclose(T_base_link[-1] @ robot.frames[-1], forward(robot, RAMP), rtol=0, atol=1e-15)
    np.testing.assert_allclose(T_base_link[0, :3, 3], robot.frames[0][:3, 3], rtol=0, atol=1e-15)


def test_threads_change_no_bit() -> None:
    robot = robots.load("ur5e")
    q = np.random.default_rng(1).uniform(robot.q_min, robot.q_max, (9000, 6))
    np.testing.assert_array_equal(forward(robot, q, threads=2), forward(robot, q))
    with pytest.raises(ConfigError, match=r"Expected threads to be an integer from 1 to 256, got 0\."):
        forward(robot, q, threads=0)
