"""Sums of logs: each of one log alone, the fit to all of them that of all rows."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.identify.many import LogSums, Pattern, fit_draft, fit_sums, log_sums
from armlab.identify.record import prepare_share
from armlab.identify.regression import Design
from armlab.log import Table


def test_the_fit_to_sums_is_the_draft_where_there_are_no_other_logs(short_arm) -> None:
    """The draft has converged: one more step of weights and slopes from it moves it by little."""
    tables = [short_arm.log(k, 2000, bad=0.02) for k in range(3)]
    draft, pattern = fit_draft(tables, short_arm.robot, 3)
    sums = [log_sums(table, pattern) for table in tables]
    fit = fit_sums(draft, pattern, sums, [0, 1, 2])
    assert fit.n == 6000
    x, sd = draft.sums.solution.x, np.sqrt(np.diag(draft.sums.solution.cov))
    in_units = draft.design.in_units(x, np.diag(sd**2), np.diag(sd**2))[0]
    assert np.abs((fit.parameters - in_units) / fit.sd).max() < 0.5
    assert np.all(fit.value.quality.coverage > 0.5)


def test_sums_do_not_depend_on_other_logs_and_survive_a_journey(short_arm) -> None:
    tables = [short_arm.log(k, 2000) for k in range(4)]
    draft, pattern = fit_draft(tables[:2], short_arm.robot, 4)
    sums = [log_sums(table, pattern) for table in tables]
    assert all(isinstance(one, LogSums) for one in sums)
    there: Pattern = pickle.loads(pickle.dumps(pattern))
    assert there.sha256 == pattern.sha256
    back = [pickle.loads(pickle.dumps(log_sums(table, there))) for table in reversed(tables)][::-1]
    one, other = (fit_sums(draft, pattern, some, [0, 1]) for some in (sums, back))
    assert one.parameters.tobytes() == other.parameters.tobytes()
    assert one.cov.tobytes() == other.cov.tobytes()
    assert [part.source for part in sums] == list(one.value.sources)


def test_a_pattern_is_known_by_what_the_sums_depend_on(short_arm) -> None:
    _, pattern = fit_draft([short_arm.log(0, 3000)], short_arm.robot, 4)
    others = [
        replace(pattern, limit=2 * pattern.limit),
        replace(pattern, theta=pattern.theta + 1e-12),
        replace(pattern, blocks=pattern.blocks + 1),
        replace(pattern, rate=99.0),
        replace(pattern, geared=True),
        replace(pattern, robot=robots.load("ur5e")),
    ]
    assert len({one.sha256 for one in (pattern, *others)}) == 7


def test_the_draft_decides_on_ripple_for_every_log(short_arm) -> None:
    """A log alone would have its own columns, and its sums could not be added to those of the others."""
    robot = replace(short_arm.robot, coupling=np.eye(2) / 60.0)
    slow = short_arm.log(0, 3000)
    fast = Table(slow.t, {"q": 6.0 * slow["q"], "qd": 6.0 * slow["qd"], "tau": slow["tau"]})
    _, pattern = fit_draft([slow], robot, 4)
    assert pattern.geared
    data = prepare_share(fast, robot)
    with pytest.warns(UserWarning, match="no ripple is fitted"):
        assert not Design.build(data, robot, pattern.base).geared
    assert pattern.design(data).geared
    one, other = (log_sums(table, pattern).factors for table in (slow, fast))
    assert [R.shape for R in one.R] == [R.shape for R in other.R]
