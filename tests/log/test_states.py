"""From rows to what a controller saw."""

from __future__ import annotations

import numpy as np

from armlab.log import Table
from armlab.log.states import QD_SOURCES, TAU_SOURCES


def test_sources_are_words_again() -> None:
    table = Table(
        [0.0, 1.0], {"q": np.zeros((2, 3)), "tau": np.zeros((2, 3)), "tau_source": [2, 0], "qd_source": [1, 0]}
    )
    states = list(table.states())
    assert [state.tau_source for state in states] == ["reference", "none"]
    assert [state.qd_source for state in states] == ["measured", "difference"]
    assert QD_SOURCES[1] == "measured"
    assert TAU_SOURCES[0] == "none"
    assert next(table.without("tau_source").states()).tau_source == "measured"


def test_missing_numbers_keep_the_default_of_the_state() -> None:
    table = Table([0.0, 1.0], {"q": np.zeros((2, 3)), "robot_ns": [np.nan, 5.0], "utilization": [np.nan, 4.0]})
    first, second = table.states()
    assert first.robot_ns == 0
    assert np.isnan(first.utilization)
    assert (second.robot_ns, second.utilization) == (5, 4.0)
    assert first.q_sent.size == 0


def test_time_of_the_session_is_the_time_of_the_state() -> None:
    table = Table([0.0, 1.0], {"q": np.zeros((2, 3)), "session_t": [7.0, 0.5], "session": [1, 2]})
    assert [state.t for state in table.states()] == [7.0, 0.5]


def test_periods_of_short_tables() -> None:
    assert np.isnan(Table([3.0], {}).dt).all()
    assert Table([3.0], {"dt": [0.004]}).dt.tolist() == [0.004]
    assert Table([], {}).dt.size == 0
    assert Table([0.0, 1.0, 3.0], {"dt": [np.nan, 1.0, np.nan]}).dt.tolist() == [1.5, 1.0, 2.0]
