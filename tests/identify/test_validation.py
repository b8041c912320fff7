"""Held-out residuals, reports, and logs outside the training data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.identify import design_excitation, dither, extrapolation, predict, prepare
from armlab.identify.prediction import Extrapolation
from armlab.identify.validation import FIFTHS, _covariance, _share, assess, assess_again, held_out, training
from armlab.log import Table


def test_held_out_residuals_cover_the_log_and_assess_calibrates(truth, excited, model) -> None:
    data = prepare(excited, truth.robot)
    rows = np.arange(len(data.t)) % 2 == 0
    model = replace(model, parameters=None)  # all variance comes from the covariance
    folds = [(model, rows), (model, ~rows)]
    errors, moving = held_out(folds, data)
    assert np.isfinite(errors).all()
    assert moving.shape == errors.shape
    assert np.all(moving.mean(axis=0) > 0.9), "a joint counts while it moves, whatever the others do"
    judged = assess(model, folds, data)
    ratio = (errors**2 / judged.covariance.variance(data.qd))[moving]
    assert abs(np.mean(ratio < 4.0) - 0.954) < 1e-3  # alpha is set to make it so
    # coverage in the report is judged on the half to which neither covariance nor scale was fitted
    np.testing.assert_allclose(judged.quality.coverage, 0.954, atol=0.03)
    assert np.mean(judged.quality.coverage) != pytest.approx(np.mean(ratio < 4.0), abs=1e-9)
    # these folds saw every row: in-sample and held-out figures are of one kind and therefore equal
    np.testing.assert_allclose(judged.quality.rms, judged.quality.rms_cv, rtol=1e-12)


def test_both_parts_of_the_covariance_together_cover_the_errors() -> None:
    """Joint 0: parameters matter in a tenth of the rows, where the ratio of the powers would cover 97 %."""
    rng = np.random.default_rng(0)
    qd, moving = rng.uniform(-1.0, 1.0, (8000, 2)), np.ones((8000, 2), dtype=bool)
    beyond = np.zeros((8000, 2))
    beyond[:800, 0] = 9.0
    errors = rng.normal(size=(8000, 2)) * np.sqrt(1.0 + beyond)
    ratio = _share(errors, beyond, qd, moving)
    assert ratio[0] > 0.1
    assert ratio[1] == 0.0
    variance = _covariance(errors / np.sqrt(1.0 + ratio), qd, moving).variance(qd) + beyond
    np.testing.assert_allclose(np.mean(errors**2 < 4.0 * variance, axis=0), 0.954, atol=0.008)


@pytest.mark.slow  # 5 s
def test_a_model_with_parts_is_judged_with_what_its_base_lost_on_the_same_log(truth, excited, model) -> None:
    """On its own log, the base model has seen all folds, so its loss is added. On another log, residuals include it."""
    data = prepare(excited.between(0.0, 10.0), truth.robot)
    model = replace(model, sources=data.sources)
    q, folds = model.quality, [model] * FIFTHS
    same = assess_again(model, model, folds, data)
    np.testing.assert_allclose(same.quality.rms, q.rms, rtol=0.2)
    np.testing.assert_allclose(same.quality.rms_cv**2, same.quality.rms**2 + q.rms_cv**2 - q.rms**2, rtol=1e-9)
    np.testing.assert_allclose(same.quality.coverage, 0.954, atol=0.04)
    assert same.sources == model.sources
    other = assess_again(replace(model, sources=("another log",)), model, folds, data)
    # each fold runs from half a second before its rows, after which the filter's initial state no longer matters
    np.testing.assert_allclose(other.quality.rms_cv, other.quality.rms, rtol=1e-9)
    assert other.sources == ("another log", *data.sources)
    assert np.all(other.covariance.variance(0.3 * np.ones(7)) < same.covariance.variance(0.3 * np.ones(7)))
    # parts that are wrong on fifths they have not seen widen the covariance
    friction = replace(model.friction, offset=model.friction.offset + np.where(np.arange(7) == 2, 1.0, 0.0))
    worse = assess_again(model, model, [replace(model, friction=friction), *folds[1:]], data)
    assert worse.quality.rms_cv[2] > 3.0 * same.quality.rms_cv[2]
    assert worse.covariance.Cinf[2] > 4.0 * same.covariance.Cinf[2]
    np.testing.assert_allclose(worse.quality.rms, same.quality.rms, rtol=1e-12)


def test_predict_gives_model_torque_whose_band_holds_the_measured_one(truth, excited, model) -> None:
    table = predict(model, excited)
    error = table["tau"] - table["tau_model"]
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.04 * np.std(table["tau"], axis=0))
    assert np.all(np.mean(np.abs(error) < 2 * table["tau_sigma"], axis=0) > 0.85)
    assert table["tau_model"].shape == table["tau_sigma"].shape == excited["tau"].shape


def test_a_prediction_does_not_reach_across_a_gap(truth, excited, model) -> None:
    """Samples are missing: rows a second away from the gap do not change; a short segment has no prediction."""
    whole, kept = predict(model, excited), np.r_[0:2000, 2500:2550, 3000:7500]
    holed = predict(model, excited.rows(kept))
    assert np.isnan(holed["tau_model"][2000:2050]).all()
    assert np.isnan(holed["tau"][2000:2050]).all()
    for name in ("tau", "tau_model"):
        assert np.isfinite(holed[name][[0, 1999, 2050, -1]]).all()
        for rows in (slice(0, 1750), slice(2300, None)):
            np.testing.assert_allclose(holed[name][rows], whole[name][kept][rows], atol=0.01)
    with pytest.raises(ShapeError, match="at least 100 samples without a gap"):
        predict(model, excited.rows(slice(0, 1)))


def test_a_joint_that_never_slides_is_refused_by_name(truth, excited, model) -> None:
    """With presliding over a revolution, friction is never known, so errors in motion cannot be judged."""
    delta = np.where(np.arange(7) == 3, 6.0, model.friction.delta)
    stuck = replace(model, friction=replace(model.friction, delta=delta))
    data = prepare(excited, truth.robot)
    with pytest.raises(NotExcited, match=r"slide.*joint 4 \(0 rows\).*further") as caught:
        assess(stuck, [(stuck, np.ones(len(data.t), dtype=bool))], data)
    assert caught.value.directions == ("joint 4",)


def test_the_band_of_a_prediction_is_wide_where_the_arm_rested(truth, model) -> None:
    """Before the first motion static friction is unknown: the band covers it; in motion the band is narrow."""
    table = predict(model, truth.log(dither(truth.robot.q_home, 8.0), seed=3))
    assert np.all(table["tau_sigma"][0] > 0.9 * model.friction.static)
    assert np.all(np.median(table["tau_sigma"][500:1500], axis=0) < 0.2 * model.friction.static)


# Training domain.


def test_the_training_log_itself_needs_no_warning(model, excited) -> None:
    found = extrapolation(model, excited)
    assert isinstance(found, Extrapolation)
    assert found.warnings == ()
    np.testing.assert_array_equal(found.outside, 0.0)
    assert np.all(found.unseen_speed < 0.02)
    assert found.rest_share == pytest.approx(model.training.rest_share, abs=0.01)
    assert "in training" in found.text()


def test_rest_that_training_did_not_have(model, excited) -> None:
    """The arm rests in half of the log, where a model of motion gives friction only within bounds."""
    half = len(excited) // 2
    q, qd = excited["q"].copy(), excited["qd"].copy()
    q[half:], qd[half:] = q[half], 0.0
    found = extrapolation(model, Table(excited.t, {"q": q, "qd": qd}))
    assert len(found.warnings) == 1
    assert "got 5" in found.warnings[0]
    assert "rest" in found.warnings[0]
    assert found.rest_share == pytest.approx(0.5, abs=0.05)
    assert found.longest_rest == pytest.approx(15.0, abs=0.2)
    assert "warning: Expected as little standstill" in found.text()


def test_positions_and_speeds_outside_training_are_named(model, truth) -> None:
    wide = truth.log(design_excitation(truth.robot, seconds=10, seed=9, speed=1.0, acceleration=40.0), seed=2)
    found = extrapolation(model, wide)
    text = " ".join(found.warnings)
    assert "at untrained speeds" in text
    moved = Table(wide.t, {"q": wide["q"] + np.array([9.0, 0, 0, 0, 0, 0, 0]), "qd": wide["qd"]})
    named = extrapolation(model, moved).warnings[0]
    assert "outside the trained positions: joint 1 (100 %)" in named or "joint_1 (100 %)" in named


def test_a_prediction_carries_the_warnings(model, excited) -> None:
    assert not any("rest" in note for note in predict(model, excited).notes)
    shifted = excited.with_column("q", excited["q"] + 2.0)
    assert any("trained positions" in note for note in predict(model, shifted).notes)


def test_training_counts_bins_and_rest() -> None:
    t = np.arange(1000) * 0.01
    qd = np.zeros((1000, 2))
    qd[:500, 0] = 1.0
    qd[500:800] = -0.02
    found = training(t, np.cumsum(qd, axis=0), qd, ((0, 1000),))
    np.testing.assert_allclose(found.qd_peak, [1.0, 0.02])
    np.testing.assert_allclose(found.speed_share.sum(axis=1), 1.0)
    np.testing.assert_allclose(found.speed_share[0, [0, 1, 10]], [0.2, 0.3, 0.5])
    assert found.rest_share == pytest.approx(0.2)
    assert found.longest_rest == pytest.approx(1.99)
    cut = training(t, np.cumsum(qd, axis=0), qd, ((0, 900), (900, 1000)))
    assert cut.longest_rest == pytest.approx(0.99)
