"""`plots.residual_speed`, `plots.autocorrelation`: what a torque model leaves."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.estimation import correlation_time
from armlab.log import Table
from armlab.models import velocity_covariance
from armlab.plots.model import autocorrelation, residual_speed

N = 3000


@pytest.fixture
def table() -> Table:
    rng = np.random.default_rng(1)
    error = rng.normal(size=(N, 3))
    for k in range(1, N):
        error[k, 1] = 0.9 * error[k - 1, 1] + np.sqrt(0.19) * error[k, 1]
    error[:5] = np.nan
    qd = np.stack([np.linspace(-v, v, N) for v in (0.5, 1.0, 2.0)], axis=1)
    return Table(np.arange(N) * 0.004, {"qd": qd}).with_column("tau_error", error, unit="N m")


def test_points_are_measured_minus_model_and_curves_two_sigma(table: Table) -> None:
    one, two = np.ones(3), np.full(3, 0.25)
    models = {
        "exponential": velocity_covariance("exp", one, two, np.array([10.0, 20.0, 30.0])),
        "step": velocity_covariance("step", one, two, np.full(3, 0.1)),
    }
    figure = residual_speed(table, models)
    assert len(figure.axes) == 3
    for i, ax in enumerate(figure.axes):
        points, _, *curves = ax.lines
        assert np.array_equal(points.get_xdata(), table["qd"][:, i])
        assert np.array_equal(points.get_ydata(), -table["tau_error"][:, i], equal_nan=True)
        assert len(curves) == 4
        for k, covariance in enumerate(models.values()):
            qd, upper = (np.asarray(x) for x in curves[2 * k].get_data())
            assert (qd[0], qd[-1]) == pytest.approx((table["qd"][0, i], table["qd"][-1, i]))
            expected = 2 * np.sqrt(covariance.variance(np.repeat(qd[:, None], 3, axis=1))[:, i])
            assert upper == pytest.approx(expected)
            assert np.asarray(curves[2 * k + 1].get_ydata()) == pytest.approx(-expected)
        assert ax.get_title(loc="left") == f"joint {i + 1}"
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("qd [rad/s]", "residual [N m]")
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["residual", "± 2 sigma, exponential", "± 2 sigma, step"]


def test_one_joint_in_axes_of_the_caller(table: Table) -> None:
    ax = plt.figure().add_subplot()
    assert residual_speed(table, joints=[2], ax=ax) is ax.figure
    assert ax.get_title(loc="left") == "joint 3"
    with pytest.raises(ShapeError, match="from 0 to 2"):
        residual_speed(table, joints=[3])
    with pytest.raises(ShapeError, match="Expected 3 Axes"):
        residual_speed(table, ax=ax)
    with pytest.raises(UnknownName, match="tau_error"):
        residual_speed(table.without("tau_error"))


def test_the_autocorrelation_is_that_of_the_residual(table: Table) -> None:
    ax = autocorrelation(table, joints=[0, 1])
    white, coloured = (np.asarray(line.get_ydata()) for line in ax.lines)
    lag = np.asarray(ax.lines[1].get_xdata())
    assert (lag[0], white[0], coloured[0]) == (0.0, 1.0, 1.0)
    x = table["tau_error"][5:, 1]
    x = x - x.mean()
    assert coloured[3] == pytest.approx(np.mean(x[3:] * x[:-3]) / np.mean(x * x))
    assert np.mean(np.abs(white[1:]) < 2 / np.sqrt(N)) > 0.9
    seconds = correlation_time(x, 0.004)
    assert ax.lines[1].get_label() == f"joint 2: {1e3 * seconds:.0f} ms"
    assert ax.get_xlabel() == "lag [s]"


def test_missing_rows_leave_the_lag_as_it_is(table: Table) -> None:
    error = table["tau_error"].copy()
    error[7::10] = np.nan
    ax = autocorrelation(table.with_column("tau_error", error, unit="N m"), joints=[1])
    x = error[5:, 1] - np.nanmean(error[5:, 1])
    expected = np.nanmean(x[4:] * x[:-4]) / np.nanmean(x * x)
    assert np.asarray(ax.lines[0].get_ydata())[4] == pytest.approx(expected)


def test_too_few_rows_cannot_be_correlated(table: Table) -> None:
    with pytest.raises(ShapeError, match="at least 10 rows"):
        autocorrelation(table.rows(slice(0, 12)))
