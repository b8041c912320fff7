"""`plots.wrench`: estimate, band, truth, contact."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab._display import AXIS_COLORS
from armlab.contact import contacts
from armlab.contact.contacts import Hypotheses
from armlab.errors import ShapeError, UnknownName
from armlab.log import Column, Table
from armlab.plots import hypotheses
from armlab.plots.contact import coverage, coverage_by_speed, observability, wrench, wrenches

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
    axes = plt.figure().subplots(3, 1)
    wrench(estimate, ax=axes)
    assert axes[0].get_legend() is not None, "the figure of the caller has no room of its own"
    assert [ax.get_ylabel() for ax in axes] == ["f_x [N]", "f_y [N]", "f_z [N]"]
    cov = estimate["wrench_hat_cov"].copy()
    cov[800:] *= 1e4
    wide = wrench(estimate.with_column("wrench_hat_cov", cov))
    assert wide.axes[0].get_ylim()[1] < 10.0, "a wide band does not hide the forces"
    for draw, column in ((wrench, "wrench_hat"), (coverage, "qd"), (observability, "observability")):
        with pytest.raises(UnknownName, match=column):
            draw(estimate.select("wrench_true"))
    with pytest.raises(UnknownName, match="wrench_true or wrench"):
        coverage(estimate.without("wrench_true").with_column("qd", np.ones((N, 2))))


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


def test_probabilities_stack_to_one_and_doubt_is_marked() -> None:
    posterior = np.array([[0.99, 0.01, 0.0], [0.2, 0.795, 0.005], [0.0, 1.0, 0.0]])
    decision = ("none", "undecided", "point")
    found = Hypotheses(
        np.arange(3.0), ("none", "point", "wrench"), np.log(posterior + 1e-9), posterior, decision,
        np.array([False, True, False]), np.full(3, np.nan), np.ones(3),
    )  # fmt: skip
    ax = hypotheses(found)
    labels = ax.get_legend_handles_labels()[1]
    assert labels == ["none", "point", "others", "possibly on a link"]
    top = max(path.get_extents().y1 for area in ax.collections for path in area.get_paths())
    assert np.isclose(top, 1.0)
    assert np.isfinite(np.asarray(ax.lines[0].get_ydata())).tolist() == [False, True, False]


N_COVERED = 4000


@pytest.fixture
def estimate_of_one_sigma() -> Table:
    """Errors of one sigma; the stated sigma is half as large below a tenth of the peak speed."""
    rng = np.random.default_rng(1)
    t = np.arange(N_COVERED) * 0.004
    qd = np.stack([np.linspace(0, 1, N_COVERED), np.linspace(0, 2, N_COVERED)], axis=1)
    stated = np.where(np.linspace(0, 1, N_COVERED) < 0.1, 0.5, 1.0)
    cov = stated[:, None, None] ** 2 * np.eye(6)
    hat = rng.normal(size=(N_COVERED, 6))
    seen = np.full((N_COVERED, 6), 0.95)
    seen[1000:2000, 4] = 0.3
    values = {"qd": qd, "wrench_hat": hat, "wrench_hat_cov": cov, "wrench_true": 0.0 * hat, "observability": seen}
    return Table(t, values)


def test_shares_are_those_of_each_bin_of_speed(estimate_of_one_sigma: Table) -> None:
    names, shares = coverage_by_speed(estimate_of_one_sigma)
    assert names == ("f_x", "f_y", "f_z", "m_x", "m_y", "m_z")
    speed = np.linspace(0, 1, N_COVERED)
    assert np.isnan(shares[:, 0]).all()  # 40 samples are too few to say anything
    for k, (a, b) in enumerate([(0.01, 0.03), (0.03, 0.1), (0.1, 0.3), (0.3, 1.01)], start=1):
        rows = (speed >= a) & (speed < b)
        limit = 1.0 if k < 3 else 2.0
        expected = np.mean(np.abs(estimate_of_one_sigma["wrench_hat"][rows]) <= limit, axis=0)
        assert shares[:, k] == pytest.approx(expected)
    assert shares[:, 3:].min() > 0.92
    assert shares[:, 2].max() < 0.8
    ax = coverage(estimate_of_one_sigma)
    *drawn, nominal = ax.lines
    assert tuple(line.get_label() for line in drawn) == names
    for line, share in zip(drawn, shares, strict=True):
        assert np.asarray(line.get_ydata()) == pytest.approx(100 * share, nan_ok=True)
    assert np.asarray(nominal.get_ydata())[0] == 95.4
    assert ax.get_xticklabels()[1].get_text() == "1 to 3 %"
    assert ax.get_ylim()[0] < 100 * np.nanmin(shares)


def test_torques_are_judged_joint_by_joint_over_their_own_speed(estimate_of_one_sigma: Table) -> None:
    table = Table(
        estimate_of_one_sigma.t,
        {"qd": estimate_of_one_sigma["qd"], "tau": estimate_of_one_sigma["wrench_hat"][:, :2]},
        {"tau": Column(labels=("a", "b"))},
    )
    table = table.with_column("tau_model", np.zeros((N_COVERED, 2)), unit="N m")
    names, shares = coverage_by_speed(table.with_column("tau_sigma", np.full((N_COVERED, 2), 1.0), unit="N m"))
    assert names == ("a", "b")
    assert shares[:, 4] == pytest.approx(0.954, abs=0.02)


def test_observability_over_time_with_the_weak_stretch_shaded(estimate_of_one_sigma: Table, spans) -> None:
    force, moment = observability(estimate_of_one_sigma).axes
    for row, panel in enumerate((force, moment)):
        for i, line in enumerate(panel.lines[:3]):
            assert np.array_equal(line.get_ydata(), estimate_of_one_sigma["observability"][:, 3 * row + i])
    assert not spans(force)
    assert spans(moment) == [pytest.approx((4.0, 8.0))]
    assert moment.get_xlabel() == "t [s]"
    assert (force.get_ylabel(), moment.get_ylabel()) == ("force", "moment")
