"""`plots.calibration`: residuals in sigma, quantiles, ellipses, excitation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import calibrate, sim
from armlab.errors import ShapeError
from armlab.plots.calibration_quality import calibration


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
    assert [text.get_text() for text in over.get_legend().get_texts()].count("left out") == 1


def test_quantiles_of_normal_residuals_are_near_the_line(drawn) -> None:
    normal = drawn.axes[1]
    x, y = normal.lines[0].get_data()
    assert len(np.asarray(x)) == 3 * 28
    assert np.corrcoef(np.asarray(x), np.asarray(y))[0, 1] > 0.97


def test_ellipses_are_two_sigma_and_the_truth_is_a_cross(fit, drawn) -> None:
    ellipses = drawn.axes[2]
    outline, cross = ellipses.lines[:2]
    assert np.max(np.asarray(outline.get_xdata())) == pytest.approx(2 * fit.sd[0], rel=2e-3)
    assert np.asarray(cross.get_xdata()) == pytest.approx([fit.sd[0]])
    assert outline.get_label() == "T_tool_marker x and T_tool_marker y [m]"
    assert ellipses.xaxis.get_major_formatter()(2e-4) == "0.0002"
    assert (ellipses.get_xlabel(), ellipses.get_ylabel()) == ("first parameter, off by", "second parameter, off by")


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


def test_a_fit_from_a_file_has_ellipses_and_excitation(fit) -> None:
    ellipses, told = calibration(replace(fit, residuals=np.zeros(0))).axes
    assert ellipses.get_title(loc="left") == "two sigma, around what was found"
    assert told.get_ylabel() == "singular value, relative"


def test_what_cannot_be_drawn_is_refused(fit) -> None:
    with pytest.raises(ShapeError, match="12 true parameters"):
        calibration(fit, truth=np.zeros(3))
