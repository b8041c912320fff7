"""`plots.friction`: the curve of the model, its band, and the points of a log."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import contact
from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.plots.drives import friction, own_parameters


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


def test_both_bands_are_in_the_legend(fitted: Fit[TorqueModel]) -> None:
    names = [text.get_text() for text in friction(fitted).legends[0].get_texts()]
    assert names == ["± 2 sigma of the parameters", "with the torque error", "model"]


def test_as_many_axes_as_joints(fitted: Fit[TorqueModel]) -> None:
    import matplotlib.pyplot as plt

    axes = plt.figure().subplots(1, 3)
    assert friction(fitted, ax=axes) is axes[0].figure
    with pytest.raises(ShapeError, match="Expected 3 Axes"):
        friction(fitted, ax=axes[:2])


def test_the_parameters_of_each_joint_are_found_by_kind(fitted: Fit[TorqueModel], truth) -> None:
    found = own_parameters(fitted)
    assert len(found) == 3
    for own, joint in zip(found, truth.robot.joint_names, strict=True):
        assert fitted.names[own["viscous"]] == f"viscous {joint}"
        assert {"viscous", "offset"} < own.keys()
        assert {"coulomb"} < own.keys() or {"coulomb+", "coulomb-"} < own.keys()
