"""Contents of the scene, read back from its nodes: poses, arrows, ellipsoids, paths, frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.kinematics import forward, link_transforms
from armlab.lie import se3
from armlab.live.scene import ARROW, LINK_COLORS, ForceArrow, RobotScene, ellipsoid_axes, is_significant, rgb

from .nodes import link, node, pose, tip, tool

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def test_links_and_tool_stand_where_the_kinematics_put_them(server: Any) -> None:
    T_world_base = se3.from_rp(np.eye(3), [0.0, 1.0, 0.2])
    scene = RobotScene(server, [LEFT, RIGHT], {"yumi_right": T_world_base})
    q = LEFT.q_home + 0.2
    for robot, color in zip((LEFT, RIGHT), LINK_COLORS, strict=True):
        scene.show(robot.name, q)
        T, found = link_transforms(robot, q), np.eye(4)
        for i in range(robot.n):
            one = node(server, link(robot.name, i + 1))
            found = found @ pose(one)
            np.testing.assert_allclose(found, T[i], atol=1e-12, rtol=0)
            assert tuple(one.color) == rgb(color)
        np.testing.assert_allclose(tool(server, robot.name, robot.n), forward(robot, q), atol=1e-12, rtol=0)
    np.testing.assert_allclose(pose(node(server, "/yumi_right")), T_world_base, atol=1e-12, rtol=0)
    np.testing.assert_allclose(pose(node(server, "/yumi_left")), np.eye(4), atol=1e-12, rtol=0)
    arm = robots.from_dh("slider", [0.3, 0.5, 0.0], [0.1, 0.2, 0.1], [0.2, 0.0, 0.1], prismatic=[False, True, False])
    scene.add(arm)
    for q in (np.zeros(3), np.array([0.3, 0.4, -0.2])):  # also after the first picture
        scene.show("slider", q)
        found = np.eye(4)
        for i in range(3):
            found = found @ pose(node(server, link("slider", i + 1)))
            np.testing.assert_allclose(found, link_transforms(arm, q)[i], atol=1e-12, rtol=0)


def test_arms_come_go_and_move(server: Any) -> None:
    scene = RobotScene(server, [LEFT])
    scene.add(RIGHT, se3.from_rp(np.eye(3), [0.0, 2.0, 0.0]))
    scene.show("yumi_right", RIGHT.q_home)
    far = se3.from_rp(np.eye(3), [-3.0, 4.0, 0.0])
    scene.arrange({"yumi_right": far})
    np.testing.assert_allclose(pose(node(server, "/yumi_right")), far)
    camera, floor = server.initial_camera, node(server, "/floor")
    assert np.linalg.norm(np.subtract(camera.position, camera.look_at)) > 3.0
    assert floor.width > 4.0
    assert floor.height > 5.0
    scene.remove("yumi_left")
    assert list(scene.robots) == ["yumi_right"]
    assert server.scene.get_handle_by_name(link("yumi_left", 1)) is None
    with pytest.raises(UnknownName, match="yumi_left"):
        scene.remove("yumi_left")
    with pytest.raises(UnknownName, match="yumi_left"):
        scene.arrange({"yumi_left": np.eye(4)})
    six = replace(robots.load("ur5e"), name="yumi_right")
    scene.add(six)
    scene.show("yumi_right", six.q_home)
    assert server.scene.get_handle_by_name(link("yumi_right", 7)) is None


def test_a_force_is_an_arrow_at_the_tool_with_its_ellipsoid_at_the_tip(server: Any) -> None:
    scene = RobotScene(server, [LEFT])
    root = np.random.default_rng(3).normal(size=(6, 6))
    force, C = np.array([10.0, -5.0, 20.0]), root @ root.T
    scene.show("yumi_left", LEFT.q_home, [*force, 0, 0, 0], C)
    at = forward(LEFT, LEFT.q_home)[:3, 3]
    arrow, ball = node(server, "/yumi_left/force"), node(server, "/yumi_left/uncertainty")
    assert arrow.visible
    assert ball.visible
    np.testing.assert_allclose(arrow.position, at)
    np.testing.assert_allclose(tip(arrow), at + ARROW * force)
    np.testing.assert_allclose(ball.position, at + ARROW * force)
    axes = pose(ball)[:3, :3] * ball.scale
    np.testing.assert_allclose(axes @ axes.T, (2.0 * ARROW) ** 2 * C[:3, :3], atol=1e-12, rtol=1e-6)
    assert tuple(arrow.color) == tuple(ball.color) == rgb("#D55E00")
    assert pytest.approx(0.2) == ARROW * 20.0
    scene.arrow = 2 * ARROW
    scene.show("yumi_left", LEFT.q_home, force)
    np.testing.assert_allclose(tip(arrow), at + 2 * ARROW * force)
    assert not ball.visible
    for down in (*np.eye(3), *-np.eye(3), [1e-5, 0.0, -1.0], [0.0, 1e-6, -1.0], [1e-9, 0.0, -1.0]):
        scene.show("yumi_left", LEFT.q_home, 10.0 * np.array(down))  # near -z, the rotation axis is not unique
        np.testing.assert_allclose(tip(arrow), at + 20.0 * ARROW * np.array(down), atol=1e-8, rtol=0)


def test_an_arm_whose_joints_are_not_known_is_hidden(server: Any) -> None:
    scene = RobotScene(server, [LEFT])
    scene.show("yumi_left", np.full(7, np.nan), [1.0, 2.0, 3.0])
    assert not node(server, "/yumi_left/arm").visible
    assert not node(server, "/yumi_left/force").visible
    scene.show("yumi_left", LEFT.q_home)
    assert node(server, "/yumi_left/arm").visible


def test_the_path_is_thinned_and_gaps_are_bridged(server: Any) -> None:
    scene = RobotScene(server, [LEFT])
    points = np.linspace([0.3, 0.0, 0.2], [0.5, 0.1, 0.2], 2500)
    points[100] = np.nan
    scene.trace("yumi_left", points)
    path = node(server, "/yumi_left/path")
    assert path.visible
    assert path.points.shape[1:] == (2, 3)
    assert 200 < len(path.points) <= 300
    np.testing.assert_allclose(path.points[0, 0], points[0], atol=1e-6, rtol=0)
    scene.trace("yumi_left", points[:1])
    assert not path.visible


def test_frames_come_move_and_go(server: Any) -> None:
    scene = RobotScene(server, [LEFT])
    T = se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    for one in (np.eye(4), T):
        scene.frame("table", one)
        np.testing.assert_allclose(pose(node(server, "/frames/table")), one, atol=1e-12, rtol=0)
    assert node(server, "/frames/table/name").text == "table"
    scene.frame("table", None)
    scene.frame("table", None)
    assert server.scene.get_handle_by_name("/frames/table") is None


def test_wrong_input_gets_a_sentence(server: Any) -> None:
    for arms, bases, error, words in (
        ([LEFT, LEFT], {}, RobotError, "different names"),
        ([], {}, RobotError, "different names, got none"),
        (["yumi_left"], {}, RobotError, "yumi_left"),
        ([LEFT], {"ur5e": np.eye(4)}, UnknownName, "yumi_left"),
        ([LEFT], {"yumi_left": np.zeros((4, 4))}, ShapeError, "Expected a pose"),
    ):
        with pytest.raises(error, match=words):
            RobotScene(server, arms, bases)
    scene = RobotScene(server, [LEFT])
    with pytest.raises(UnknownName, match="arm in this view"):
        scene.show("yumi_right", LEFT.q_home)
    for arguments in ([np.zeros(6)], [LEFT.q_home, np.zeros(4)], [LEFT.q_home, np.zeros(6), np.eye(4)]):
        with pytest.raises(ShapeError):
            scene.show("yumi_left", *arguments)
    with pytest.raises(ShapeError, match=r"\(K, 3\)"):
        scene.trace("yumi_left", np.zeros((3, 2)))
    scene.arrow = 0.0
    with pytest.raises(ShapeError, match="length of a force"):
        scene.show("yumi_left", LEFT.q_home, np.ones(3))


TOOL = np.array([0.3, 0.1, 0.2])
C_FORCE = np.diag([1.0, 4.0, 9.0])


def test_a_force_is_significant_beyond_the_ellipsoid_of_95_percent() -> None:
    for force, significant in (([2.7, 0, 0], False), ([2.9, 0, 0], True), ([0, 0, 8.3], False), ([0, 0, 8.5], True)):
        assert is_significant(np.array(force), *ellipsoid_axes(C_FORCE)) is significant  # sqrt(7.81) = 2.795 sigma
    assert is_significant(np.array([0.1, 0.0, 0.0]), np.eye(3), np.zeros(3))


def test_small_forces_are_thin_and_tiny_ones_hidden(server: Any) -> None:
    one = ForceArrow(server.scene, "/x")
    arrow, ball = (server.scene.get_handle_by_name(f"/x/{name}") for name in ("force", "uncertainty"))
    unknown = np.full((3, 3), np.nan)
    for newton, thick, shown in ((0.05, 0.0, False), (1.0, 0.3, True), (7.5, 0.5, True), (40.0, 1.0, True)):
        one.show(TOOL, np.array([0.0, newton, 0.0]), C_FORCE, 0.01)
        assert (arrow.visible, ball.visible) == (shown, True)
        if shown:
            np.testing.assert_allclose(arrow.scale, [thick, thick, 0.01 * newton])
        np.testing.assert_allclose(ball.position, TOOL + 0.01 * newton * np.eye(3)[1])
    missing = ((np.ones(3), unknown), (np.ones(3), None), (None, C_FORCE), (np.full(3, np.nan), C_FORCE))
    for force, covariance in missing:
        one.show(TOOL, force, covariance, 0.01)
        assert not ball.visible
        assert arrow.visible is (force is not None and bool(np.isfinite(force).all()))
    one.show(TOOL, np.ones(3), C_FORCE, 0.01)
    one.hide()
    assert not arrow.visible
    assert not ball.visible
