"""Figures of movement primitives hold what the primitives say, with units, and refuse what does not fit."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.motion import Dmp
from armlab.plots import dmp as plot_dmp
from armlab.plots import dmp_phase
from armlab.plots.motion import TAUGHT, demonstration

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


@pytest.mark.parametrize("schedule", ["canonical", "time", "position"])
def test_dmp_shows_demonstration_and_rollout(schedule: str) -> None:
    made, demo = primitive(schedule), np.outer(T, [0.5, -0.25])
    figure = plot_dmp(made, (T + 3.0, demo))
    position, velocity, forcing, kernels, weights = figure.axes
    path = made.rollout(np.linspace(0.0, 2.0, 501))
    for panel, values in ((position, path.y), (velocity, path.yd), (forcing, path.forcing)):
        np.testing.assert_array_equal([line.get_ydata() for line in panel.lines[:2]], values.T)
    np.testing.assert_allclose(position.lines[2].get_xydata(), np.column_stack([T, demo[:, 0]]), atol=1e-12)
    np.testing.assert_allclose(velocity.lines[3].get_ydata(), -0.25)
    assert position.lines[2].get_linewidth() == TAUGHT["linewidth"]
    assert len(kernels.lines) == 12 + (2 if schedule == "position" else 1)
    np.testing.assert_array_equal(kernels.lines[12].get_ydata(), path.x if path.x.ndim == 1 else path.x[:, 0])
    np.testing.assert_array_equal([line.get_ydata() for line in weights.lines], made.weights.T)
    assert weights.get_xlabel() == label("t") == "t [s]"
    labels = [panel.get_ylabel() for panel in figure.axes]
    assert labels == [label("y"), label("yd"), label("forcing"), "kernels, x [1]", label("weights")]
    assert all(name.endswith("m/s]" if "yd" in name else "]") for name in labels)
    plt.close(figure)


def test_goals_that_change_are_drawn_and_reached() -> None:
    made = primitive()
    figure = plot_dmp(made, goals=[(1.0, [0.5, 0.5]), (0.5, [2.0, -1.0])])
    position, _, forcing = figure.axes[:3]
    steps = position.lines[1]
    np.testing.assert_allclose(steps.get_xydata(), [[0.0, 1.0], [0.504, 2.0], [1.002, 0.5], [3.0, 0.5]], atol=1e-9)
    assert position.lines[0].get_ydata()[-1] == pytest.approx(0.5, abs=0.02)  # pyright: ignore
    free = made.rollout(np.linspace(0.0, 3.0, 501))
    before = free.t < 0.5
    for panel, values in ((position, free.y), (forcing, free.forcing)):
        drawn = np.asarray(panel.lines[0].get_ydata())
        np.testing.assert_allclose(drawn[before], values[before, 0], rtol=0, atol=1e-9)
    assert "goal" in position.get_legend_handles_labels()[1]
    plt.close(figure)


def test_demonstrations_begin_at_zero() -> None:
    t, y = demonstration((T + 3.0, np.zeros((101, 2))), 2)
    assert (t[0], y.shape) == (0.0, (101, 2))


def test_weights_stand_where_their_kernels_are() -> None:
    figure = plot_dmp(primitive())
    kernels, weights = figure.axes[3:]
    line = kernels.lines[5]
    at = np.asarray(line.get_xdata())[np.argmax(line.get_ydata())]
    assert np.asarray(weights.lines[0].get_xdata())[5] == pytest.approx(at, abs=0.1)
    plt.close(figure)


def test_phase_plane_leads_from_start_to_goal(tmp_path: Path) -> None:
    panel = dmp_phase(primitive())
    path = primitive().rollout(np.linspace(0.0, 3.0, 501))
    np.testing.assert_array_equal(panel.lines[0].get_xydata(), np.column_stack([path.y[:, 0], path.yd[:, 0]]))
    np.testing.assert_array_equal(panel.lines[5].get_xydata(), [[-0.5, 0.0]])
    assert (panel.get_xlabel(), panel.get_ylabel()) == (label("y"), label("yd"))
    panel.figure.savefig(tmp_path / "phase.png")  # pyright: ignore[reportAttributeAccessIssue]
    plt.close("all")


def test_bad_input_gets_a_sentence() -> None:
    for misuse in (
        lambda: plot_dmp(primitive(), (T, np.zeros((101, 3)))),
        lambda: plot_dmp(primitive(), (T[::-1], np.zeros((101, 2)))),
        lambda: plot_dmp(primitive(), goals=[(0.5, [1.0])]),
        lambda: dmp_phase(primitive(), ax=plt.subplots(2)[1]),
    ):
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse()
    plt.close("all")
