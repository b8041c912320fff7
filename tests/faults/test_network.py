"""A network that loses, delays, doubles, swaps and damages datagrams, or is silent; in virtual time.

Only what meets a moving arm is in the default tests: the other states are slow tests.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from armlab.errors import NoRobot, SessionEnded

from .bench import PATIENCE, PERIOD, Bad, Bench, Motion, Outcome, Station, unlucky
from .judge import judge, met_in_motion
from .matrix import Cell, cells, shows

ALL = "waiting, holding, running, stopping"
BEGUN = "holding, running, stopping"
LASTS = 0.4  # s, of a fault
LASTS_RARE = 2.0  # s, of one that would not come in both directions else
BEGINS = {"waiting": 0.0, "holding": 0.3, "running": 0.3, "stopping": 0.3}
AFTER = 0.3  # s of motion when it is over
GAP = "what comes is answered; a gap allows no larger step"
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


@shows(
    *(
        cells("network", f"loss of {share} %", ALL, GAP, "missed N, late", "at once", Bad(loss=0.01 * share))
        for share in (1, 10, 50)
    ),
    cells("network", "loss of 10 %, ten in a row", ALL, GAP, "missed N, late", "at once", Bad(loss=0.1, burst=10)),
    cells("network", "delay of 1 ms", ALL, "references act as soon as without", "–", "at once", Bad(delay=1e-3)),
    *(
        cells(
            "network",
            f"delay of {delay} ms",
            ALL,
            "references act later by there and back",
            "Left out N replies",
            "at once; with the extension nothing stays in the robot's queue",
            Bad(delay=1e-3 * delay),
        )
        for delay in (10, 50)
    ),
    cells(
        "network",
        "jitter of 5 ms",
        ALL,
        "of packets that come out of order the newest is answered, the others are dropped",
        "Dropped a datagram from …, old: packet",
        "at once",
        Bad(delay=5e-3, jitter=5e-3),
    ),
    cells(
        "network",
        "half of the datagrams twice",
        ALL,
        "the second of two packets is not answered",
        "Dropped a datagram from …, duplicate: …",
        "at once; with the extension nothing stays in the robot's queue",
        Bad(duplicate=0.5),
    ),
    cells(
        "network",
        "half of the datagrams out of order",
        ALL,
        "a packet behind its successor is not answered",
        "Dropped a datagram from …, old: packet …",
        "at once",
        Bad(reorder=0.5),
    ),
    cells(
        "network",
        "half of the datagrams damaged",
        ALL,
        "what cannot be read is not answered",
        "Dropped a datagram from …, unparsable: …",
        "at once",
        Bad(corrupt=0.5),
    ),
)
def test_a_bad_network(bench: Bench, cell: Cell) -> None:
    rare = 0.0 < cell.given.loss <= 0.1 and cell.state != "stopping"
    lasts = LASTS_RARE if rare else LASTS
    at, motion = begin(cell, lasts)
    seed = unlucky(cell.given, PERIOD) if cell.given.loss else 7
    station = Station(bad=cell.given, begin=at, end=at + lasts, seed=seed)
    bench.stations = [station]
    outcome = bench.run(motion, seconds=at + lasts + AFTER)
    lost = station.out.lost, station.back.lost
    goes_on(bench, cell, outcome, at + lasts)
    assert (min(lost) > 0) == (cell.given.loss > 0.0)


@shows(
    cells("network", "silence of 0.3 s", "waiting", "the robot is waited for", "Session 1 began", "at once", 0.3),
    cells("network", "silence of 0.3 s", BEGUN, GAP, "missed N, late", "at once", 0.3),
    cells("network", "silence of 2.5 s", "waiting", "the robot is waited for", "Session 1 began", "at once", 2.5),
    cells(
        "network",
        "silence of 2.5 s",
        "holding, running",
        "the session is over after 0.5 s; the next one begins where the arm is",
        "Session 1 ended: …",
        "with the next packet",
        2.5,
    ),
    cells(
        "network",
        "silence of 2.5 s",
        "stopping",
        "the run ends, as nothing more can be sent; the robot's own time-out stops the arm",
        "Session 1 ended: …",
        "the next run",
        2.5,
    ),
)
def test_silence(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell, cell.given)
    bench.stations = [Station(bad=Bad(loss=1.0), begin=at, end=at + cell.given)]
    outcome = bench.run(motion, seconds=at + 1.0)
    goes_on(bench, cell, outcome, at + cell.given)
    events = [event.number for event in bench.stations[0].controller.statistics.events]
    assert events == ([41822] if cell.given > 1.0 else [])
    assert outcome.run.statistics["sessions"] == 1 + (cell.given > 0.5 and cell.state in ("holding", "running"))


@shows(
    cells(
        "network",
        "silence for ever",
        "waiting",
        "the run ends after `patience`",
        "Expected packets from a robot within 5 s, but none came. Listening on … Check that …",
        "the next run, once packets come",
        NoRobot,
    ),
    cells(
        "network",
        "silence for ever",
        "holding, running",
        "the run ends after `patience`",
        "Expected another packet within 5 s, but none came: …",
        "the next run, once packets come",
        SessionEnded,
    ),
    cells(
        "network",
        "silence for ever",
        "stopping",
        "the run ends after 0.5 s",
        "Session 1 ended: …",
        "the next run, once packets come",
        type(None),
    ),
)
def test_nothing_more_comes(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell, math.inf)
    robot = bench.stations[0]
    bench.at[at] = lambda: setattr(robot, "alive", False)
    outcome = bench.run(motion)
    assert type(outcome.failure) is cell.given
    assert cell.is_told(outcome.told), outcome.told
    assert bench.now < at + PATIENCE + 0.2
    if cell.state != "waiting":
        judge(bench, outcome)
    count, robot.alive = len(bench.sent), True
    again = bench.run(Motion(), seconds=0.3)
    judge(bench, again, count)
    assert again.run.reason == "the time is up"


@shows(
    cells(
        "network",
        "the robot restarts from another port",
        "waiting, holding, running",
        "its session is taken over after five periods, and begins where the arm is",
        "Session 2 began: …, 127.0.0.1:50002",
        "at once",
        0,
    ),
    cells(
        "network",
        "the robot restarts from another port",
        "stopping",
        "the arm goes on coming to rest from where it is",
        "Session 2 began: …, 127.0.0.1:50002",
        "the next run",
        0,
    ),
    cells(
        "network",
        "the robot goes on from another port",
        "waiting, holding, running",
        "it is not answered until the old port was silent for 0.5 s",
        "Dropped a datagram from 127.0.0.1:50002, foreign source: …",
        "at once",
        1,
    ),
    cells(
        "network",
        "the robot goes on from another port",
        "stopping",
        "the run ends after 0.5 s; the robot's own time-out stops the arm",
        "Dropped a datagram from 127.0.0.1:50002, foreign source: …",
        "the next run",
        1,
    ),
)
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


@shows(
    cells(
        "network",
        "two robots at one port",
        ALL,
        "the first that spoke is answered, the second never",
        "Dropped a datagram from 127.0.0.1:50002, foreign source: …each motion task needs its own port",
        "nothing to recover",
    )
)
def test_two_robots(bench: Bench, cell: Cell) -> None:
    at, motion = begin(cell)
    bench.stations.append(Station(OTHER, begins_at=at + 0.3 * PERIOD))
    outcome = bench.run(motion, seconds=at + 1.0)
    goes_on(bench, cell, outcome, at + LASTS)
    answered = bench.sent[: outcome.run.statistics["replies"]]
    assert {sent.to for sent in answered} == {bench.stations[0].source}


@shows(
    cells(
        "network",
        "the system refuses to send",
        BEGUN,
        "the reference stays where it was sent last, and goes on from there",
        "A reply to 127.0.0.1:50001 did not go out: the system refused it.",
        "at once",
    )
)
def test_sending_fails(bench: Bench, cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    at, motion = begin(cell, 0.15)
    taken = bench.takes
    bench.takes = lambda: taken() and not at <= bench.now < at + 0.15
    outcome = bench.run(motion, seconds=at + 1.0)
    goes_on(bench, cell, outcome, at + 0.15)
