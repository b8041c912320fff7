"""States that change at given times."""

from __future__ import annotations

import pytest

from armlab.errors import ConfigError, UnknownName
from armlab.sim.events import MOTORS, RAPID, StateScript


def test_states_over_time() -> None:
    script = StateScript("0:on,2.5:off,4:on", MOTORS)
    assert [script.at(t) for t in (-1.0, 0.0, 2.4, 2.5, 3.9, 4.0, 99.0)] == [1, 1, 1, 2, 2, 1, 1]
    assert StateScript("undefined", RAPID).at(5.0) == 0


@pytest.mark.parametrize("text", ["0:on,0:off", "x:on", "nan:on", "2:on,1:off"])
def test_wrong_times_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="increase"):
        StateScript(text, MOTORS)


def test_unknown_states_list_what_exists() -> None:
    with pytest.raises(UnknownName, match="running"):
        StateScript("0:runing", RAPID)
