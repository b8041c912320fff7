"""Parameters: types, bounds, rights, and when they come into force."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.bridge.inputs.parameters import Change, Parameter, Parameters
from armlab.errors import CommandRefused, ConfigError, UnknownName


def cell() -> Parameters:
    return Parameters(
        [
            Parameter("gain", 2.0, unit="N/m", minimum=0.0, maximum=10.0, text="Stiffness."),
            Parameter("count", 3, "int", minimum=0, maximum=5),
            Parameter("gentle", True, "bool", rights="anyone"),
            Parameter("label", "a", "text"),
            Parameter("force", [0.0, 0.0, 1.0], "float[3]", minimum=-5.0, maximum=5.0),
            Parameter("mass", 1.0, live=False),
        ]
    )


def test_a_value_comes_into_force_between_ticks() -> None:
    params = cell()
    params.set("gain", 3)
    assert params.gain == 2.0
    assert params.apply() == (Change(1, "gain", 3.0, "controller"),)
    assert params.gain == 3.0
    assert isinstance(params.gain, float)
    assert params.apply() == ()


def test_two_setters_in_one_tick_are_both_applied_in_order() -> None:
    params = cell()
    params.set("gain", 1.0, "one")
    params.set_together({"gain": 4.0, "count": 5}, "two")
    changes = params.apply()
    assert [(c.sequence, c.name, c.value, c.who) for c in changes] == [
        (1, "gain", 1.0, "one"),
        (2, "gain", 4.0, "two"),
        (3, "count", 5, "two"),
    ]
    assert params.values()["gain"] == 4.0
    assert changes[0].sentence == "Parameter gain = 1.0, set by one (setting 1)."


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gain", math.nan, "finite number for the parameter gain \\[N/m\\], got nan"),
        ("gain", 11, "from 0 to 10"),
        ("gain", "3", "finite number"),
        ("gain", True, "finite number"),
        ("gain", 10**400, "from 0 to 10"),
        ("count", 2.5, "whole number"),
        ("count", 6, "from 0 to 5"),
        ("gentle", 1, "true or false"),
        ("label", 1, "a text"),
        ("label", "x" * 1001, "at most 1000"),
        ("force", [1.0, 2.0], "3 finite numbers"),
        ("force", [1.0, 2.0, math.inf], "3 finite numbers"),
        ("force", [1.0, 2.0, 6.0], "from -5 to 5"),
        ("force", [[1.0], [2.0, 3.0]], "3 finite numbers"),
        ("force", "abc", "3 finite numbers"),
        ("force", [True, False, True], "3 finite numbers"),
        ("force", 1.0, "3 finite numbers"),
    ],
)
def test_refused_values(name: str, value: Any, words: str) -> None:
    params = cell()
    with pytest.raises(CommandRefused, match=words):
        params.set_together({"gentle": False, name: value})
    assert params.apply() == ()
    assert params.gentle is True


def test_rights_and_live() -> None:
    params = cell()
    with pytest.raises(CommandRefused, match="commander of an arm to set gain, got web"):
        params.set_together({"gain": 1.0}, "web", commander=False)
    params.set_together({"gentle": False}, "web", commander=False)
    params.set("mass", 2.0)
    params.running = True
    with pytest.raises(CommandRefused, match="before a run"):
        params.set("mass", 3.0)
    params.apply()
    assert (params.gentle, params.mass) == (False, 2.0)


def test_unknown_names() -> None:
    params = cell()
    with pytest.raises(UnknownName, match=r"'gan'.*gain"):
        params.set("gan", 1.0)
    with pytest.raises(AttributeError, match=r"'gan'.*gain"):
        params.gan
    assert not hasattr(params, "__deepcopy__")


def test_a_flood_of_settings_ends() -> None:
    params = cell()
    for _ in range(256):
        params.set("gain", 1.0)
    with pytest.raises(CommandRefused, match="at most 256 settings"):
        params.set("gain", 1.0)
    assert len(params.apply()) == 256


def test_vectors_are_read_only() -> None:
    given_array = np.ones(3)
    params = cell()
    params.set("force", given_array)
    given_array[0] = 4.0
    params.apply()
    np.testing.assert_array_equal(params.force, np.ones(3))
    assert not params.force.flags.writeable


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"name": "2x"}, "a word"),
        ({"name": "set"}, "free"),
        ({"name": None}, "a word"),
        ({"type": "double"}, "type float, int"),
        ({"type": "float[0]"}, "type float, int"),
        ({"rights": "all"}, "rights"),
        ({"minimum": 1.0, "maximum": 0.0}, "bounds in order"),
        ({"minimum": math.nan}, "bounds in order"),
        ({"default": "a"}, "default that may be set"),
        ({"minimum": 3.0}, "from 3 to inf"),
    ],
)
def test_wrong_declarations(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Parameter(**{"name": "x", "default": 1.0, **fields})


def test_declared_twice() -> None:
    with pytest.raises(ConfigError, match="each parameter once"):
        Parameters([Parameter("a", 1.0), Parameter("a", 2.0)])


anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-9, 9),
    st.floats(),
    st.sampled_from(["", "up", 10**400]),
    st.lists(st.floats(), max_size=4),
)


@given(st.dictionaries(st.sampled_from(["gain", "count", "gentle", "label", "force", "x"]), anything, max_size=3))
def test_what_is_in_force_is_always_valid(values: dict[str, Any]) -> None:
    params = cell()
    before = params.values()
    try:
        params.set_together(values)
        accepted = True
    except (CommandRefused, UnknownName):
        accepted = False
    params.apply()
    for name, parameter in params.declared.items():
        parameter._checked(getattr(params, name))
        if not accepted:
            assert np.array_equal(getattr(params, name), before[name])


@pytest.mark.parametrize("value", [10**400, -(10**400), 10**5000], ids=["big", "small", "unprintable"])
@pytest.mark.parametrize("kind", ["float", "int", "float[2]"])
def test_integers_that_no_float_holds_are_refused(kind: str, value: int) -> None:
    """JSON has them: a client must not end the run with one."""
    is_vector = kind == "float[2]"
    params = Parameters([Parameter("gain", [0.0, 0.0] if is_vector else 0, type=kind)])
    with pytest.raises(CommandRefused, match=r"Expected .* for the parameter gain.*Its value stays\.$"):
        params.set("gain", [value, 1] if is_vector else value)
    assert params.apply() == ()


def test_who_set_what_last_is_known_without_a_look_at_the_history() -> None:
    params = Parameters([Parameter("gain", 2.0), Parameter("other", 1.0)])
    assert params.last("gain") is None
    for value in (3.0, 4.0):
        params.set("gain", value, "web")
        params.apply()
    last = params.last("gain")
    assert (last.sequence, last.value, last.who) == (2, 4.0, "web")
    assert params.last("other") is None
    with pytest.raises(UnknownName, match="parameter"):
        params.last("nothing")
