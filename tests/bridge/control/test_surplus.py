"""One reply is left out for each surplus message in the robot's queue."""

from __future__ import annotations

import json
from collections import deque
from pathlib import Path
from urllib.parse import quote

import pytest

from armlab import robots
from armlab.bridge import connect
from armlab.bridge.control.arm import Surplus
from armlab.state import Command

PERIOD = 0.004032


def controller(surplus: Surplus, extra: dict[int, int], cycles: int) -> tuple[list[int], int]:
    """Ages of the references that act, and cycles without one: sends, takes one message, then the reply arrives."""
    queue: deque[int] = deque()
    ages, starved, left = [], 0, 0
    for k in range(cycles):
        depth = left
        if queue:
            ages.append(k - queue.popleft())
        else:
            starved += k > 0
        left = len(queue)
        if not surplus.leaves_out(depth, PERIOD):
            queue.append(k)
        queue.extend([k] * extra.get(k, 0))
    return ages, starved


def test_nothing_is_left_out_of_a_queue_that_empties() -> None:
    surplus = Surplus()
    ages, starved = controller(surplus, {}, 100)
    assert (set(ages), starved, surplus.left_out) == ({1}, 0, 0)


@pytest.mark.parametrize("many", [1, 2, 5, 20])
def test_surplus_messages_cost_no_lag_in_the_end(many: int) -> None:
    """Without the rule the age would stay at 1 + many for ever."""
    surplus = Surplus()
    ages, starved = controller(surplus, {20: many}, 120)
    assert max(ages) == 1 + many
    assert set(ages[-60:]) == {1}
    assert surplus.left_out == many
    assert starved == 0


def test_two_cycles_are_not_enough_and_unknown_depth_never_acts() -> None:
    surplus = Surplus()
    assert not any(surplus.leaves_out(depth, PERIOD) for depth in [1, 1, 0, 2, 2, 0, -1, -1, -1, -1, -1])
    assert [surplus.leaves_out(depth, PERIOD) for depth in [3, 1, 2, 2]] == [False, False, True, False]
    assert surplus.left_out == 1


def test_a_queue_that_has_become_shorter_owes_no_more() -> None:
    """A new session has an empty queue: its packets are answered at once, and looked at anew."""
    surplus = Surplus()
    told = [surplus.leaves_out(depth, PERIOD) for depth in [9, 9, 9, 8, 2, 1, 0, 9, 9]]
    assert told == [False] * 2 + [True] * 4 + [False] * 3
    assert surplus.leaves_out(9, PERIOD)
    assert not surplus.leaves_out(-1, PERIOD), "it tells no longer"
    assert surplus.left_out == 5


def test_whatever_the_robot_tells_it_is_answered() -> None:
    surplus = Surplus()
    told = [surplus.leaves_out(2**32 - 1, PERIOD) for _ in range(38)]
    assert told == ([False] * 2 + [True] * 16) * 2 + [False] * 2


def test_a_queue_that_is_not_emptied_within_a_second_is_one_event() -> None:
    """As when another program sends to the robot, too."""
    told: list[tuple[str, bool]] = []
    surplus = Surplus(lambda text, warn=False, each=False: told.append((text, warn)))
    for depth in [44] * 200 + [0] + [44] * 247:
        surplus.leaves_out(depth, PERIOD)
    assert not told, "200 and 247 cycles are less than 1 s"
    for depth in [45] * 1000:
        surplus.leaves_out(depth, PERIOD)
    [(text, warn)] = told
    assert warn
    assert "44 messages have waited" in text
    assert "each reference acts 177 ms late" in text
    surplus.leaves_out(0, PERIOD)
    for _ in range(249):
        surplus.leaves_out(1, PERIOD)
    assert "1 message has waited" in told[1][0], "after it was empty, another one counts"


def test_a_queue_that_trimming_empties_is_no_event() -> None:
    told: list[str] = []
    surplus = Surplus(lambda text, warn=False, each=False: told.append(text))
    ages, _ = controller(surplus, {20: 63}, 500)
    assert max(ages) == 64
    assert ages[-1] == 1
    assert not told


@pytest.mark.slow
def test_duplicated_replies_leave_no_lag(tmp_path: Path) -> None:
    """Real time, one reply in a hundred arrives twice: without the rule the references would be 10 cycles old. 6 s."""
    robot, stats = robots.load("yumi_right"), tmp_path / "stats.json"
    url = f"sim://yumi_right?duplicate=0.01&seed=4&stats={quote(str(stats))}"
    with connect(url, robot) as link:
        run = link.run(lambda state: Command(state.q_start), seconds=4.0)
    assert run.statistics["left_out"] >= 3
    [counted] = json.loads(stats.read_text()).values()
    ages = {int(age): number for age, number in counted["reference_age"].items() if age != "last"}
    assert sum(number for age, number in ages.items() if age <= 2) > 0.8 * sum(ages.values())
