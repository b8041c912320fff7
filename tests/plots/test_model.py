"""`plots.torque_fit`: measured, modelled, residual and band of each joint."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from armlab import identify
from armlab.errors import ShapeError, UnknownName
from armlab.estimation import Excitation, Fit, correlation_time
from armlab.log import Column, Table
from armlab.models import TorqueModel, velocity_covariance
from armlab.plots import model as covariances
from armlab.plots.model import autocorrelation, excitation, residual_speed, torque_fit


def test_each_joint_has_its_numbers(fitted: Fit[TorqueModel], excited: Table) -> None:
    figure = torque_fit(fitted, excited)
    predicted = identify.predict(fitted.value, excited)
    assert len(figure.axes) == 6
    for i in range(3):
        left, right = figure.axes[2 * i], figure.axes[2 * i + 1]
        tau, model, sigma = (predicted[name][:, i] for name in ("tau", "tau_model", "tau_sigma"))
        assert np.array_equal(left.lines[0].get_ydata(), tau, equal_nan=True)
        assert np.array_equal(left.lines[1].get_ydata(), model, equal_nan=True)
        assert np.array_equal(left.lines[0].get_xdata(), excited.t)
        assert np.array_equal(right.lines[0].get_ydata(), tau - model, equal_nan=True)
        edges = np.concatenate([path.vertices[:, 1] for path in right.collections[0].get_paths()])
        assert (edges.min(), edges.max()) == pytest.approx((-2 * np.nanmax(sigma), 2 * np.nanmax(sigma)))
        assert left.get_title(loc="left") == f"joint {i + 1}"
        known = np.isfinite(tau - model) & np.isfinite(sigma)
        explained = 1 - np.var((tau - model)[known]) / np.var(tau[known])
        inside = np.mean(np.abs(tau - model)[known] < 2 * sigma[known])
        title = right.get_title(loc="left")
        assert title.startswith(f"{100 * explained:.2f} % explained")
        assert f"{100 * inside:.0f} % in band" in title
        assert (left.get_ylabel(), right.get_ylabel()) == ("tau [N m]", "residual [N m]")
    assert figure.axes[-1].get_xlabel() == "t [s]"
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["measured", "model", "± 2 sigma", "measured - model"]


def test_joints_have_the_names_of_the_log(model: TorqueModel, excited: Table) -> None:
    values = {name: excited[name] for name in excited.names}
    named = Table(excited.t, values, {"tau": Column(labels=("a", "b", "c"))})
    assert [ax.get_title(loc="left") for ax in torque_fit(model, named).axes[::2]] == ["a", "b", "c"]


def test_a_piece_too_short_to_filter_is_a_gap(model: TorqueModel, excited: Table) -> None:
    t = excited.t.copy()
    t[1000:] += 1.0
    t[1050:] += 1.0
    late = Table(t, {name: excited[name] for name in excited.names})
    line = torque_fit(model, late).axes[0].lines[1]
    assert np.isnan(np.asarray(line.get_ydata())[1000:1050]).all()
    assert np.isfinite(np.asarray(line.get_ydata())[:1000]).all()


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


def test_lines_are_the_square_root_of_the_variance() -> None:
    model = velocity_covariance("exp", np.array([4.0, 1.0]), np.array([1.0, 0.25]), np.array([10.0, 20.0]), alpha2=2.0)
    ax = covariances.velocity_covariance(model, qd_max=0.5)
    assert ax.get_xlabel() == "qd [rad/s]"
    assert ax.get_ylabel() == "sigma of the torque error [N m]"
    for i, line in enumerate(ax.lines):
        qd = np.asarray(line.get_xdata())
        assert (qd[0], qd[-1]) == (-0.5, 0.5)
        expected = np.sqrt(model.variance(np.repeat(qd[:, None], 2, axis=1))[:, i])
        assert np.asarray(line.get_ydata()) == pytest.approx(expected)
        assert line.get_label() == f"joint {i + 1}"
    assert len(ax.lines) == 2


NAMES = ("mass", "offset", "gain")


def test_the_points_are_the_singular_values_relative_to_the_strongest() -> None:
    rng = np.random.default_rng(1)
    found = Excitation.of(rng.normal(size=(50, 3)) @ np.array([[1, 0, 0.999], [0, 1, 0], [0, 0, 0.05]]), NAMES)
    ax = excitation(found)
    points, weak, refused = ax.lines
    assert np.array_equal(points.get_xdata(), [1, 2, 3])
    assert np.asarray(points.get_ydata()) == pytest.approx(found.singular_values / found.singular_values[0])
    assert np.asarray(weak.get_ydata())[0] == pytest.approx(1 / 300)
    assert np.asarray(refused.get_ydata())[0] == pytest.approx(1e-4)
    assert ax.get_yscale() == "log"
    assert ax.get_xlabel() == "direction"
    assert [text.get_text() for text in ax.texts] == ["weak below", "refused below"]
    assert found.weakest in ax.get_title(loc="left")


def test_without_values_it_is_refused() -> None:
    with pytest.raises(ShapeError, match="singular values"):
        excitation(Excitation(0, 0, np.zeros(0), "none"))
    with pytest.raises(ShapeError, match="above zero"):
        excitation(Excitation(0, 2, np.zeros(2), "none"))
