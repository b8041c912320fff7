"""The figure of a primitive of poses: its motion, what it was taught, and how far apart they are."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.lie import so3
from armlab.motion import PoseDmp, fit_pose_dmp
from armlab.plots import pose_dmp

T = np.linspace(0.0, 1.0, 201)
S = 10 * T**3 - 15 * T**4 + 6 * T**5
POSES = np.tile(np.eye(4), (201, 1, 1))
POSES[:, :3, :3] = so3.exp(np.outer(S, [0.8, 0.0, -0.6]))
POSES[:, :3, 3] = np.outer(S, [0.2, -0.1, 0.1]) + np.array([0.4, 0.0, 0.3])


@pytest.fixture(scope="module")
def taught() -> PoseDmp:
    return fit_pose_dmp(T, POSES, n_basis=12).value


def test_motion_and_demonstration_are_shown_with_their_distance(taught: PoseDmp) -> None:
    figure = pose_dmp(taught, (T + 2.0, POSES))
    position, rotation, distance, angle = figure.axes
    run = taught.rollout(T)
    np.testing.assert_allclose([line.get_ydata() for line in position.lines[:3]], run.T[:, :3, 3].T, atol=1e-12)
    np.testing.assert_allclose([line.get_ydata() for line in position.lines[3:]], POSES[:, :3, 3].T, atol=1e-12)
    away = so3.log(POSES[:, :3, :3] @ POSES[-1, :3, :3].T)
    np.testing.assert_allclose([line.get_ydata() for line in rotation.lines[3:]], away.T, atol=1e-12)
    np.testing.assert_allclose([line.get_ydata()[-1] for line in rotation.lines[:3]], 0.0, atol=1e-3)  # pyright: ignore
    off = np.linalg.norm(run.T[:, :3, 3] - POSES[:, :3, 3], axis=1)
    np.testing.assert_allclose(distance.lines[0].get_ydata(), off, atol=1e-15)
    np.testing.assert_allclose(angle.lines[0].get_ydata(), so3.angle(run.T[:, :3, :3], POSES[:, :3, :3]), atol=1e-9)
    units = [panel.get_ylabel()[-5:] for panel in figure.axes]
    assert units == ["n [m]", "[rad]", "f [m]", "[rad]"]
    assert angle.get_xlabel() == "t [s]"
    assert position.get_legend_handles_labels()[1] == ["x", "y", "z", "demonstration"]
    plt.close(figure)


def test_without_a_demonstration_there_are_two_panels(taught: PoseDmp) -> None:
    _, axes = plt.subplots(2, 1)
    assert pose_dmp(taught, ax=axes) is axes[0].figure
    assert len(axes[0].lines) == 3
    plt.close("all")


def test_bad_input_gets_a_sentence(taught: PoseDmp) -> None:
    for misuse in (
        lambda: pose_dmp(taught, (T, POSES[1:])),
        lambda: pose_dmp(taught, (T[::-1], POSES)),
        lambda: pose_dmp(taught, (T, POSES), ax=plt.subplots(2)[1]),
    ):
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse()
    plt.close("all")
