"""Figures of movement primitives hold what the primitives say, with units, and refuse what does not fit."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import Displace, Dmp, Hold, TwoDofDmp, TwoDofRun
from armlab.plots import dmp as plot_dmp
from armlab.plots import dmp_phase, two_dof

T = np.linspace(0.0, 2.0, 101)


def primitive(schedule: str = "canonical") -> Dmp:
    x = np.linspace(0.0, 1.0, 12)
    centres = np.exp(-3 * x) if schedule == "canonical" else x
    return Dmp(
        weights=20 * np.random.default_rng(0).normal(size=(12, 2)),
        centres=centres,
        widths=np.full(12, 0.1),
        tau_d=2 / 3,
        duration=2.0,
        y0=np.zeros(2),
        v0=np.zeros(2),
        g=np.array([1.0, -0.5]),
        extent=np.ones(2),
        peak_acceleration=np.ones(2),
        monotone=np.ones(2, dtype=bool),
        schedule=schedule,
    )


def run() -> TwoDofRun:
    return TwoDofDmp(primitive()).simulate(0.01, [Hold(0.5, 0.8), Displace(1.2, 0.1)])


@pytest.mark.parametrize("schedule", ["canonical", "time", "position"])
def test_dmp_shows_demonstration_and_rollout(schedule: str) -> None:
    made, demo = primitive(schedule), np.outer(T, [0.5, -0.25])
    figure = plot_dmp(made, (T + 3.0, demo))
    position, velocity, forcing, kernels, weights = figure.axes
    path = made.rollout(np.linspace(0.0, 2.0, 500))
    for panel, values in ((position, path.y), (velocity, path.yd), (forcing, path.forcing)):
        np.testing.assert_array_equal([line.get_ydata() for line in panel.lines[:2]], values.T)
    np.testing.assert_allclose(position.lines[2].get_xydata(), np.column_stack([T, demo[:, 0]]), atol=1e-12)
    np.testing.assert_allclose(velocity.lines[3].get_ydata(), -0.25)
    assert len(kernels.lines) == 12
    np.testing.assert_array_equal([line.get_ydata() for line in weights.lines], made.weights.T)
    assert weights.get_xlabel() == "t [s]"
    assert all(panel.get_ylabel().endswith("]") for panel in figure.axes)
    plt.close(figure)


def test_weights_stand_where_their_kernels_are() -> None:
    figure = plot_dmp(primitive())
    kernels, weights = figure.axes[3:]
    line = kernels.lines[5]
    at = np.asarray(line.get_xdata())[np.argmax(line.get_ydata())]
    assert np.asarray(weights.lines[0].get_xdata())[5] == pytest.approx(at, abs=0.1)
    plt.close(figure)


def test_phase_plane_leads_from_start_to_goal(tmp_path: Path) -> None:
    panel = dmp_phase(primitive())
    path = primitive().rollout(np.linspace(0.0, 3.0, 500))
    np.testing.assert_array_equal(panel.lines[0].get_xydata(), np.column_stack([path.y[:, 0], path.yd[:, 0]]))
    np.testing.assert_array_equal(panel.lines[5].get_xydata(), [[-0.5, 0.0]])
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("position [rad]", "velocity [rad/s]")
    panel.figure.savefig(tmp_path / "phase.png")  # pyright: ignore[reportAttributeAccessIssue]
    plt.close("all")


def test_two_dof_shows_arm_path_and_what_happened() -> None:
    done = run()
    figure = two_dof(done)
    position, error, slower = figure.axes
    curves = [line.get_ydata() for line in position.lines[:6]]
    wanted = [values[:, i] for i in range(2) for values in (done.ya, done.yc, done.free.y)]
    np.testing.assert_array_equal(curves, wanted)
    np.testing.assert_array_equal([line.get_ydata() for line in error.lines[:2]], done.e.T)
    np.testing.assert_allclose(slower.lines[0].get_ydata(), done.tau_a / primitive().tau_d)
    for panel in figure.axes:
        (span,) = panel.patches
        assert (span.get_x(), span.get_x() + span.get_width()) == (0.5, pytest.approx(0.8))  # pyright: ignore
        assert list(panel.lines[-1].get_xdata()) == [1.2, 1.2]
    plt.close(figure)


def test_chosen_coordinates_in_given_axes() -> None:
    _, axes = plt.subplots(3, 1)
    figure = two_dof(run(), [1], ax=axes)
    assert figure is axes[0].figure
    assert [line.get_label() for line in axes[0].lines[:3]] == ["arm y2", "path y2", "undisturbed y2"]
    plt.close(figure)


def test_bad_input_gets_a_sentence() -> None:
    for misuse in (
        lambda: plot_dmp(primitive(), (T, np.zeros((101, 3)))),
        lambda: plot_dmp(primitive(), (T[::-1], np.zeros((101, 2)))),
        lambda: two_dof(run(), [2]),
        lambda: two_dof(run(), ax=plt.figure().add_subplot()),
        lambda: dmp_phase(primitive(), ax=plt.subplots(2)[1]),
    ):
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse()
    plt.close("all")
