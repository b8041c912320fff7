"""Axes in space: one scale, frames and arrows where they belong."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_hex

from armlab._display import AXIS_COLORS
from armlab.errors import ShapeError
from armlab.frames import Line, Plane
from armlab.frames.features import Circle, Sphere
from armlab.lie import se3
from armlab.plots.space import AWAY, arrow, equal_scale, extent, feature, scene, solid, space


def test_the_scale_is_one_and_all_is_inside() -> None:
    _, ax = space()
    equal_scale(ax)  # nothing drawn: no effect
    assert not np.isfinite(extent(ax)).any()
    points = np.array([[0.0, 0, 0], [2.0, 0, 0.1], [1.0, np.nan, 0]])
    ax.plot(*points.T)
    arrow(ax, np.zeros(3), np.array([0.0, 0.0, 1.0]), color="black")
    solid(ax, np.array([[[0.0, 0, 0], [0, -0.5, 0], [0, 0, 0.2]]]), "red")
    ax.scatter([0.1], [0.2], [0.3])
    equal_scale(ax)
    ax.plot([], [], [], label="an entry of the legend")
    assert extent(ax) == pytest.approx(np.array([[0, -0.5, 0], [2, 0.2, 1]]))
    limits = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()])
    assert np.all(limits[:, 0] < extent(ax).min(axis=0))
    assert np.all(limits[:, 1] > extent(ax).max(axis=0))
    spans = np.ptp(limits, axis=1)
    metre = np.linalg.norm(ax.get_proj()[:3, :3], axis=0)  # one metre along x, y, z in the space of the projection
    assert metre / metre[0] == pytest.approx(np.ones(3))
    assert spans.max() / spans.min() < 4
    steps = [float(np.diff(axis.get_majorticklocs())[0]) for axis in (ax.xaxis, ax.yaxis, ax.zaxis)]
    assert steps == pytest.approx([steps[0]] * 3)


@pytest.mark.parametrize("sides", [(1.0, 0, 0), (1.0, 1, 0)])
def test_names_of_axes_stay_clear_of_their_numbers(sides: tuple[float, float, float]) -> None:
    figure, ax = space()
    ax.plot(*np.stack([np.zeros(3), sides], axis=1))
    equal_scale(ax)
    figure.canvas.draw()
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        name = axis.label.get_window_extent()
        assert figure.bbox.contains(name.x0, name.y0)
        assert figure.bbox.contains(name.x1, name.y1)
        for tick in axis.get_major_ticks():
            low, high = axis.get_view_interval()
            if low <= tick.get_loc() <= high:
                number = tick.label1.get_window_extent()
                assert not name.contains((number.x0 + number.x1) / 2, (number.y0 + number.y1) / 2)


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
    _, far = space()
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


T_PATH = se3.exp(np.linspace([0, 0, 0, 0, 0, 0], [1, 0.5, 0.3, 1, 2, 0.5], 40))


def drawn(ax, gid: str) -> list[np.ndarray]:
    return [np.stack(line.get_data_3d(), axis=-1) for line in ax.lines if line.get_gid() == gid]


def arrows(ax, name: str) -> list[np.ndarray]:
    return [patch.ends for patch in ax.patches if patch.get_gid().rpartition(".")[0] == name]


def test_a_path_has_start_end_and_frames() -> None:
    gap = T_PATH.copy()
    gap[[0, 20]] = np.nan
    ax = scene(gap, frames=0.1)
    (path,) = drawn(ax, "path")
    assert np.array_equal(path, gap[:, :3, 3], equal_nan=True)
    assert np.array_equal(drawn(ax, "start")[0], T_PATH[1:2, :3, 3])
    assert np.array_equal(drawn(ax, "end")[0], T_PATH[-1:, :3, 3])
    axes = arrows(ax, "")
    assert len(axes) == 36
    assert axes[-1] == pytest.approx(np.array([T_PATH[-1, :3, 3], T_PATH[-1, :3, 3] + 0.1 * T_PATH[-1, :3, 2]]))
    assert not scene(T_PATH).patches


def test_named_frames_and_points() -> None:
    points = np.random.default_rng(1).normal(size=(20, 3))
    points[3] = np.nan
    ax = scene({"base": np.eye(4), "cam": T_PATH[-1]}, points, frames=0.2)
    assert [text.get_text() for text in ax.texts] == ["x", "y", "z", "base", "x", "y", "z", "cam"]
    for i, ends in enumerate(arrows(ax, "cam")):
        assert ends == pytest.approx(np.array([T_PATH[-1, :3, 3], T_PATH[-1, :3, 3] + 0.2 * T_PATH[-1, :3, i]]))
    assert [to_hex(patch.get_edgecolor()).upper() for patch in ax.patches] == [*AXIS_COLORS, *AXIS_COLORS]
    assert ax.texts[3].get_position_3d() == pytest.approx(0.2 * np.array(AWAY))
    (cloud,) = ax.collections
    assert np.array_equal(np.stack(cloud._offsets3d, axis=-1), np.delete(points, 3, axis=0))
    assert np.array_equal(cloud.get_array(), np.delete(np.arange(20), 3))
    ends = arrows(scene({"a": T_PATH[0], "b": T_PATH[-1]}), "b")
    (length,) = {np.round(np.linalg.norm(np.diff(e, axis=0)), 12) for e in ends}
    assert 0.05 < length < 0.5
    assert scene({"alone": np.eye(4)}).get_xlim()[1] > 0


def test_what_cannot_be_drawn_is_refused() -> None:
    for item, words in (
        (np.zeros((3, 20)), "Transpose it"),
        (np.zeros(3), r"got \(3,\)"),
        (np.zeros((5, 4, 4)), "without a valid rotation in row 0"),
        (np.zeros((5, 3, 3)), r"\(N, 4, 4\)"),
        ({"cam": 2 * np.eye(4)}, "poses in 'cam'"),
        ({"cam": np.eye(3)}, r"the pose of 'cam' of shape \(4, 4\), got \(3, 3\)"),
    ):
        with pytest.raises(ShapeError, match=words):
            scene(item)
    for frames in (-1, np.nan, "long", [0.1, 0.2]):
        with pytest.raises(ShapeError, match="frames"):
            scene({"base": np.eye(4)}, frames=frames)
