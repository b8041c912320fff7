"""Figures of torque models and of calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import calibrate, contact, identify, sim
from armlab.errors import ShapeError, UnknownName
from armlab.estimation import Excitation, Fit
from armlab.estimation.robust import correlation_time
from armlab.log import Column, Table
from armlab.models import FrictionMap, RadialBasis, TorqueModel, velocity_covariance
from armlab.plots import model as covariances
from armlab.plots.calibration_quality import calibration
from armlab.plots.drives import friction, friction_map, own_parameters, spectrum
from armlab.plots.model import autocorrelation, excitation, residual_speed, torque_fit


def test_each_joint_has_its_numbers(fitted: Fit[TorqueModel], excited: Table) -> None:
    labels = {"tau": Column(labels=("a", "b", "c"))}
    figure = torque_fit(fitted, Table(excited.t, {name: excited[name] for name in excited.names}, labels))
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
        assert left.get_title(loc="left") == "abc"[i]
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


def test_the_autocorrelation_is_that_of_the_residual(table: Table) -> None:
    ax = autocorrelation(table, joints=[0, 1])
    white, coloured = (np.asarray(line.get_ydata()) for line in ax.lines)
    lag = np.asarray(ax.lines[1].get_xdata())
    assert (lag[0], white[0], coloured[0]) == (0.0, 1.0, 1.0)
    x = table["tau_error"][5:, 1]
    x = x - x.mean()
    assert coloured[3] == pytest.approx(np.mean(x[3:] * x[:-3]) / np.mean(x * x))
    assert np.mean(np.abs(white[1:]) < 2 / np.sqrt(N)) > 0.9
    error = table["tau_error"].copy()
    error[7::10] = np.nan
    torn = autocorrelation(table.with_column("tau_error", error, unit="N m"), joints=[1])
    y = error[5:, 1] - np.nanmean(error[5:, 1])
    expected = np.nanmean(y[4:] * y[:-4]) / np.nanmean(y * y)
    assert np.asarray(torn.lines[0].get_ydata())[4] == pytest.approx(expected), "missing rows leave the lag as it is"
    seconds = correlation_time(x, 0.004)
    assert ax.lines[1].get_label() == f"joint 2: {1e3 * seconds:.0f} ms"
    assert ax.get_xlabel() == "lag [s]"


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


def test_curve_band_and_points(fitted: Fit[TorqueModel], excited: Table, truth) -> None:
    model = fitted.value
    estimate = contact.Estimator(model, truth.robot).run(excited)
    figure = friction(fitted, estimate)
    assert len(figure.axes) == 3
    for i, ax in enumerate(figure.axes):
        points, _, curve = ax.lines
        qd = np.asarray(curve.get_xdata())
        assert np.abs(qd).max() == pytest.approx(model.training.qd_peak[i])
        grid = np.repeat(qd[:, None], 3, axis=1)
        torque = model.friction.torque(grid, np.sign(grid))[:, i]
        assert np.asarray(curve.get_ydata()) == pytest.approx(torque)
        every = max(1, len(excited) // 3000)
        moving = estimate["qd"][::every]
        shown = model.friction.torque(moving, np.sign(moving))[:, i] - estimate["tau_error"][::every, i]
        assert np.asarray(points.get_ydata()) == pytest.approx(shown)
        dark, light = (area.get_paths()[0].vertices for area in ax.collections)
        assert np.ptp(light[:, 1]) > np.ptp(dark[:, 1])
        assert dark[:, 1].max() > torque.max()
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("qd [rad/s]", "friction [N m]")


def test_the_dark_band_is_the_covariance_of_the_parameters(fitted: Fit[TorqueModel]) -> None:
    """At the largest speed: viscous, Coulomb and offset of joint 3 move together."""
    ax = friction(fitted).axes[2]
    curve = np.asarray(ax.lines[0].get_ydata())
    vertices = ax.collections[0].get_paths()[0].vertices
    peak = fitted.value.training.qd_peak[2]
    top = vertices[np.isclose(vertices[:, 0], peak), 1].max()
    bump = np.exp(-((peak / fitted.value.friction.stribeck_speed[2]) ** 2))
    slopes = {"viscous": peak, "coulomb": 1.0, "coulomb+": 1.0, "coulomb-": 0.0, "offset": 1.0, "stribeck": bump}
    slopes["root"] = np.sqrt(peak)
    g = np.zeros(len(fitted.names))
    for kind, place in own_parameters(fitted)[2].items():
        g[place] = slopes.get(kind, 0.0)
    assert top - curve[-1] == pytest.approx(2 * np.sqrt(g @ fitted.cov @ g), rel=1e-6)


JOINT, CYCLES, SIZE = 2, 200.0, 0.15


@pytest.fixture
def mapped(model: TorqueModel) -> TorqueModel:
    low, high = model.training.q_min, model.training.q_max
    positions = np.linspace(low, high, 4).T
    speeds = np.linspace(0.2, 1.0, 3)[None] * model.training.qd_peak[:, None]
    widths = [np.repeat(np.diff(x, axis=1)[:, :1], x.shape[1], axis=1) for x in (positions, speeds)]
    k = np.zeros((3, 2, 4, 3))
    k[JOINT, 0] = np.linspace(1, 0, 4)[:, None]
    return replace(model, friction_map=FrictionMap(RadialBasis(positions, widths[0], speeds, widths[1]), k))


def test_the_map_is_friction_over_position_and_velocity(
    mapped: TorqueModel, model: TorqueModel, excited: Table
) -> None:
    figure = friction_map(mapped, JOINT, excited)
    left, right, bar = figure.axes
    torque = left.collections[0].get_array().reshape(60, 61)
    plain = friction_map(model, JOINT).axes[0].collections[0].get_array().reshape(60, 61)
    added = np.asarray(torque - plain)
    assert added[45:, 0] == pytest.approx(1.0, abs=0.2)
    assert added[45:, -1] == pytest.approx(0.0, abs=0.2)
    assert np.abs(added[:30]).max() < 1e-12  # nothing in the other direction
    assert (left.get_xlabel(), left.get_ylabel()) == ("q [rad]", "qd [rad/s]")
    assert bar.get_ylabel() == "friction [N m]"
    qd = np.asarray(right.lines[0].get_xdata())
    assert (qd[0], qd[-1]) == pytest.approx((-model.training.qd_peak[JOINT], model.training.qd_peak[JOINT]))
    assert [line.get_label() for line in right.lines][1].startswith("q = ")
    assert np.asarray(right.lines[1].get_ydata()) == pytest.approx(np.asarray(torque)[:, 30], abs=1e-9)
    assert any(getattr(area, "hatches", None) == ["///"] for area in left.collections)
    assert left.get_title(loc="left") == "joint 3"


def test_the_spectrum_shows_ripple_without_and_with_the_model(model: TorqueModel, excited: Table) -> None:
    cosine = np.where(np.arange(3) == JOINT, SIZE, 0.0)
    ripple = replace(model.ripple, cycles=np.full(3, CYCLES), cosine=cosine, sine=np.zeros(3))
    tau = excited["tau"] - model.ripple.torque(excited["q"]) + ripple.torque(excited["q"])
    rippled = excited.with_column("tau", tau)
    figure = spectrum(replace(model, ripple=ripple), rippled, joints=[JOINT])
    (ax,) = figure.axes
    without, with_model, mark = ax.lines
    cycles = np.asarray(without.get_xdata())
    peak = int(np.nanargmax(without.get_ydata()))
    assert cycles[peak] == pytest.approx(CYCLES, abs=1.0)
    assert np.asarray(without.get_ydata())[peak] == pytest.approx(SIZE, rel=0.15)
    assert np.asarray(with_model.get_ydata())[peak] < 0.2 * SIZE
    assert np.asarray(mark.get_xdata())[0] == CYCLES
    assert ax.get_xlabel() == "cycles per joint revolution"
    assert ax.get_ylabel() == "amplitude [N m]"
    assert ax.child_axes[0].get_xlabel() == "cycles per motor revolution"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["without", "with", "model line"]


@pytest.fixture(scope="module")
def fit():
    return calibrate.fit_hand_eye(**sim.cell(1).hand_eye(wrong=2).given, robust=True)


@pytest.fixture(scope="module")
def drawn(fit):
    return calibration(fit, truth=fit.parameters + fit.sd)


def test_residuals_are_in_sigma_and_wrong_samples_are_crosses(fit, drawn) -> None:
    over = drawn.axes[0]
    good, bad, *_ = over.lines
    size = np.sqrt(np.mean(fit.residuals[:, :3] ** 2, axis=1)) / fit.sigma[0]
    assert np.array_equal(good.get_xdata(), np.arange(2, 30))
    assert np.asarray(good.get_ydata()) == pytest.approx(size[2:])
    assert np.asarray(bad.get_ydata()) == pytest.approx(size[:2])
    assert bad.get_marker() == "x"
    assert [text.get_text() for text in over.get_legend().get_texts()].count("excluded") == 1


def test_quantiles_are_near_the_line_and_ellipses_two_sigma_with_the_truth_a_cross(fit, drawn) -> None:
    _, normal, ellipses, _ = drawn.axes
    x, y = normal.lines[0].get_data()
    assert len(np.asarray(x)) == 3 * 28
    assert np.corrcoef(np.asarray(x), np.asarray(y))[0, 1] > 0.97
    outline, cross = ellipses.lines[:2]
    assert np.max(np.asarray(outline.get_xdata())) == pytest.approx(2 * fit.sd[0], rel=2e-3)
    assert np.asarray(cross.get_xdata()) == pytest.approx([fit.sd[0]])
    assert outline.get_label() == "T_tool_marker x and T_tool_marker y [m]"
    assert ellipses.xaxis.get_major_formatter()(2e-4) == "0.0002"
    labels = ("error of the first parameter", "error of the second parameter")
    assert (ellipses.get_xlabel(), ellipses.get_ylabel()) == labels


def test_every_calibration_can_be_drawn() -> None:
    made = sim.cell(1)
    arm, leds = made.kinematics(), made.marker_points()
    for fit in (
        calibrate.fit_force_sensor(**made.force().given),
        calibrate.fit_laser_plane(**made.laser().given),
        calibrate.fit_kinematics(arm.robot, arm.q, pose=arm.pose),
        calibrate.fit_hand_eye_points(**leds.given, visible=leds.visible),
    ):
        assert fit.excitation.weakest[:20] in calibration(fit).axes[3].get_title(loc="left").replace("\n", " ")


def test_samples_in_which_a_kind_was_not_measured_are_left_out_of_it() -> None:
    arm = sim.cell(1).distances()
    position = np.where(np.arange(120)[:, None] < 60, arm.pose[:, :3, 3], np.nan)
    visible = {"position": np.arange(120) < 60, "distance": np.arange(120) >= 60}
    fit = calibrate.fit_kinematics(arm.robot, arm.q, position=position, distance=arm.distance, anchor=arm.guess,
                                   visible=visible)  # fmt: skip
    points, lengths = calibration(fit).axes[0].lines
    assert np.array_equal(points.get_xdata(), np.arange(60))
    assert np.array_equal(lengths.get_xdata(), np.arange(60, 120))


def test_what_cannot_be_drawn_is_refused(fit, table: Table, model: TorqueModel, excited: Table) -> None:
    for misuse, error, words in (
        (lambda: calibration(fit, truth=np.zeros(3)), ShapeError, "12 true parameters"),
        (lambda: residual_speed(table, joints=[3]), ShapeError, "from 0 to 2"),
        (lambda: residual_speed(table.without("tau_error")), UnknownName, "tau_error"),
        (lambda: autocorrelation(table.rows(slice(0, 12))), ShapeError, "at least 10 rows"),
        (lambda: excitation(Excitation(0, 0, np.zeros(0), "none")), ShapeError, "singular values"),
        (lambda: excitation(Excitation(0, 2, np.zeros(2), "none")), ShapeError, "positive singular values"),
        (lambda: friction_map(model, 7), ShapeError, "from 0 to 2"),
        (lambda: spectrum(model, excited, joints=[-1]), ShapeError, "from 0 to 2"),
    ):
        with pytest.raises(error, match=words):
            misuse()
