"""`plots.friction`: the curve of the model, its band, and the points of a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import contact
from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.log import Table
from armlab.models import FrictionMap, RadialBasis, TorqueModel
from armlab.plots.drives import friction, friction_map, own_parameters, spectrum


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
    """A map that is +1 N m at one end of the range of joint 3, and 0 at the other."""
    low, high = model.training.q_min, model.training.q_max
    positions = np.linspace(low, high, 4).T
    speeds = np.linspace(0.2, 1.0, 3)[None] * model.training.qd_peak[:, None]
    widths = (
        np.repeat(np.diff(positions, axis=1)[:, :1], 4, axis=1),
        np.repeat(np.diff(speeds, axis=1)[:, :1], 3, axis=1),
    )
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
    assert ax.get_xlabel() == "cycles per joint turn"
    assert ax.get_ylabel() == "amplitude [N m]"
    assert ax.child_axes[0].get_xlabel() == "cycles per motor turn"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["without", "with", "line of the model"]


def test_joints_that_are_not_there_are_refused(model: TorqueModel, excited: Table) -> None:
    with pytest.raises(ShapeError, match="from 0 to 2"):
        friction_map(model, 7)
    with pytest.raises(ShapeError, match="from 0 to 2"):
        spectrum(model, excited, joints=[-1])
