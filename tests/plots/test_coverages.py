"""`plots.coverage`, `plots.observability`: is the uncertainty true, and what could be seen."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.log import Column, Table
from armlab.plots.contact import coverage, coverage_by_speed, observability

N = 4000


@pytest.fixture
def estimate() -> Table:
    """Errors of one sigma; the stated sigma is half of it below a tenth of the peak speed."""
    rng = np.random.default_rng(1)
    t = np.arange(N) * 0.004
    qd = np.stack([np.linspace(0, 1, N), np.linspace(0, 2, N)], axis=1)
    stated = np.where(np.linspace(0, 1, N) < 0.1, 0.5, 1.0)
    cov = stated[:, None, None] ** 2 * np.eye(6)
    hat = rng.normal(size=(N, 6))
    seen = np.full((N, 6), 0.95)
    seen[1000:2000, 4] = 0.3
    values = {
        "qd": qd,
        "wrench_hat": hat,
        "wrench_hat_cov": cov,
        "wrench_true": np.zeros((N, 6)),
        "observability": seen,
    }
    return Table(t, values)


def test_shares_are_those_of_each_bin_of_speed(estimate: Table) -> None:
    names, shares = coverage_by_speed(estimate)
    assert names == ("f_x", "f_y", "f_z", "m_x", "m_y", "m_z")
    speed = np.linspace(0, 1, N)
    assert np.isnan(shares[:, 0]).all()  # 40 samples are too few to say anything
    for k, (a, b) in enumerate([(0.01, 0.03), (0.03, 0.1), (0.1, 0.3), (0.3, 1.01)], start=1):
        rows = (speed >= a) & (speed < b)
        limit = 1.0 if k < 3 else 2.0
        expected = np.mean(np.abs(estimate["wrench_hat"][rows]) <= limit, axis=0)
        assert shares[:, k] == pytest.approx(expected)
    assert shares[:, 3:].min() > 0.92
    assert shares[:, 2].max() < 0.8


def test_the_figure_shows_them_in_percent_beside_the_nominal_value(estimate: Table) -> None:
    _, shares = coverage_by_speed(estimate)
    ax = coverage(estimate)
    *drawn, nominal = ax.lines
    assert [line.get_label() for line in drawn] == ["f_x", "f_y", "f_z", "m_x", "m_y", "m_z"]
    for line, share in zip(drawn, shares, strict=True):
        assert np.asarray(line.get_ydata()) == pytest.approx(100 * share, nan_ok=True)
    assert np.asarray(nominal.get_ydata())[0] == 95.4
    assert ax.get_ylabel() == "inside 2 sigma [%]"
    assert ax.get_xticklabels()[1].get_text() == "1 to 3 %"
    assert ax.get_ylim()[0] < 100 * np.nanmin(shares)


def test_torques_are_judged_joint_by_joint_over_their_own_speed(estimate: Table) -> None:
    table = Table(
        estimate.t, {"qd": estimate["qd"], "tau": estimate["wrench_hat"][:, :2]}, {"tau": Column(labels=("a", "b"))}
    )
    table = table.with_column("tau_model", np.zeros((N, 2)), unit="N m")
    names, shares = coverage_by_speed(table.with_column("tau_sigma", np.full((N, 2), 1.0), unit="N m"))
    assert names == ("a", "b")
    assert shares[:, 4] == pytest.approx(0.954, abs=0.02)


def test_what_is_missing_is_named(estimate: Table) -> None:
    with pytest.raises(UnknownName, match="wrench_true or wrench"):
        coverage(estimate.without("wrench_true"))
    with pytest.raises(UnknownName, match="qd"):
        coverage(estimate.without("qd"))
    with pytest.raises(UnknownName, match="observability"):
        observability(estimate.without("observability"))
    with pytest.raises(ShapeError, match="Expected 2 Axes"):
        observability(estimate, ax=coverage(estimate))


def test_observability_over_time_with_the_weak_stretch_shaded(estimate: Table, spans) -> None:
    force, moment = observability(estimate).axes
    for row, panel in enumerate((force, moment)):
        for i, line in enumerate(panel.lines[:3]):
            assert np.array_equal(line.get_ydata(), estimate["observability"][:, 3 * row + i])
    assert not spans(force)
    assert spans(moment) == [pytest.approx((4.0, 8.0))]
    assert moment.get_xlabel() == "t [s]"
    assert (force.get_ylabel(), moment.get_ylabel()) == ("force", "moment")
