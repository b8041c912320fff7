"""Two commanders of a simulated arm: `Arbiter` in a whole run."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.arbiter import Arbiter, Order
from armlab.state import State

LEFT = robots.load("yumi_left")
HOME = np.array(LEFT.q_home)
TICK = 4_000_000  # ns


@pytest.mark.slow
def test_two_commanders_of_a_simulated_arm() -> None:
    """At 250 Hz for 60 s with random deaths: what is sent follows one of them or holds. Takes 20 s."""
    chance = np.random.default_rng(7)
    events: list[str] = []
    ticks = [0]
    offsets = {"labcomm a": 0.03, "labcomm b": -0.03}
    dead_until = dict.fromkeys(offsets, 0)
    newest = {client: deque[np.ndarray](maxlen=26) for client in offsets}  # of the last 100 ms

    def poll() -> None:
        ticks[0] += 1
        for client, offset in offsets.items():
            if ticks[0] >= dead_until[client]:
                if chance.random() < 0.01:
                    dead_until[client] = ticks[0] + int(chance.integers(10, 150))
                q = HOME + offset * np.sin(0.004 * ticks[0])
                newest[client].append(q)
                arbiter.submit(
                    Order(client, "yumi_left", q if chance.random() > 0.02 else q + chance.choice([0.3, np.nan]))
                )

    arbiter = Arbiter(
        [LEFT],
        ["labcomm"],
        poll=poll,
        tell=lambda text, *_, **__: events.append(text),
        clock=lambda: 10**12 + TICK * ticks[0],
    )
    holders: list[str] = []

    def controller(state: State) -> Any:
        told, before = len(events), arbiter.commander("yumi_left")
        command = arbiter(state)
        holders.append(arbiter.commander("yumi_left"))
        if holders[-1] not in ("", before):
            assert f"{holders[-1]} commands yumi_left." in events[told:]
        if command is not None:
            sent = newest[holders[-1]]
            assert any(np.array_equal(command.q, q) for q in sent), "exactly what its holder sent"
        return command

    with bridge.connect("sim://yumi_left?lockstep=true", LEFT) as link:
        run = link.run(controller, seconds=60.0)
    assert run.reason == "the time is up"
    assert run.statistics["refused"] == 0
    table = run.table
    assert {"labcomm a", "labcomm b", ""} == set(holders)
    limits = bridge.Limits.of(LEFT)
    assert np.all(np.abs(np.diff(table["q_sent"], axis=0)) <= 0.004 * limits.qd_max * 1.01 + 1e-9)
    assert np.all(np.abs(np.diff(table["qd_sent"], axis=0)) <= 0.004 * limits.qdd_max * 1.01 + 1e-6)
    assert sum("commands yumi_left." in text for text in events) > 40
