"""`plots.poses`: position and rotation over time."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from armlab._palette import AXIS_COLORS
from armlab.errors import ShapeError
from armlab.lie import se3, so3
from armlab.plots.recording import poses

t = np.linspace(0, 2, 200)
AXIS = np.array([0.6, 0.0, 0.8])
angle = np.linspace(2.0, 6.0, 200)  # passes half a turn
T = se3.from_rp(so3.exp(angle[:, None] * AXIS), np.stack([t, t**2, -t], axis=1))


def values(ax: Axes) -> np.ndarray:
    return np.stack([line.get_ydata() for line in ax.lines], axis=1)


def test_position_and_rotation_over_time() -> None:
    figure = poses(T, t)
    assert isinstance(figure, Figure)
    above, below = figure.axes
    assert np.array_equal(values(above), T[:, :3, 3])
    assert values(below) == pytest.approx(angle[:, None] * AXIS, abs=1e-9)  # goes on past half a turn
    assert np.array_equal(above.lines[0].get_xdata(), t)
    assert [line.get_color() for line in above.lines] == list(AXIS_COLORS)
    assert (above.get_ylabel(), below.get_ylabel()) == ("position [m]", "rotation vector [rad]")
    assert below.get_xlabel() == "t [s]"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["x", "y", "z"]


def test_position_alone_over_samples() -> None:
    ax = poses(T, rotation=False)
    assert isinstance(ax, Axes)
    assert ax.get_xlabel() == "sample"
    assert np.array_equal(ax.lines[0].get_xdata(), np.arange(200))
    mine = plt.figure().add_subplot()
    assert poses(T, t, rotation=False, ax=mine) is mine


def test_missing_poses_leave_gaps_and_small_turns_are_exact() -> None:
    gap = se3.from_rp(so3.exp(np.array([[1e-12, 0, 0], [0, 0, 0], [0, 1e-9, 0]])))
    figure = poses(np.concatenate([np.full((1, 4, 4), np.nan), gap]))
    drawn = values(figure.axes[1])
    assert np.isnan(drawn[0]).all()
    assert drawn[1:] == pytest.approx(np.array([[1e-12, 0, 0], [0, 0, 0], [0, 1e-9, 0]]), rel=1e-9, abs=1e-20)
    assert np.isnan(values(figure.axes[0])[0]).all()
    assert len(poses(np.full((3, 4, 4), np.nan)).axes) == 2


def test_bad_input() -> None:
    with pytest.raises(ShapeError, match="Expected poses"):
        poses(np.eye(4))
    with pytest.raises(ShapeError, match="200 in all"):
        poses(T, t[:-1])
    with pytest.raises(ShapeError, match="finite time"):
        poses(T, np.where(t == t[3], np.nan, t))
    with pytest.raises(ShapeError, match="t to be real numbers"):
        poses(T, ["now"] * len(T))
    with pytest.raises(ShapeError, match="Expected 2 Axes"):
        poses(T, t, ax=plt.figure().add_subplot())
