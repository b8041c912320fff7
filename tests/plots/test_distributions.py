"""The figure of a distribution over motions: mean, band, demonstrations, and the points that it passes."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import ProMP, fit_promp
from armlab.plots import promp

T = np.linspace(0.0, 1.0, 101)
RNG = np.random.default_rng(0)
DEMOS = [(k * T, np.outer(T, [a, b]) + 1e-3 * RNG.normal(size=(101, 2))) for k, a, b in RNG.normal(2.0, 0.2, (5, 3))]


@pytest.fixture(scope="module")
def taught() -> ProMP:
    return fit_promp([t for t, _ in DEMOS], [y for _, y in DEMOS], n_basis=6).value


def test_mean_band_and_demonstrations_are_shown(taught: ProMP) -> None:
    figure = promp(taught, DEMOS)
    t = np.linspace(0.0, taught.duration, 301)
    motion = taught.marginal(t)
    for i, panel in enumerate(figure.axes):
        *demos, mean = [line for line in panel.lines if len(np.asarray(line.get_xdata()))]
        np.testing.assert_allclose(mean.get_xydata(), np.column_stack([t, motion.y[:, i]]), atol=1e-12)
        np.testing.assert_array_equal([demo.get_ydata() for demo in demos], [y[:, i] for _, y in DEMOS])
        assert all(demo.get_xdata()[-1] == pytest.approx(taught.duration) for demo in demos)  # pyright: ignore
        (band,) = panel.collections
        edges = band.get_paths()[0].vertices
        for wanted in (motion.y - 2 * motion.sd, motion.y + 2 * motion.sd):
            assert np.abs(edges[:, 1] - wanted[150, i])[np.isclose(edges[:, 0], t[150])].min() < 1e-9  # pyright: ignore
        assert panel.get_ylabel() == f"y{i + 1} [rad, m]"
    assert figure.axes[-1].get_xlabel() == "t [s]"
    plt.close(figure)


def test_points_samples_and_what_was_before_are_shown(taught: ProMP) -> None:
    point = taught.marginal([1.0]).y[0] + 0.1
    passing = taught.condition(1.0, point)
    figure = promp(passing, prior=taught, points=[(1.0, point)], samples=3, seed=1)
    panel = figure.axes[1]
    before, mean, *samples, mark = panel.lines
    t = np.linspace(0.0, taught.duration, 301)
    np.testing.assert_allclose(before.get_ydata(), taught.marginal(t).y[:, 1], atol=1e-12)
    np.testing.assert_allclose([one.get_ydata() for one in samples], passing.sample(t, 1, 3)[:, :, 1], atol=1e-12)
    assert list(np.ravel(mark.get_xydata())) == [1.0, point[1]]
    assert np.interp(1.0, *np.asarray(mean.get_xydata()).T) == pytest.approx(point[1], abs=1e-4)
    assert panel.get_legend_handles_labels()[1] == ["before", "mean", "± 2 sd", "samples", "points"]
    plt.close(figure)


def test_bad_input_gets_a_sentence(taught: ProMP) -> None:
    for misuse in (
        lambda: promp(taught, [(T, np.zeros((101, 3)))]),
        lambda: promp(taught, points=[(0.5, [1.0])]),
        lambda: promp(taught, ax=plt.subplots(3)[1]),
    ):
        with pytest.raises(ShapeError, match=r"^Expected .*\.$"):
            misuse()
    plt.close("all")
