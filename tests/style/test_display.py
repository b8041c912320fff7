"""Values in a terminal and in a notebook: at most twenty lines, and a table."""

from __future__ import annotations

import copy
import pickle
from dataclasses import is_dataclass
from inspect import isclass, ismodule
from pathlib import Path

import numpy as np
import pytest

import armlab
from armlab import contact, robots, signals
from armlab._display import Shown, brief
from armlab.estimation import Fit
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.state import Command, State

LINES = 20


def public_classes() -> list[type]:
    packages = [part for part in (getattr(armlab, name) for name in armlab.__all__) if ismodule(part)]
    members = {getattr(package, name) for package in packages for name in getattr(package, "__all__", ())}
    members |= {getattr(one, name) for one in members if ismodule(one) for name in getattr(one, "__all__", ())}
    return sorted((one for one in members if isclass(one)), key=lambda one: one.__qualname__)


def test_no_public_dataclass_prints_its_arrays() -> None:
    generated = [one.__name__ for one in public_classes() if is_dataclass(one) and one.__dataclass_params__.repr]  # type: ignore[attr-defined]
    kept = {"Robot", "IkPath", "IkSolution", "Tree", "Mimic", "TwoLink"}
    assert set(generated) <= kept, "which write their own, or are a few numbers"
    ours = [one for one in public_classes() if issubclass(one, Shown)]
    assert not [one for one in ours if one.__repr__ is not Shown.__repr__], "of a base that prints its arrays"


def test_reprs_are_short_and_notebooks_get_a_table(fitted: Fit[TorqueModel], excited: Table) -> None:
    model, robot, n = fitted.value, robots.load("yumi_left"), 7
    state = next(excited.states())
    shown = [fitted, model, model.friction, model.quality, robot, state, Command(q=np.zeros(n)), fitted.excitation]
    for one in shown:
        assert len(repr(one).splitlines()) <= LINES
        assert max(map(len, repr(one).splitlines())) <= 120
    assert len(repr(model)) < 2000
    for one in (fitted, model, robot, model.friction):
        assert one._repr_html_().count("<tr>") > 5
    assert "<td>m</td>" not in repr(fitted._repr_html_())
    assert brief({"a": np.zeros((3, 3))}) == "{'a': array(3, 3) of float64}"
    assert issubclass(TorqueModel, Shown)


@pytest.mark.parametrize(
    "make",
    [
        lambda: signals.Integrator(0.01), lambda: signals.ExpFilter(0.1, 0.01), lambda: signals.Notch(10.0, dt=0.01),
        lambda: signals.LowPass2(10.0), lambda: signals.CausalDiff(5.0, 0.01), lambda: signals.Differentiator(0.01),
    ],
)  # fmt: skip
def test_filters_keep_their_memory_in_copies_and_pickles(make) -> None:
    rng = np.random.default_rng(3)
    x, t = rng.normal(size=(40, 2)), np.cumsum(rng.uniform(0.005, 0.02, 40))
    stamps = t if np.isnan(make().dt) else None
    whole, part = make(), make()
    wanted = whole.run(x, stamps)
    part.run(x[:20], None if stamps is None else stamps[:20])
    rest = (x[20:], None if stamps is None else stamps[20:])
    for other in (copy.copy(part), copy.deepcopy(part), pickle.loads(pickle.dumps(part))):
        np.testing.assert_array_equal(other.run(*rest), wanted[20:])
        assert (other.gaps, other.skipped) == (whole.gaps, whole.skipped)
    np.testing.assert_array_equal(part.run(*rest), wanted[20:])
    fresh = pickle.loads(pickle.dumps(make()))
    np.testing.assert_array_equal(fresh.run(x, stamps), wanted)


@pytest.mark.parametrize("method", ["map", "kf"])
def test_a_copy_of_an_estimator_goes_on_and_a_pickle_begins_anew(method, model, excited: Table) -> None:
    options = {"bias": True} if method == "kf" else {}
    estimator = contact.Estimator(model, robots.load("yumi_left"), method, **options)
    states = list(excited.rows(slice(0, 60)).states())
    for state in states[:50]:
        estimator.step(state)
    other, anew = copy.copy(estimator), pickle.loads(pickle.dumps(estimator))
    for state in states[50:]:
        wanted = estimator.step(state).wrench
        np.testing.assert_array_equal(other.step(state).wrench, wanted)
    first = contact.Estimator(model, robots.load("yumi_left"), method, **options).step(states[0]).wrench
    np.testing.assert_array_equal(anew.step(states[0]).wrench, first)
    assert method in repr(estimator)


def test_a_state_is_copied_with_what_its_packet_says(excited: Table) -> None:
    values = {name: np.zeros(7) for name in ("q", "qd", "tau")}
    state = State(1.0, 0.004, **values, sources={"tracker": {"p": np.ones(3)}}, details=lambda: {"current": 1.0})
    for other in (copy.copy(state), copy.deepcopy(state), pickle.loads(pickle.dumps(state))):
        assert other.details() == {"current": 1.0}
        np.testing.assert_array_equal(other.sources["tracker"]["p"], np.ones(3))
        assert not other.q.flags.writeable
    assert pickle.loads(pickle.dumps(next(excited.states()))).t == excited.t[0]


def test_a_fit_goes_where_its_value_goes_and_files_are_typed(fitted: Fit[TorqueModel], tmp_path: Path) -> None:
    robot = robots.load("yumi_left")
    assert contact.Estimator(fitted, robot).method == "map"
    path = fitted.save(tmp_path / "model.toml")
    assert armlab.models.load(path, TorqueModel).n == 7
    with pytest.raises(armlab.errors.ModelMismatchError, match="hand_eye"):
        armlab.models.load(path, armlab.models.HandEye)
