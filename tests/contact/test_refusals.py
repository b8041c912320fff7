"""Invalid inputs of the package, each with its error and words that the message must contain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.contact import Estimator, compare, hypotheses
from armlab.contact.estimator import check_distance, contact_point
from armlab.errors import ConfigError, ModelMismatchError, NotExcited, ShapeError, UnknownName
from armlab.log import Table
from armlab.robots.robot import arm_length

YUMI, UR5E = robots.load("yumi_left"), robots.load("ur5e")
ZERO = np.zeros((500, 7))
ERRORS = Table(0.004 * np.arange(500), {"q": ZERO, "qd": ZERO, "tau_error": ZERO, "tau_variance": ZERO + 1.0})
N = 5000
COMPARED = Table(
    0.004 * np.arange(N),
    {"wrench_hat": np.zeros((N, 6)), "wrench_hat_cov": np.tile(np.eye(6), (N, 1, 1)), "wrench_true": np.zeros((N, 6))},
)
LOST = np.full((N, 6), np.nan)


def estimator(method: str = "map", **options: Any) -> Callable[[SimpleNamespace], Any]:
    return lambda s: Estimator(s.model, YUMI, method, **options)


def degrees(log: Table) -> Table:
    return log.with_column("q", np.rad2deg(log["q"])).with_column("qd", np.rad2deg(log["qd"]))


CASES: list[tuple[type[Exception], str, Callable[[SimpleNamespace], Any]]] = [
    (ModelMismatchError, "yumi_left.*yumi_right", lambda s: Estimator(s.model, robots.load("yumi_right"))),
    (ShapeError, "six positive", estimator(prior=np.zeros(6))),
    (UnknownName, "interval", estimator("best")),
    *((ShapeError, "three finite", estimator(point=point)) for point in ([0.0, np.nan, 0.1], (0.0, 0.0))),
    *((ShapeError, r"\.$", estimator(**{option: other}))
      for option in ("prior", "point") for other in ("here", [[1, 2], [3]], np.full(6, np.nan), [1.0])),
    (ShapeError, "120 m away", estimator(point=(0.0, 0.0, 120.0))),
    (ShapeError, r"within \S+ m of the tool.*'ur5e', got a point 120 m away.*millimetres by 1000",
     lambda s: check_distance(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 120.0]]), UR5E)),
    (ShapeError, "to which the model belongs", lambda s: Estimator(s.model, YUMI).run(
        Table(s.log.t, {name: s.log[name][:, :6] for name in ("q", "qd", "tau")}))),
    (ShapeError, "degrees", lambda s: Estimator(s.model, YUMI).run(degrees(s.log))),
    (NotExcited, "Expected measured torques",
     lambda s: Estimator(s.model, YUMI).run(s.log.with_column("tau", 0 * s.log["tau"]))),
    (ConfigError, "force_rate, bias with method='kf' only, got method='map'", estimator(force_rate="fast", bias=True)),
    (ConfigError, "gain with method='observer' only", estimator("kf", gain=10.0)),
    (UnknownName, "fast, normal, smooth", estimator("kf", force_rate="quick")),
    *((ShapeError, "six positive rates", estimator("kf", force_rate=rate)) for rate in (5.0, [1, 1, 1, 1, 1, np.nan])),
    *((ShapeError, "leak", estimator("kf", leak=leak)) for leak in (-1.0, [0.1, 0.2], np.inf)),
    *((ShapeError, "gain", estimator("observer", gain=gain)) for gain in (0.0, np.nan, [1.0, 2.0])),
    (ModelMismatchError, "Repeat the identification", lambda s: Estimator(replace(s.model, momentum=None), YUMI, "kf")),
    *((ConfigError, "bias=True", lambda s, way=way: Estimator(s.model, YUMI, way).tare()) for way in ("map", "kf")),
    (NotExcited, "rest", lambda s: Estimator(s.model, YUMI, "kf", bias=True).tare()),
    (UnknownName, "tau_error", lambda s: hypotheses(ERRORS.without("tau_error", "tau_variance"), YUMI)),
    (ShapeError, "irb2400", lambda s: hypotheses(ERRORS, robots.load("irb2400"))),
    (ShapeError, "three finite", lambda s: hypotheses(ERRORS, YUMI, point=(0, 0))),
    (ShapeError, "120 m away", lambda s: hypotheses(ERRORS, YUMI, point=(0.0, 0.0, 120.0))),
    (ShapeError, "100 m away", lambda s: hypotheses(ERRORS, YUMI, segment=[(0.0, 0.0, 0.0), (100.0, 0.0, 0.0)])),
    (ShapeError, "two distinct points", lambda s: hypotheses(ERRORS, YUMI, segment=[[0, 0, 0.1]])),
    (ShapeError, "six positive", lambda s: hypotheses(ERRORS, YUMI, prior=np.zeros(6))),
    (ShapeError, "memory", lambda s: hypotheses(ERRORS, YUMI, memory=0.0)),
    (ShapeError, "at least one window", lambda s: hypotheses(ERRORS, YUMI, window=100.0)),
    (ShapeError, "missing", lambda s: hypotheses(ERRORS.with_column("tau_error", ZERO + np.nan), YUMI)),
    (UnknownName, "wrench_true or wrench", lambda s: compare(COMPARED.without("wrench_true"))),
    (UnknownName, "wrench_hat_cov", lambda s: compare(COMPARED.without("wrench_hat_cov"))),
    (UnknownName, "got none among 5000 rows", lambda s: compare(COMPARED.with_column("wrench_true", LOST))),
]  # fmt: skip


@pytest.mark.parametrize(("error", "words", "call"), CASES)
def test_refused(error: type[Exception], words: str, call: Callable[[SimpleNamespace], Any], model, excited) -> None:
    with pytest.raises(error, match=words):
        call(SimpleNamespace(model=model, log=excited.between(0.0, 4.0)))


def test_a_tool_as_long_as_the_arm_and_options_that_fit_are_accepted(model) -> None:
    given = np.array([0.0, 0.0, 0.12])
    point = contact_point(given, UR5E)
    np.testing.assert_array_equal(point, given)
    assert not np.shares_memory(point, given)
    check_distance(np.array([[0.0, 0.0, 0.999 * arm_length(UR5E)], [0.1, 0.0, 0.0]]), UR5E)
    check_distance(np.zeros((0, 3)), UR5E)
    assert Estimator(model, YUMI, "kf", force_rate=np.ones(6), leak=0.0).method == "kf"
