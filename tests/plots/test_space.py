"""Axes in space: one scale, frames and arrows where they belong."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_hex

from armlab._palette import AXIS_COLORS
from armlab.errors import ShapeError
from armlab.lie import se3
from armlab.plots.space import AHEAD, AWAY, PROJECTION, arrow, equal_scale, extent, frame, solid, space, word

T = se3.exp([0.3, -0.2, 0.5, 0.4, -0.7, 1.1])


def test_axes_are_new_or_the_callers() -> None:
    figure, ax = space()
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()) == ("x [m]", "y [m]", "z [m]")
    assert space(ax) == (figure, ax)
    assert (ax.elev, ax.azim) == (PROJECTION["elev"], PROJECTION["azim"])
    with pytest.raises(ShapeError, match='projection="3d"'):
        space(plt.figure().add_subplot())
    with pytest.raises(ShapeError, match="2 in an array"):
        space([ax, ax])


def test_the_scale_is_one_and_all_is_inside() -> None:
    _, ax = space()
    equal_scale(ax)  # nothing drawn: nothing happens
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


def test_a_frame_has_three_lettered_arrows_in_their_colours() -> None:
    _, ax = space()
    frame(ax, T, 0.2, "cam", place=AHEAD)
    for i, patch in enumerate(ax.patches):
        assert np.array_equal(patch.ends, [T[:3, 3], T[:3, 3] + 0.2 * T[:3, i]])
        assert to_hex(patch.get_edgecolor()).upper() == AXIS_COLORS[i]
        assert patch.get_gid() == f"cam.{'xyz'[i]}"
    assert [text.get_text() for text in ax.texts] == ["x", "y", "z", "cam"]
    assert ax.texts[-1].get_position_3d() == pytest.approx(T[:3, 3] + 0.2 * T[:3, :3] @ AHEAD)
    frame(ax, T, 0.2, "away")
    assert ax.texts[-1].get_position_3d() == pytest.approx(T[:3, 3] + 0.2 * T[:3, :3] @ AWAY)
    frame(ax, T, 0.2, letters=False)
    assert len(ax.texts) == 8
    ax.figure.canvas.draw()


@pytest.mark.parametrize("sides", [(1.0, 1, 1), (1.0, 0, 0), (0.0, 0, 1), (1.0, 1, 0)])
def test_names_of_axes_stay_clear_of_their_numbers(sides: tuple[float, float, float]) -> None:
    """Of a flat or a tall box too."""
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


def test_a_name_is_inside_the_axes() -> None:
    """Alone in the scene, a frame has its name beside it, not beyond the edge of the paper."""
    figure, ax = space()
    frame(ax, np.eye(4), 0.15, "alone")
    assert extent(ax)[0] == pytest.approx([-0.045, -0.045, 0])
    equal_scale(ax)
    figure.canvas.draw()
    place = ax.texts[-1].get_window_extent()
    assert figure.bbox.contains(place.x0, place.y0)
    assert figure.bbox.contains(place.x1, place.y1)


def test_words_stay_above_solids() -> None:
    _, ax = space()
    word(ax, np.zeros(3), "here")
    solid(ax, np.eye(3)[None], "red")
    ax.figure.canvas.draw()
    assert ax.texts[0].zorder > ax.collections[0].zorder


def test_the_box_has_all_its_edges() -> None:
    """Without those of the panes nothing ends the box on the left, where no axis is."""
    _, ax = space()
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        assert axis.pane.get_edgecolor()[3] == 1.0
        assert axis.pane.get_facecolor()[3] == 0.0
