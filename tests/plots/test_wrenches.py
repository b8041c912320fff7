"""`plots.wrench`: estimate, band, truth, contact."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab._palette import AXIS_COLORS
from armlab.contact import contacts
from armlab.errors import ShapeError, UnknownName
from armlab.log import Table
from armlab.plots.contact import wrench, wrenches

N = 1000


@pytest.fixture
def estimate() -> Table:
    rng = np.random.default_rng(1)
    t = np.arange(N) * 0.004
    true = np.zeros((N, 6))
    true[(t > 1) & (t < 2), 2] = 5.0
    sigma = np.array([0.5, 0.5, 0.5, 0.05, 0.05, 0.05])
    hat = true + 0.3 * sigma * rng.normal(size=(N, 6))
    hat[:10] = np.nan
    cov = np.broadcast_to(np.diag(sigma**2), (N, 6, 6)).copy()
    return Table(t, {"wrench_hat": hat, "wrench_hat_cov": cov, "wrench_true": true})


def test_six_panels_with_band_truth_and_contact(estimate: Table, spans) -> None:
    figure = wrench(estimate)
    assert len(figure.axes) == 6
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels == ["f_x [N]", "m_x [N m]", "f_y [N]", "m_y [N m]", "f_z [N]", "m_z [N m]"]
    (contact,) = contacts(estimate)
    for place, ax in enumerate(figure.axes):
        i = place // 2 + 3 * (place % 2)
        estimated, true = ax.lines
        assert np.array_equal(estimated.get_ydata(), estimate["wrench_hat"][:, i], equal_nan=True)
        assert estimated.get_color() == AXIS_COLORS[i % 3]
        assert np.array_equal(true.get_ydata(), estimate["wrench_true"][:, i])
        assert true.get_linestyle() == "--"
        assert spans(ax) == [pytest.approx((contact.start, contact.end), abs=0.0041)]
        (filled,) = [part for part in ax.collections if part.get_gid() != "shade"]
        edges = np.concatenate([path.vertices[:, 1] for path in filled.get_paths()])
        sigma = np.sqrt(estimate["wrench_hat_cov"][0, i, i])
        assert edges.max() == pytest.approx(np.nanmax(estimate["wrench_hat"][:, i]) + 2 * sigma)
        assert ax.get_ylim()[1] > np.nanmax(np.abs(estimate["wrench_hat"][:, i]))
    assert figure.axes[0].get_ylim() == figure.axes[4].get_ylim() != figure.axes[1].get_ylim()
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["contact", "± 2 sigma", "estimate", "true"]


def test_without_covariance_and_truth(estimate: Table) -> None:
    figure = wrench(estimate.select("wrench_hat").with_column("wrench", np.ones((N, 6))))
    ax = figure.axes[0]
    assert [line.get_label() for line in ax.lines] == ["sensor", "estimate"]
    assert not ax.collections


def test_forces_alone_in_three_given_axes(estimate: Table) -> None:
    axes = plt.figure().subplots(3, 1)
    wrench(estimate, ax=axes)
    assert [ax.get_ylabel() for ax in axes] == ["f_x [N]", "f_y [N]", "f_z [N]"]
    with pytest.raises(ShapeError, match="Expected 6 Axes"):
        wrench(estimate, ax=axes[0])
    with pytest.raises(UnknownName, match="wrench_hat"):
        wrench(estimate.select("wrench_true"))


def test_a_wide_band_does_not_hide_the_forces(estimate: Table) -> None:
    cov = estimate["wrench_hat_cov"].copy()
    cov[800:] *= 1e4
    figure = wrench(estimate.with_column("wrench_hat_cov", cov))
    assert figure.axes[0].get_ylim()[1] < 10.0


def test_guaranteed_limits_are_drawn_where_there_are_any(estimate: Table) -> None:
    limits = np.stack([estimate["wrench_hat"] - 3.0, estimate["wrench_hat"] + 3.0], axis=2)
    figure = wrench(estimate.with_column("wrench_interval", limits))
    for place, ax in enumerate(figure.axes):
        i = place // 2 + 3 * (place % 2)
        low, high, *_ = ax.lines
        assert np.array_equal(low.get_ydata(), limits[:, i, 0], equal_nan=True)
        assert np.array_equal(high.get_ydata(), limits[:, i, 1], equal_nan=True)
    assert "limits" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_arms_side_by_side_on_one_scale(estimate: Table) -> None:
    large = estimate.with_column("wrench_hat", 3.0 * estimate["wrench_hat"])
    figure = wrenches({"left arm": estimate, "right arm": large})
    axes = np.array(figure.axes).reshape(3, 2)
    assert [ax.get_title(loc="left") for ax in axes[0]] == ["left arm", "right arm"]
    for i in range(3):
        for ax, table in zip(axes[i], (estimate, large), strict=True):
            assert np.array_equal(ax.lines[0].get_ydata(), table["wrench_hat"][:, i], equal_nan=True)
            assert ax.get_ylabel() == f"f_{'xyz'[i]} [N]"
    assert len({ax.get_ylim() for ax in axes.ravel()}) == 1
    assert len(figure.legends) == 1
    assert axes[2, 0].get_xlabel() == "t [s]"
    with pytest.raises(ShapeError, match="at least one arm"):
        wrenches({})
    with pytest.raises(ShapeError, match="Expected 6 Axes"):
        wrenches({"a": estimate, "b": estimate}, ax=axes[0])
