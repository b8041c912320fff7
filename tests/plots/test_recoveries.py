"""The figure of a primitive that waits for its arm holds what happened, when, and with units."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.glossary import label
from armlab.motion import Displace, Hold, TwoDofDmp, TwoDofRun, fit_dmp
from armlab.plots import two_dof

T = np.linspace(0.0, 2.0, 101)


def run() -> TwoDofRun:
    y = np.outer(1.0 - np.cos(np.pi * T / 2), [0.5, -0.25])
    return TwoDofDmp(fit_dmp(T, y, n_basis=8).value).simulate(0.01, [Hold(0.5, 0.8), Displace(1.2, 0.1)])


def test_two_dof_shows_arm_path_and_what_happened() -> None:
    done = run()
    figure = two_dof(done)
    position, error, slower = figure.axes
    curves = [line.get_ydata() for line in position.lines[:6]]
    wanted = [values[:, i] for i in range(2) for values in (done.free.y, done.yc, done.ya)]
    np.testing.assert_array_equal(curves, wanted)
    np.testing.assert_array_equal([line.get_ydata() for line in error.lines[:2]], done.e.T)
    np.testing.assert_allclose(slower.lines[0].get_ydata(), done.tau_a / (2 / 3))
    for panel in figure.axes:
        (span,) = panel.patches
        assert (span.get_x(), span.get_x() + span.get_width()) == (0.5, pytest.approx(0.8))  # pyright: ignore
        assert list(panel.lines[-1].get_xdata()) == [1.2, 1.2]
    plt.close(figure)


def test_chosen_coordinates_in_given_axes() -> None:
    _, axes = plt.subplots(3, 1)
    figure = two_dof(run(), [1], ax=axes)
    assert figure is axes[0].figure
    assert axes[0].get_legend_handles_labels()[1] == ["y2", "arm ya", "path yc", "undisturbed", "disturbed"]
    assert [line.get_linestyle() for line in axes[0].lines[:3]] == [":", "--", "-"]
    assert [panel.get_ylabel() for panel in axes] == [label("y"), label("e"), "times slower [1]"]
    plt.close(figure)


def test_bad_input_gets_a_sentence() -> None:
    for misuse in (lambda: two_dof(run(), [2]), lambda: two_dof(run(), ax=plt.figure().add_subplot())):
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse()
    plt.close("all")
