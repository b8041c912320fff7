"""Something else in place of a log, a model, a robot, a motion or a number: one sentence, never another error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab import identify, robots
from armlab.contact import Estimator, compare, contacts, hypotheses
from armlab.errors import ArmlabError, ModelMismatchError, RobotError, ShapeError
from armlab.estimation import Fit
from armlab.models import TorqueModel

OTHERS = (None, "arm.mcap", -1, float("nan"), [[1, 2], [3]], np.full(7, np.nan))
YUMI = robots.load("yumi_left")
MOTION = identify.dither(YUMI.q_home, 1.0)

NO_NUMBER: dict[str, Callable] = {
    "seconds": lambda x: identify.design_excitation(YUMI, seconds=x),
    "f0": lambda x: identify.design_excitation(YUMI, f0=x),
    "harmonics": lambda x: identify.design_excitation(YUMI, harmonics=x),
    "speed": lambda x: identify.design_excitation(YUMI, speed=x),
    "acceleration": lambda x: identify.design_excitation(YUMI, acceleration=x),
    "rounds": lambda x: identify.design_excitation(YUMI, rounds=x),
    "seed": lambda x: identify.design_excitation(YUMI, seed=x),
    "length of a dither": lambda x: identify.dither(YUMI.q_home, x),
    "frequency": lambda x: identify.dither(YUMI.q_home, 1.0, frequency=x),
    "pose": lambda x: identify.dither(x, 1.0),
    "noise": lambda x: identify.predicted_uncertainty(MOTION, YUMI, x),
    "walk": lambda x: identify.sequence([MOTION], x),
    "parts": identify.sequence,
    "q": lambda x: identify.rbf_centres(x, np.zeros((5, 2))),
    "residuals": lambda x: identify.fit_velocity_covariance(x, np.zeros((200, 7))),
    "A": lambda x: identify.group_lasso(x, np.zeros(5), 2, 1.0),
    "inertial parameters": identify.pseudo_inertia,
}


@pytest.mark.parametrize("other", OTHERS, ids=repr)
@pytest.mark.parametrize("what", NO_NUMBER)
def test_what_is_no_number_gets_a_sentence(what: str, other: Any) -> None:
    with pytest.raises(ArmlabError, match=r"^Expected .*\.$"):
        NO_NUMBER[what](other)


@pytest.mark.parametrize("other", OTHERS, ids=repr)
def test_what_is_no_log_no_model_no_robot_no_motion(other: Any, model: TorqueModel) -> None:
    for function in (
        lambda: identify.with_velocity(other),
        lambda: identify.prepare(other, YUMI),
        lambda: identify.extrapolation(model, other),
        lambda: identify.predict(model, other),
        lambda: Estimator(model, YUMI).run(other),
        lambda: contacts(other),
        lambda: compare(other),
        lambda: hypotheses(other, YUMI),
        lambda: identify.predicted_uncertainty(other, YUMI),
    ):
        with pytest.raises(ShapeError):
            function()
    table = MOTION.table()
    for function in (
        lambda: identify.extrapolation(other, table),
        lambda: identify.predict(other, table),
        lambda: identify.fit_friction(table, other),
        lambda: identify.fit_payload(table, other, YUMI),
        lambda: Estimator(other, YUMI),
        lambda: identify.physically_consistent(other, YUMI),
    ):
        with pytest.raises(ModelMismatchError):
            function()
    for function in (
        lambda: Estimator(model, other),
        lambda: identify.predicted_uncertainty(MOTION, other),
        lambda: identify.friction_run(other, 0),
        lambda: identify.fit_payload(table, model, other),
    ):
        with pytest.raises(RobotError, match="Expected a Robot"):
            function()


def test_a_prior_that_is_no_fit(fitted: Fit[TorqueModel]) -> None:
    value: Any = fitted.value
    with pytest.raises(ModelMismatchError, match="earlier fit"):
        identify.fit_dynamics(MOTION.table(), YUMI, prior=value)


@pytest.mark.parametrize("option", ["prior", "point"])
def test_a_prior_or_a_point_of_the_contact_that_is_none(option: str, model: TorqueModel) -> None:
    others: tuple[Any, ...] = ("here", [[1, 2], [3]], np.full(6, np.nan), [1.0])
    for other in others:
        with pytest.raises(ShapeError, match=r"\.$"):
            Estimator(model, YUMI, **{option: other})
