"""A log that leaves the training data is told so: position, speed, rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.identify import Extrapolation, design_excitation, extrapolation, predict
from armlab.identify.validation import training
from armlab.log import Table


def test_the_training_log_itself_needs_no_warning(model, excited) -> None:
    found = extrapolation(model, excited)
    assert isinstance(found, Extrapolation)
    assert found.warnings == ()
    np.testing.assert_array_equal(found.outside, 0.0)
    assert np.all(found.unseen_speed < 0.02)
    assert found.rest_share == pytest.approx(model.training.rest_share, abs=0.01)
    assert "in training" in found.text()


def test_rest_that_training_did_not_have(model, excited) -> None:
    """Half the log stands still: a model of motion knows friction there only within bounds."""
    half = len(excited) // 2
    q, qd = excited["q"].copy(), excited["qd"].copy()
    q[half:], qd[half:] = q[half], 0.0
    found = extrapolation(model, Table(excited.t, {"q": q, "qd": qd}))
    assert len(found.warnings) == 1
    assert "got 5" in found.warnings[0]
    assert "rest" in found.warnings[0]
    assert found.rest_share == pytest.approx(0.5, abs=0.05)
    assert found.longest_rest == pytest.approx(15.0, abs=0.2)
    assert "warning: Expected as little rest" in found.text()


def test_positions_and_speeds_outside_training_are_named(model, truth) -> None:
    wide = truth.log(design_excitation(truth.robot, seconds=20, seed=9, speed=1.0, acceleration=40.0), seed=2)
    found = extrapolation(model, wide)
    text = " ".join(found.warnings)
    assert "at speeds that were not trained" in text
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


def test_bad_logs_are_refused(model, excited) -> None:
    with pytest.raises(ShapeError, match="7 joints in at least two rows"):
        extrapolation(model, Table(excited.t, {"q": excited["q"][:, :6], "qd": excited["qd"][:, :6]}))
    q = excited["q"].copy()
    q[5, 2] = np.nan
    with pytest.raises(ShapeError, match=r"1 rows, first \[5\]"):
        extrapolation(model, excited.with_column("q", q))
    with pytest.raises(ShapeError, match="share of rest"):
        replace(model.training, rest_share=2.0)
    few = Table(excited.t[:50], {"q": excited["q"][:50]})
    with pytest.raises(ShapeError, match="100 rows without a gap"):
        extrapolation(model, few)
    with pytest.raises(ShapeError, match="at least two rows"):
        extrapolation(model, few.rows(slice(0, 1)))
