"""`plots.workspace`: reachable points, the same in every panel."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import robots
from armlab.errors import ConfigError, RobotError, ShapeError
from armlab.plots.arm import stick, workspace


def clouds(figure: plt.Figure) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    side, top, solid = figure.axes
    flat = [next(line for line in ax.lines if line.get_gid() == "cloud").get_xydata() for ax in (side, top)]
    return flat[0], flat[1], np.stack(solid.collections[0]._offsets3d, axis=-1)


def test_a_planar_arm_reaches_its_ring() -> None:
    arm = robots.from_dh("planar", [0, 0], [0.5, 0.3], [0, 0], q_min=[-np.pi, -2.0], q_max=[np.pi, 2.0])
    figure = workspace(arm, points=4000)
    side, top, solid = clouds(figure)
    reach = np.linalg.norm(solid, axis=1)
    nearest = np.sqrt(0.5**2 + 0.3**2 + 2 * 0.5 * 0.3 * np.cos(2.0))
    assert nearest - 1e-12 <= reach.min() < nearest + 0.01
    assert 0.79 < reach.max() <= 0.8 + 1e-12
    assert np.array_equal(top, solid[:, :2])
    assert np.array_equal(side, solid[:, [0, 2]])
    assert np.abs(solid[:, 2]).max() < 1e-15
    title = figure.axes[0].get_title(loc="left")
    assert title == f"planar\ntool {reach.min():.2f} to {reach.max():.2f} m from the mount"
    assert figure.axes[1].get_title(loc="left") == "4000 random postures"
    assert [ax.get_xlabel() + ax.get_ylabel() for ax in figure.axes] == ["x [m]z [m]", "x [m]y [m]", "x [m]y [m]"]
    assert np.array_equal(figure.axes[1].lines[1].get_xydata(), stick(arm, arm.q_home)[:, :2])


@pytest.mark.parametrize("name", ["yumi_right", "irb7600_150_350", "dh_test"])
def test_nothing_is_cut_off(name: str) -> None:
    figure = workspace(robots.load(name), points=200)
    figure.canvas.draw()
    side, top, solid = figure.axes
    assert side.bbox.height == pytest.approx(top.bbox.height)
    labels = [axis.label for axis in (solid.xaxis, solid.yaxis, solid.zaxis)]
    for text in [*labels, side.title, side._left_title, top._left_title]:
        box = text.get_window_extent()
        assert figure.bbox.contains(box.x0, box.y0)
        assert figure.bbox.contains(box.x1, box.y1)
    assert side._left_title.get_window_extent().x1 < top._left_title.get_window_extent().x0


def test_a_seed_gives_one_cloud() -> None:
    arm = robots.load("yumi_left")
    first, again, other = (clouds(workspace(arm, points=50, seed=seed))[2] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_joints_without_limits_turn_once_and_do_not_slide() -> None:
    assert len(clouds(workspace(robots.load("dh_test"), points=10))[2]) == 10
    slide = robots.from_dh("slide", [0, 0], [0, 0.2], [0, 0], prismatic=[True, False])
    with pytest.raises(RobotError, match="joint_1 of slide"):
        workspace(slide)


def test_axes_and_points_are_checked() -> None:
    arm = robots.load("irb2400")
    figure = plt.figure()
    axes = [figure.add_subplot(131), figure.add_subplot(132), figure.add_subplot(133, projection="3d")]
    assert workspace(arm, points=5, ax=axes) is figure
    with pytest.raises(ShapeError, match="Expected 3 Axes"):
        workspace(arm, points=5, ax=axes[0])
    with pytest.raises(ShapeError, match="3d"):
        workspace(arm, points=5, ax=axes[::-1])
    for points in (0, 1.5):
        with pytest.raises(ShapeError, match=f"points={points}"):
            workspace(arm, points=points)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="seed to be an integer of at least 0, got -1"):
        workspace(arm, points=5, seed=-1)
    with pytest.raises(RobotError, match="Load it first"):
        workspace("irb2400", points=5)  # type: ignore[arg-type]
