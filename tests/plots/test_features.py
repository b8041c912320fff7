"""What is drawn of a feature is where the feature is."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.frames import Circle, Line, Plane, Sphere
from armlab.plots import scene, space
from armlab.plots.space import feature


def part(ax, gid: str) -> list:
    return [artist for artist in ax.get_children() if artist.get_gid() == gid]


def test_a_line_with_its_foot() -> None:
    line = Line.of([0.0, 1.0, 0.0], [0.3, 0.2, 0.1])
    ax = scene(np.array([[0, 0, 0], [0.5, 0.5, 0.5]]), line)
    (arrow,) = part(ax, "line")
    np.testing.assert_allclose(line.offset(arrow.ends), 0.0, atol=1e-15)
    assert (arrow.ends[1] - arrow.ends[0]) @ line.v > 0
    (foot,) = part(ax, "foot")
    np.testing.assert_allclose(np.ravel(foot.get_data_3d()), [0.3, 0.0, 0.1], atol=1e-15)
    _, far = space.space()
    feature(far, Line.of([0.0, 1.0, 0.0], [0.3, 20.0, 0.1]), 1.0, "k")
    assert not part(far, "foot")


def test_a_plane_with_its_normal() -> None:
    plane = Plane.of([1.0, 1.0, 0.0], [0.3, 0.2, 0.1])
    ax = scene({"seam": np.eye(4)}, plane)
    (patch,) = part(ax, "plane")
    corners = np.reshape(patch._faces, (4, 3))
    np.testing.assert_allclose(plane.distance(corners), 0.0, atol=1e-14)
    (normal,) = part(ax, "normal")
    np.testing.assert_allclose(np.cross(normal.ends[1] - normal.ends[0], plane.n), 0.0, atol=1e-14)


@pytest.mark.parametrize(
    ("item", "rings"),
    [
        (Circle(np.array([1.0, 2.0, 3.0]), np.eye(3)[2], 0.5, np.eye(3)[:2]), 1),
        (Sphere(np.array([1.0, 2.0, 3.0]), 0.5), 3),
    ],
)
def test_round_features(item, rings: int) -> None:
    found = part(scene(item), "circle")
    assert len(found) == rings
    for ring in found:
        away = np.stack(ring.get_data_3d(), axis=1) - [1.0, 2.0, 3.0]
        np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.5, atol=1e-15)
