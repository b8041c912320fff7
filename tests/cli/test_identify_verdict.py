"""The verdict of a model: what is good, what is not, what to log next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.cli.identify.report import Trial, judge, try_out
from armlab.estimation import Fit
from armlab.log import Table
from armlab.models import TorqueModel


@pytest.fixture(scope="module")
def trial(fitted: Fit[TorqueModel], excited: Table, truth) -> Trial:
    return try_out(fitted.value, truth.robot, excited, unseen=False)


def changed(fitted: Fit[TorqueModel], **quality: np.ndarray) -> Fit[TorqueModel]:
    return replace(fitted, value=replace(fitted.value, quality=replace(fitted.value.quality, **quality)))


def test_a_good_model_is_called_good(fitted: Fit[TorqueModel], trial: Trial, excited: Table, truth) -> None:
    verdict = judge(fitted, truth.robot, [excited], trial)
    assert any("leaves" in sentence for sentence in verdict.good)
    assert any("condition" in sentence for sentence in verdict.good)
    assert any("Without contact" in sentence for sentence in verdict.good)
    assert verdict.ahead


def test_a_trial_is_the_estimate_of_no_force(trial: Trial, excited: Table) -> None:
    assert len(trial.estimate) == len(trial.log) == len(excited)
    assert not trial.estimate["wrench_true"].any()
    assert trial.share.shape == (7,)
    assert np.all(trial.share < 0.1)
    assert np.all(trial.force_rms < 1.5)
    assert 0.9 < trial.coverage < 1.0


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda q: {"rms_cv": 0.4 * q.torque_sd}, "up to 40 %"),
        (lambda q: {"rms_cv": 3 * q.rms}, "much worse in motion that the model has not seen"),
        (lambda q: {"coverage": np.where(np.arange(7) == 2, 0.7, 0.95)}, "joint 3: 70 %"),
    ],
)
def test_what_is_bad_is_said(fitted, trial, excited: Table, truth, change, sentence: str) -> None:
    worse = changed(fitted, **change(fitted.value.quality))
    assert any(sentence in said for said in judge(worse, truth.robot, [excited], trial).bad)


def test_the_test_log_is_compared_with_held_out_blocks(fitted, trial: Trial, excited: Table, truth) -> None:
    known = fitted.value.quality.rms_cv / fitted.value.quality.torque_sd
    alike = replace(trial, unseen=True, share=known)
    assert any("as in held-out blocks" in said for said in judge(fitted, truth.robot, [excited], alike).good)
    worse = replace(trial, unseen=True, share=4 * known)
    assert any("worse in the test log" in said for said in judge(fitted, truth.robot, [excited], worse).bad)
    dishonest = replace(trial, coverage=0.5)
    assert any("50 % inside 2 sigma" in said for said in judge(fitted, truth.robot, [excited], dishonest).bad)


def test_stretched_negative_and_narrow_are_said(fitted, trial: Trial, excited: Table, truth) -> None:
    model = fitted.value
    friction = replace(model.friction, viscous=np.where(np.arange(7) == 1, -0.1, model.friction.viscous))
    covariance = replace(model.covariance, alpha2=16.0)
    momentum = replace(model.momentum, alpha2_kf=25.0)
    training = replace(model.training, q_max=model.training.q_min + 0.2)
    bent = replace(
        fitted, value=replace(model, friction=friction, covariance=covariance, momentum=momentum, training=training)
    )
    verdict = judge(bent, truth.robot, [excited.where(np.abs(excited["qd"]).min(axis=1) > 0.02)], trial)
    assert any("stretched 4.0 times" in said for said in verdict.bad)
    assert any("momentum methods' covariance had to be stretched 5.0 times" in said for said in verdict.bad)
    assert any("joint 2: negative friction" in said for said in verdict.bad)
    assert any("moved over less than 25 %" in said for said in verdict.ahead)
