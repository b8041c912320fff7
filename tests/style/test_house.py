"""Goals of the code base that are met stay met; `make house` prints all of them."""

from __future__ import annotations

import pytest

from .house import GOALS, Goal, measured, table

MET = {
    "Python in src, files",
    "tests, files",
    "widest folder, modules",
    "import circles",
    "public names",
    "fit_dynamics, files deep",
}
"""Names of goals that are met, each held from then on."""


@pytest.mark.parametrize("goal", [goal for goal in GOALS if goal.name in MET], ids=lambda goal: goal.name)
def test_a_goal_that_was_met_stays_met(goal: Goal) -> None:
    assert measured()[goal.name] <= goal.most


def test_no_goal_is_met_without_being_held() -> None:
    figures = measured()
    assert {goal.name for goal in GOALS if figures[goal.name] <= goal.most} == MET
    assert all(goal.name in table() for goal in GOALS)
