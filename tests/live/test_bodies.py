"""Shapes of arms: closed surfaces of the right size, in the right place, from descriptions and from meshes."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import robots
from armlab.kinematics import forward, link_transforms
from armlab.live.scene import along, arrow, bodies, box, capsule, mesh_bodies
from armlab.robots import Mesh, Robot


def distance(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    s = np.clip((points - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-30), 0.0, 1.0)
    return np.linalg.norm(points - a - s[:, None] * (b - a), axis=1)


@pytest.mark.parametrize("b", [[0.0, 0.0, 0.5], [0.3, -0.2, 0.1], [0.0, 0.0, -0.4], [0.0, 0.0, 0.0]])
def test_a_capsule_is_all_points_near_a_line(b: list[float]) -> None:
    a, end, r = np.array([0.1, 0.2, 0.3]), np.array([0.1, 0.2, 0.3]) + b, 0.05
    body = capsule(a, end, r)
    np.testing.assert_allclose(distance(body.vertices, a, end), r, atol=1e-12, rtol=0)
    ideal = np.pi * r**2 * (np.linalg.norm(b) + 4.0 / 3.0 * r)
    assert 0.95 * ideal < body.volume < ideal


def test_an_arrow_points_along_z_and_is_turned_anywhere() -> None:
    body = arrow()
    assert body.volume > 0
    np.testing.assert_array_equal(body.vertices[:, 2].min(), 0.0)
    np.testing.assert_array_equal(body.vertices[body.vertices[:, 2].argmax()], [0.0, 0.0, 1.0])
    a, b = np.array([0.1, 0.2, 0.3]), np.array([0.4, -0.2, 0.9])
    for end in (b, a + np.array([0.0, 0.0, 1.0]), a - np.array([0.0, 0.0, 2.0])):
        T = along(a, end)
        np.testing.assert_allclose((T @ [0.0, 0.0, np.linalg.norm(end - a), 1.0])[:3], end, atol=1e-12, rtol=0)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12, rtol=0)
    np.testing.assert_array_equal(along(a, a)[:3, 2], [0.0, 0.0, 1.0])


@pytest.mark.parametrize("name", robots.names())
def test_links_hang_together(name: str) -> None:
    robot = robots.load(name)
    shapes = bodies(robot)
    assert len(shapes) == robot.n + 1
    q = robot.q_home + 0.1
    T = np.concatenate([np.eye(4)[None], link_transforms(robot, q), forward(robot, q)[None]])
    for i, body in enumerate(shapes):
        assert body.volume > 0
        origin = (np.linalg.inv(T[i]) @ T[i + 1])[:3, 3]
        low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
        assert (low - 1e-9 <= origin).all()
        assert (origin <= high + 1e-9).all()


def test_what_slides_has_a_rod_as_long_as_its_stroke() -> None:
    limits = {"q_min": [-2, -2, 0, -3], "q_max": [2, 2, 0.3, 3]}
    alpha, a, d = [0, np.pi, 0, 0], [0.4, 0.3, 0, 0], [0.5, 0, 0, 0.05]
    scara = robots.from_dh("scara", alpha, a, d, prismatic=[0, 0, 1, 0], **limits)
    assert bodies(scara)[3].vertices[:, 2].min() == pytest.approx(-0.3)


def with_mesh(*files: str) -> Robot:
    robot = robots.load("irb2400")
    mesh = [(Mesh("visual", file, np.eye(4), np.full(3, 1e-3)),) for file in files]
    return replace(robot, meshes=((), *mesh, *[()] * (robot.n - len(mesh))))


def test_meshes_are_read_where_there_are_any(tmp_path: Path) -> None:
    pytest.importorskip("trimesh", reason="trimesh is not installed: meshes of the extra live")
    (tmp_path / "maker").mkdir()
    for name, length in (("maker/one.stl", 300.0), ("two.stl", 10.0)):
        box(np.zeros(3), np.array([0.0, 0.0, length]), 100.0).export(tmp_path / name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = mesh_bodies(
            with_mesh("package://maker/one.stl", "package://other/two.stl"), [tmp_path / "no", tmp_path]
        )
    assert [one is None for one in found] == [True, False, False, True, True, True, True]
    assert found[1] is not None
    np.testing.assert_allclose(np.ptp(found[1].vertices, axis=0), [0.1, 0.1, 0.3])  # mm in the file


def test_packages_are_looked_for_where_ros_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("trimesh", reason="trimesh is not installed: meshes of the extra live")
    for folder in ("src/maker", "install/share/other"):
        (tmp_path / folder).mkdir(parents=True)
    for name in ("src/maker/one.stl", "install/share/other/two.stl"):
        box(np.zeros(3), np.array([0.0, 0.0, 10.0]), 100.0).export(tmp_path / name)
    robot = with_mesh("package://maker/one.stl", "package://other/two.stl")
    with pytest.warns(UserWarning, match=r"package://maker/one\.stl.*--package-path FOLDER"):
        assert mesh_bodies(robot, [tmp_path]) == [None] * 7
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{tmp_path / 'src'}")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    assert [one is None for one in mesh_bodies(robot, [tmp_path])] == [True, False, False, *[True] * 4]


def test_meshes_of_collada_are_read(tmp_path: Path) -> None:
    pytest.importorskip("trimesh", reason="trimesh is not installed: meshes of the extra live")
    pytest.importorskip("collada", reason="pycollada is not installed: .dae meshes of the extra live")
    (tmp_path / "one.dae").write_bytes(box(np.zeros(3), np.array([0.0, 0.0, 300.0]), 100.0).export(file_type="dae"))
    found = mesh_bodies(with_mesh("one.dae"), [tmp_path])[1]
    assert found is not None
    np.testing.assert_allclose(np.ptp(found.vertices, axis=0), [0.1, 0.1, 0.3])


def test_missing_meshes_are_told_once(tmp_path: Path) -> None:
    (tmp_path / "broken.stl").write_text("solid of nothing")
    with pytest.warns(UserWarning, match=r"irb2400, but cannot read gone\.stl, broken\.stl") as told:
        found = mesh_bodies(with_mesh("gone.stl", "broken.stl"), [tmp_path])
    assert len(told) == 1
    assert found == [None] * 7
