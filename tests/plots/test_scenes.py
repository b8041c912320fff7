"""`plots.scene`: frames, paths and points in one space."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import ShapeError
from armlab.lie import se3
from armlab.plots.space import pose_stack, scene

T = se3.exp(np.linspace([0, 0, 0, 0, 0, 0], [1, 0.5, 0.3, 1, 2, 0.5], 40))


def drawn(ax, gid: str) -> list[np.ndarray]:
    return [np.stack(line.get_data_3d(), axis=-1) for line in ax.lines if line.get_gid() == gid]


def arrows(ax, name: str) -> list[np.ndarray]:
    return [patch.ends for patch in ax.patches if patch.get_gid().rpartition(".")[0] == name]


def test_a_path_has_start_end_and_frames() -> None:
    gap = T.copy()
    gap[[0, 20]] = np.nan
    ax = scene(gap, frames=0.1)
    (path,) = drawn(ax, "path")
    assert np.array_equal(path, gap[:, :3, 3], equal_nan=True)
    assert np.array_equal(drawn(ax, "start")[0], T[1:2, :3, 3])
    assert np.array_equal(drawn(ax, "end")[0], T[-1:, :3, 3])
    axes = arrows(ax, "")
    assert len(axes) == 36
    assert axes[-1] == pytest.approx(np.array([T[-1, :3, 3], T[-1, :3, 3] + 0.1 * T[-1, :3, 2]]))
    assert not scene(T).patches


def test_named_frames_and_points() -> None:
    points = np.random.default_rng(1).normal(size=(20, 3))
    points[3] = np.nan
    ax = scene({"base": np.eye(4), "cam": T[-1]}, points, frames=0.2)
    assert [text.get_text() for text in ax.texts] == ["x", "y", "z", "base", "x", "y", "z", "cam"]
    for i, ends in enumerate(arrows(ax, "cam")):
        assert ends == pytest.approx(np.array([T[-1, :3, 3], T[-1, :3, 3] + 0.2 * T[-1, :3, i]]))
    (cloud,) = ax.collections
    assert np.array_equal(np.stack(cloud._offsets3d, axis=-1), np.delete(points, 3, axis=0))
    assert np.array_equal(cloud.get_array(), np.delete(np.arange(20), 3))
    (length,) = {np.round(np.linalg.norm(np.diff(e, axis=0)), 12) for e in arrows(scene({"a": T[0], "b": T[-1]}), "b")}
    assert 0.05 < length < 0.5
    assert scene({"alone": np.eye(4)}).get_xlim()[1] > 0


def test_together_with_an_arm() -> None:
    from armlab.plots import robot

    arm = robots.load("irb2400")
    ax = robot(arm, frames=False)
    assert scene({"4": kinematics.link_transforms(arm, arm.q_home)[3]}, frames=0.3, ax=ax) is ax
    assert ax.get_zlim()[1] > 1.4


@pytest.mark.parametrize(
    ("item", "words"),
    [
        (np.zeros((3, 20)), "Transpose it"),
        (np.zeros(3), r"got \(3,\)"),
        (np.zeros((5, 4, 4)), "row 0 whose rotation"),
        (np.zeros((5, 3, 3)), r"\(N, 4, 4\)"),
        ({"cam": 2 * np.eye(4)}, "poses in 'cam'"),
        ({"cam": np.eye(3)}, r"the pose of 'cam' of shape \(4, 4\), got \(3, 3\)"),
        ({"cam": "here"}, "the pose of 'cam' to be real numbers, got 'here'"),
        ("path", "what is drawn to be real numbers, got 'path'"),
        ([[1, 2, 3], [1, 2]], "what is drawn to be real numbers"),
    ],
)
def test_what_cannot_be_drawn_is_refused(item, words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        scene(item)


def test_missing_poses_are_poses() -> None:
    gap = T.copy()
    gap[2] = np.nan
    assert pose_stack(gap) is gap
    gap[3, 3, 0] = 1.0
    with pytest.raises(ShapeError, match="row 3"):
        pose_stack(gap)


@pytest.mark.parametrize("frames", [-1, np.nan, np.inf, "long", [0.1, 0.2]])
def test_frames_have_a_length(frames) -> None:
    with pytest.raises(ShapeError, match="frames to be"):
        scene({"base": np.eye(4)}, frames=frames)
