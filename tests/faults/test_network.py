"""A network that loses, delays, doubles, swaps and damages datagrams, or is silent; in virtual time.

Only what meets a moving arm is in the default tests: the other states are slow tests.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from .bench import PATIENCE, PERIOD, Bad, Bench, Motion, Outcome, Station, judge, met_in_motion, unlucky
from .matrix import Cell, shows

LASTS = 0.4  # s, of a fault
LASTS_RARE = 2.0  # s, of one that would not come in both directions else
BEGINS = {"waiting": 0.0, "holding": 0.3, "running": 0.3, "stopping": 0.3}
AFTER = 0.3  # s of motion when it is over
OTHER = ("127.0.0.1", 50002)


def begin(cell: Cell, lasts: float = LASTS) -> tuple[float, Motion]:
    """When the fault begins, and what the controller does so that it meets that state."""
    at = BEGINS[cell.state]
    return at, {
        "waiting": Motion(),
        "holding": Motion(holds=(0.0, at + lasts)),
        "running": Motion(),
        "stopping": Motion.that_stops(at),
    }[cell.state]


def goes_on(bench: Bench, cell: Cell, outcome: Outcome, over: float) -> None:
    """It ended as it would have without the fault; where it was to stop, another run moves the arm again."""
    assert outcome.failure is None
    judge(bench, outcome)
    assert cell.is_told(outcome.told), outcome.told
    if cell.state == "stopping":
        met_in_motion(bench, BEGINS["stopping"])
    count = len(bench.sent)
    if cell.state == "stopping":
        assert outcome.run.reason == "the controller ended the run"
        again = bench.run(Motion(), seconds=0.3)
        judge(bench, again, count)
        assert again.run.reason == "the time is up"
    else:
        assert outcome.run.reason == "the time is up"
    moved = [reply.q for reply, sent in zip(bench.heard(), bench.sent, strict=True) if sent.t > over]
    assert np.ptp(moved, axis=0).min() > 0.01, "it moves again"
    assert not bench.heard()[-1].qd.any(), "and comes to rest"
    assert bench.stations[0].controller.statistics.last_age == 1, "what acts is one cycle old"


@shows
def test_a_bad_network(bench: Bench, cell: Cell) -> None:
    bad = Bad(**cell.given)
    rare = 0.0 < bad.loss <= 0.1 and cell.state != "stopping"
    lasts = LASTS_RARE if rare else LASTS
    at, motion = begin(cell, lasts)
    seed = unlucky(bad, PERIOD) if bad.loss else 7
    station = Station(bad=bad, begin=at, end=at + lasts, seed=seed)
    bench.stations = [station]
    outcome = bench.run(motion, seconds=at + lasts + AFTER)
    lost = station.out.lost, station.back.lost
    goes_on(bench, cell, outcome, at + lasts)
    assert (min(lost) > 0) == (bad.loss > 0.0)


@shows
def test_silence(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell, cell.given)
    bench.stations = [Station(bad=Bad(loss=1.0), begin=at, end=at + cell.given)]
    outcome = bench.run(motion, seconds=at + 1.0)
    goes_on(bench, cell, outcome, at + cell.given)
    events = [event.number for event in bench.stations[0].controller.statistics.events]
    assert events == ([41822] if cell.given > 1.0 else [])
    assert outcome.run.statistics["sessions"] == 1 + (cell.given > 0.5 and cell.state in ("holding", "running"))


@shows
def test_nothing_more_comes(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell, math.inf)
    robot = bench.stations[0]
    bench.at[at] = lambda: setattr(robot, "alive", False)
    outcome = bench.run(motion)
    assert type(outcome.failure).__name__ == cell.given
    assert cell.is_told(outcome.told), outcome.told
    assert bench.now < at + PATIENCE + 0.2
    if cell.state != "waiting":
        judge(bench, outcome)
    count, robot.alive = len(bench.sent), True
    again = bench.run(Motion(), seconds=0.3)
    judge(bench, again, count)
    assert again.run.reason == "the time is up"


@shows
def test_another_port(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell)
    at = at or 2.5 * PERIOD  # the first packets of all
    old = bench.stations[0]

    def change() -> None:
        if cell.given:
            old.move(OTHER)
        else:
            old.alive = False
            bench.stations.append(Station(OTHER, begins_at=bench.now + 6 * PERIOD, q=old.motion[-1][0]))

    bench.at[at] = change
    outcome = bench.run(motion, seconds=at + 1.0)
    bench.stations.reverse()
    goes_on(bench, cell, outcome, at + 0.6)


@shows
def test_two_robots(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell)
    bench.stations.append(Station(OTHER, begins_at=at + 0.3 * PERIOD))
    outcome = bench.run(motion, seconds=at + 1.0)
    goes_on(bench, cell, outcome, at + LASTS)
    answered = bench.sent[: outcome.run.statistics["replies"]]
    assert {sent.to for sent in answered} == {bench.stations[0].source}


@shows
def test_sending_fails(bench: Bench, cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    at, motion = begin(cell, 0.15)
    taken = bench.takes
    bench.takes = lambda: taken() and not at <= bench.now < at + 0.15
    outcome = bench.run(motion, seconds=at + 1.0)
    goes_on(bench, cell, outcome, at + 0.15)
