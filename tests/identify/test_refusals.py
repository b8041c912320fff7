"""Refusals of the package: an input, its error, and words that the sentence must have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import dynamics, identify, robots
from armlab.contact import Estimator, compare, contacts, hypotheses
from armlab.errors import ConfigError, MissingExtra, ModelMismatchError, NotExcited, RobotError, ShapeError, UnknownName
from armlab.estimation import Fit
from armlab.identify import excite, record
from armlab.identify.drives.friction import rbf_centres, rbf_regressor
from armlab.identify.drives.ripple import ripple_lines
from armlab.identify.many import fit_draft, fit_sums, log_sums
from armlab.identify.payload import LoadRecord
from armlab.log import Table

YUMI = robots.load("yumi_left")
MOTION = identify.dither(YUMI.q_home, 1.0)
NAN = np.full(7, np.nan)
Q, QD = np.random.default_rng(0).standard_normal((2, 400, 2))
NOISE = np.random.default_rng(1).standard_normal((400, 2))


def changed(table: Table, change: Callable[[np.ndarray], np.ndarray | None] | float, *names: str) -> Table:
    """The log with some columns multiplied by a number, or changed by a function on a copy."""
    for name in names:
        values = np.array(table[name])
        new = change * values if isinstance(change, float) else change(values)
        table = table.with_column(name, values if new is None else new)
    return table


def put(row: Any, column: Any, value: float) -> Callable[[np.ndarray], None]:
    """Set some elements of an array."""

    def change(values: np.ndarray) -> None:
        values[row, column] = value

    return change


def rested(s: SimpleNamespace) -> Table:
    """The log with the fourth joint at rest."""
    return changed(changed(s.log, put(slice(None), 3, 0.1), "q"), put(slice(None), 3, 0.0), "qd")


def without_joint(table: Table) -> Table:
    return Table(table.t, {name: table[name][:, :6] for name in ("q", "qd", "tau")})


DEGREES = 180.0 / np.pi
HOME = np.tile(YUMI.q_home, (2500, 1))
POSE = Table(
    np.arange(2500) * 0.004, {"q": HOME, "qd": 0 * HOME, "tau": np.random.default_rng(0).normal(size=HOME.shape)}
)
OPTIONS: dict[str, Callable[..., Any]] = {
    "design": lambda **options: identify.design_excitation(YUMI, **options),
    "dither": lambda **options: identify.dither(**{"centre": [0.0], "seconds": 2.0, **options}),
}
RECORD: list[tuple[type[Exception], str, Callable[[SimpleNamespace], Any]]] = [
    (ShapeError, "at least one log", lambda s: identify.prepare([], YUMI)),
    (NotExcited, YUMI.joint_names[3], lambda s: identify.prepare(rested(s), YUMI)),
    (NotExcited, f"constant values for {YUMI.joint_names[5]}",
     lambda s: identify.prepare(changed(s.log, put(slice(None), 5, 1.0), "tau"), YUMI)),
    (NotExcited, "at least 5 s", lambda s: identify.prepare(s.log.between(0.0, 3.0), YUMI)),
    (ShapeError, "without a gap.*55 samples",
     lambda s: identify.prepare(s.log.rows(np.arange(len(s.log)) % 60 >= 5), YUMI)),
    (ShapeError, "250 Hz, 125 Hz", lambda s: identify.prepare([s.log, s.log.rows(slice(None, None, 2))], YUMI)),
    (ShapeError, r"2 rows, first \[7, 9\]",
     lambda s: identify.prepare(changed(s.log, put([7, 9], 0, np.nan), "tau"), YUMI)),
    (ShapeError, "derivative of q", lambda s: identify.prepare(changed(s.log, -1.0, "qd"), YUMI)),
    (ShapeError, "57.3 times", lambda s: identify.prepare(changed(s.log, DEGREES, "qd"), YUMI)),
    (ShapeError, "Pass the robot that was recorded", lambda s: identify.prepare(without_joint(s.log), YUMI)),
    (ShapeError, r"Expected a Table.*log\.read", lambda s: identify.prepare("log.csv", YUMI)),
    (ShapeError, "Expected a Table", lambda s: identify.prepare(s.log["q"], YUMI)),
    (RobotError, r"robots\.load\('yumi_left'\)", lambda s: identify.prepare(s.log, "yumi_left")),
    (UnknownName, "joint numbers from 0 to 6", lambda s: identify.prepare(s.log, YUMI, joints=[0.5])),
    (ShapeError, "at least 40 Hz, got 10 Hz", lambda s: identify.prepare(s.log.rows(slice(None, None, 25)), YUMI)),
    (ShapeError, r"got 0\.25 Hz.*milliseconds",
     lambda s: identify.prepare(Table(1000 * s.log.t, dict(s.log.values)), YUMI)),
    (ShapeError, r"copy of it\.mcap repeats the rows of log 1\.",
     lambda s: identify.prepare([s.log, replace(s.log, source=("copy of it.mcap sha256 0123",))], YUMI)),
    (ShapeError, r"c repeats the rows of b\.", lambda s: record.check_once([("a", "1"), ("b", "2"), ("c", "2")])),
    (ShapeError, "Table", lambda s: identify.with_velocity(None)),
]  # fmt: skip
MOTIONS: list[tuple[type[Exception], str, Callable[[SimpleNamespace], Any]]] = [
    (ShapeError, "speed fraction", lambda s: OPTIONS["design"](speed=1.5)),
    (RobotError, "Load the robot first", lambda s: identify.design_excitation("yumi_left")),
    (ShapeError, "at least 10 seconds", lambda s: OPTIONS["design"](seconds=np.nan)),
    *((ShapeError, "at least one harmonic", lambda s, wrong=wrong: OPTIONS["design"](**wrong))
      for wrong in ({"f0": 0.0}, {"harmonics": 2.5}, {"acceleration": -1.0}, {"rounds": -1})),
    *((ShapeError, "inside the limits", lambda s, centre=centre: OPTIONS["design"](centre=centre))
      for centre in (np.zeros(3), YUMI.q_max + 1.0, NAN)),
    (ShapeError, r"sigma of shape \(7,\) above 0", lambda s: OPTIONS["design"](sigma=np.zeros(7))),
    *((ShapeError, "finite joint positions", lambda s, wrong=wrong: OPTIONS["dither"](**wrong))
      for wrong in ({"centre": [np.nan]}, {"centre": 0.0}, {"amplitude": np.inf}, {"frequency": 0.0})),
    (ShapeError, "above 0 s", lambda s: OPTIONS["dither"](seconds=0.0)),
    (ShapeError, "at least one motion", lambda s: identify.sequence([])),
    (ShapeError, "a list of motions, got NoneType", lambda s: identify.sequence(None)),
    (ShapeError, "connecting duration above 0", lambda s: identify.sequence([MOTION], walk=0.0)),
    (ShapeError, r"rest at both ends, got 0\.\d+ rad/s",
     lambda s: excite.Trajectory.from_table(MOTION.table().between(0, 0.6))),
    (ShapeError, "without missing values",
     lambda s: excite.Trajectory.from_table(changed(MOTION.table(), np.nan, "q"))),
    (ShapeError, "rate above 0 Hz", lambda s: MOTION.table(rate=0.0)),
    (UnknownName, "name of a joint, got 'elbow'", lambda s: identify.friction_run(YUMI, "elbow")),
    (UnknownName, "from 0 to 6, got 7", lambda s: identify.friction_run(YUMI, 7)),
    (UnknownName, "joint number from 0 to 6", lambda s: identify.friction_run(YUMI, True)),
    (ShapeError, r"pose of shape \(7,\)", lambda s: identify.friction_run(YUMI, 0, at=np.full(7, 9.0))),
    (ShapeError, "speed and acceleration limits",
     lambda s: identify.friction_run(replace(YUMI, qd_max=np.full(7, np.inf)), 0)),
    *((ShapeError, "noise above 0", lambda s, noise=noise: excite.predicted_uncertainty(MOTION, YUMI, noise))
      for noise in (0.0, np.nan, np.inf)),
    (ShapeError, "6 joints", lambda s: excite.predicted_uncertainty(MOTION, robots.load("irb2400"))),
]  # fmt: skip
MODELS: list[tuple[type[Exception], str, Callable[[SimpleNamespace], Any]]] = [
    (UnknownName, "from 0 to 6", lambda s: dynamics.base_parameters(YUMI, joints=[1, 1])),
    (UnknownName, "from 0 to 6", lambda s: dynamics.base_parameters(YUMI, joints=["axis_1"])),
    (RobotError, "Load the robot first", lambda s: dynamics.base_parameters("yumi_left")),
    (UnknownName, "method of identification", lambda s: identify.fit_dynamics(s.log, YUMI, method="median")),
    (ModelMismatchError, "earlier fit", lambda s: identify.fit_dynamics(s.log, YUMI, prior=s.model)),
    (ShapeError, "62.5 Hz, a quarter of the sampling rate", lambda s: identify.fit_dynamics(s.log, YUMI, cutoff=80.0)),
    (ShapeError, "finite cut-off .Hz. above zero", lambda s: identify.fit_dynamics(s.log, YUMI, cutoff=-1.0)),
    (NotExcited, "every joint to move", lambda s: identify.fit_gravity(POSE, YUMI)),
    (ShapeError, f"Expected slow motion.*{YUMI.joint_names[6]}", lambda s: identify.fit_gravity(s.log, YUMI)),
    (NotExcited, "5 s", lambda s: identify.fit_friction(s.log.between(0.0, 3.0), s.model)),
    (ShapeError, "yumi_left", lambda s: identify.fit_friction(without_joint(s.log), s.model)),
    (NotExcited, "20 min", lambda s: identify.fit_warm_up(s.log, s.model)),
    (NotExcited, "joint 2", lambda s: rbf_centres(Q * [1, 0], QD * [1, 0])),
    (ShapeError, "at least 2", lambda s: rbf_centres(Q, QD, speeds=1)),
    (ShapeError, "q and qd of equal shape", lambda s: rbf_centres(Q, QD[:-1])),
    (ShapeError, "2 joints", lambda s: rbf_regressor(Q[:, :1], QD[:, :1], rbf_centres(Q, QD))),
    (ShapeError, "finite q, qd and z", lambda s: rbf_regressor(Q, QD, rbf_centres(Q, QD), z=np.nan * Q)),
    (ShapeError, "finite q", lambda s: rbf_regressor(np.nan * Q, QD, rbf_centres(Q, QD))),
    (ShapeError, "q, qd and y of equal shape", lambda s: ripple_lines(Q[:, 0], QD[:, 0], Q[:-1, 0], 250.0, 250.0)),
    (ShapeError, "rate above 0 Hz and finite", lambda s: ripple_lines(Q[:, 0], QD[:, 0], Q[:, 0], 0.0, 250.0)),
    (ShapeError, "rate above 0 Hz and finite", lambda s: ripple_lines(Q[:, 0], QD[:, 0], Q[:, 0], 250.0, np.inf)),
    (ShapeError, "finite", lambda s: ripple_lines(Q[:, 0], QD[:, 0], np.nan * Q[:, 0], 250.0, 250.0)),
    (ShapeError, "the same shape", lambda s: identify.fit_velocity_covariance(NOISE, QD[:10])),
    (ShapeError, "the same shape", lambda s: identify.fit_velocity_covariance(NOISE[:, :0], QD[:, :0])),
    (ShapeError, r"1 rows, first \[3\]",
     lambda s: identify.fit_velocity_covariance(NOISE, np.where(QD[3] == QD, np.nan, QD))),
    (NotExcited, "zeros for joint 2", lambda s: identify.fit_velocity_covariance(NOISE * [1.0, 0.0], QD)),
    (NotExcited, "one speed", lambda s: identify.fit_velocity_covariance(NOISE, np.ones_like(QD), "step")),
    (NotExcited, "at least 100", lambda s: identify.fit_velocity_covariance(NOISE[:10], QD[:10])),
    (UnknownName, "const, exp, step", lambda s: identify.fit_velocity_covariance(NOISE, QD, "cubic")),
    (ShapeError, "7 joints in at least two rows", lambda s: identify.extrapolation(s.model, without_joint(s.log))),
    (ShapeError, r"1 rows, first \[5\]",
     lambda s: identify.extrapolation(s.model, changed(s.log, put(5, 2, np.nan), "q"))),
    (ShapeError, "100 rows without a gap",
     lambda s: identify.extrapolation(s.model, Table(s.log.t[:50], {"q": s.log["q"][:50]}))),
    (ShapeError, "a rest share from 0 to 1", lambda s: replace(s.model.training, rest_share=2.0)),
    (ShapeError, "100 Hz, got 50 Hz",
     lambda s: log_sums(s.short.log(0, 3000).rows(slice(None, None, 2)), s.draft()[1])),
    (NotExcited, "at least 8 segments", lambda s: few_stretches(s)),
]  # fmt: skip
PAYLOAD: list[tuple[type[Exception], str, Callable[[SimpleNamespace], Any]]] = [
    (ModelMismatchError, "yumi_right", lambda s: identify.fit_payload(s.log, s.model, robots.load("yumi_right"))),
    (UnknownName, "static", lambda s: identify.fit_payload(s.log, s.model, YUMI, "fast")),
    (ShapeError, "a gain standard deviation", lambda s: identify.fit_payload(s.log, s.model, YUMI, gain_sd=-0.1)),
    (NotExcited, "5 s", lambda s: identify.fit_payload(s.log.between(0, 3), s.model, YUMI)),
    (ShapeError, r"\[11\]", lambda s: identify.fit_payload(changed(s.log, put(11, 0, np.nan), "tau"), s.model, YUMI)),
    (ShapeError, r"\(7500, 7\)", lambda s: identify.fit_payload(without_joint(s.log), s.model, YUMI)),
    (ShapeError, r"axis_1 \(\S+, limit 2\.941: degrees",
     lambda s: LoadRecord.of(changed(s.log, DEGREES, "q", "qd"), s.model, YUMI)),
    (ShapeError, "degrees", lambda s: LoadRecord.of(s.log, s.model, YUMI, changed(s.log, DEGREES, "q", "qd"))),
    (ShapeError, r"log 2 repeats the rows of log 1\.", lambda s: LoadRecord.of(s.log, s.model, YUMI, s.log)),
    (ShapeError, "equal rates", lambda s: LoadRecord.of(s.log, s.model, YUMI, s.log.rows(slice(None, None, 2)))),
    (ShapeError, "same motion", lambda s: LoadRecord.of(s.log, s.model, YUMI, s.other)),
]  # fmt: skip


def few_stretches(s: SimpleNamespace) -> Any:
    draft, pattern = s.draft()
    pattern = replace(pattern, blocks=4)
    return fit_sums(draft, pattern, [log_sums(s.short.log(0, 3000), pattern)], [0])


@pytest.fixture(scope="module")
def given(truth, excited, model, fitted, short_arm) -> SimpleNamespace:
    other = truth.log(identify.design_excitation(YUMI, seconds=12, speed=0.4, seed=4))
    return SimpleNamespace(
        log=excited, model=model, fitted=fitted, short=short_arm, other=other,
        draft=cache(lambda: fit_draft([short_arm.log(0, 1200)], short_arm.robot, 1)),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("error", "words", "call"),
    [*RECORD, *MOTIONS, *MODELS, *PAYLOAD],
    ids=[words for _, words, _ in (*RECORD, *MOTIONS, *MODELS, *PAYLOAD)],
)
def test_refused(error: type[Exception], words: str, call: Callable[[SimpleNamespace], Any], given) -> None:
    with pytest.raises(error, match=words):
        call(given)


@pytest.mark.parametrize("other", [None, "arm.mcap", -1, float("nan"), [[1, 2], [3]], NAN], ids=repr)
def test_something_else_in_place_of_a_log_a_model_a_robot(other: Any, given) -> None:
    model, table = given.model, MOTION.table()
    calls: list[tuple[type[Exception], Callable[[], Any]]] = [
        (ShapeError, lambda: identify.with_velocity(other)),
        (ShapeError, lambda: identify.extrapolation(model, other)),
        (ShapeError, lambda: identify.predict(model, other)),
        (ShapeError, lambda: Estimator(model, YUMI).run(other)),
        (ShapeError, lambda: contacts(other)),
        (ShapeError, lambda: compare(other)),
        (ShapeError, lambda: hypotheses(other, YUMI)),
        (ShapeError, lambda: excite.predicted_uncertainty(other, YUMI)),
        (ModelMismatchError, lambda: identify.extrapolation(other, table)),
        (ModelMismatchError, lambda: identify.predict(other, table)),
        (ModelMismatchError, lambda: identify.fit_friction(table, other)),
        (ModelMismatchError, lambda: identify.fit_payload(table, other, YUMI)),
        (ModelMismatchError, lambda: Estimator(other, YUMI)),
        (ModelMismatchError, lambda: identify.physically_consistent(other, YUMI)),
        (RobotError, lambda: Estimator(model, other)),
        (RobotError, lambda: excite.predicted_uncertainty(MOTION, other)),
        (RobotError, lambda: identify.friction_run(other, 0)),
        (RobotError, lambda: identify.fit_payload(table, model, other)),
    ]
    for error, call in calls:
        with pytest.raises(error):
            call()


def test_a_model_that_no_bodies_can_be_found_for(given, tmp_path, monkeypatch) -> None:
    pytest.importorskip("cvxpy", reason="the extra sdp is not installed")
    fitted = given.fitted
    nameless = replace(fitted.value, base_names=("m",) * len(fitted.value.base_names))
    cases: list[tuple[type[Exception], str, Callable[[], Any]]] = [
        (ModelMismatchError, "yumi_right", lambda: identify.physically_consistent(fitted, robots.load("yumi_right"))),
        (UnknownName, "log-det", lambda: identify.physically_consistent(fitted, YUMI, pull="strong")),
        (ShapeError, "strength", lambda: identify.physically_consistent(fitted, YUMI, strength=0.0)),
        (ShapeError, r"\(7, 10\)", lambda: identify.physically_consistent(fitted, YUMI, prior=np.zeros((6, 10)))),
        (ShapeError, "link 1, link 2", lambda: identify.physically_consistent(fitted, YUMI, prior=np.zeros((7, 10)))),
        (ConfigError, "Repeat the identification from the log",
         lambda: identify.physically_consistent(Fit.load(fitted.save(tmp_path / "model.toml")), YUMI)),
        (ConfigError, "fit_dynamics", lambda: identify.physically_consistent(replace(fitted, value=nameless), YUMI)),
    ]  # fmt: skip
    for error, words, call in cases:
        with pytest.raises(error, match=words):
            call()
    monkeypatch.setitem(__import__("sys").modules, "cvxpy", None)
    with pytest.raises(MissingExtra, match=r"armlab\[sdp\]"):
        identify.physically_consistent(fitted, YUMI)
