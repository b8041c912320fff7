"""The bridge and the simulated controller under every fault: the arm stays within limits, and the log is complete."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.sim.channel import Channel
from armlab.sim.controller import Controller
from armlab.sim.faults import FaultRates, Faults
from armlab.sim.guidance import Settings
from armlab.sim.lagging import LaggingArm
from armlab.sim.loop import Pace, run
from armlab.state import Command, State
from armlab.wire.egm import RobotSideCodec

ROBOT = robots.load("yumi_right")
PERIOD = 0.024192  # SampleRate 24: six times as fast to test as 4
SECONDS, UNTIL = 60.0, 57.0  # the last seconds are clean: what is left of the faults then?
SHARES = (0.01, 0.1, 0.5)
FAULTS: dict[str, Any] = {
    "loss": lambda p: FaultRates(loss=p, until=UNTIL),
    "burst": lambda p: FaultRates(loss=p, burst=10, until=UNTIL),
    "duplicate": lambda p: FaultRates(duplicate=p, until=UNTIL),
    "reorder": lambda p: FaultRates(reorder=p, until=UNTIL),
    "corrupt": lambda p: FaultRates(corrupt=p, until=UNTIL),
    "delay": lambda p: FaultRates(delay=(p * PERIOD, 0.5 * PERIOD), until=UNTIL),
    "pause": lambda p: FaultRates(pause=(5.0, p * SECONDS), until=UNTIL),
}


def sway(state: State) -> Command:
    """Velocities, so that time that was lost is no jump of the position."""
    goal = state.q_start + 0.2 * (1.0 - np.cos(2.0 * state.t))
    return Command(qd=0.4 * np.sin(2.0 * state.t) + 0.5 * (goal - state.q))


@pytest.fixture(autouse=True)
def quick_switches() -> Iterator[None]:
    """Two threads that take turns: neither shall wait for the other's time slice."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)
    yield
    sys.setswitchinterval(before)


def play(outgoing: FaultRates | None, incoming: FaultRates | None, seconds: float = SECONDS) -> tuple[Any, Controller]:
    """Run bridge and controller against each other in two threads."""
    settings = Settings(period=PERIOD)
    controller = Controller(LaggingArm(ROBOT, PERIOD), RobotSideCodec(ROBOT, extension=True), settings)
    ways = [Faults(rates, [7, i], PERIOD) if rates else None for i, rates in enumerate((outgoing, incoming))]
    done = threading.Event()
    with bridge.connect("egm://127.0.0.1:0", ROBOT, extension=True, clock="robot", patience=20.0) as link:
        channel = Channel(controller, "127.0.0.1", link.port, *ways)
        endless = Pace(lockstep=True, patience=0.5)
        thread = threading.Thread(target=lambda: run([channel], endless, alive=lambda: not done.is_set()), daemon=True)
        thread.start()
        found = link.run(sway, seconds=seconds, wait="block")
        done.set()
        thread.join(30.0)
    return found, controller


def check(found: Any, controller: Controller) -> None:
    table, counted = found.table, found.statistics
    assert found.reason == "the time is up"
    assert not controller.dead
    assert counted["replies"] + counted["overtaken"] <= counted["packets"] == len(table), "every packet has its row"
    q, sent = table["q"], table["q_sent"][np.isfinite(table["q_sent"]).all(axis=1)]
    assert ((q > ROBOT.q_min) & (q < ROBOT.q_max)).all()
    assert np.abs(np.diff(sent, axis=0)).max() <= ROBOT.qd_max.max() * 1.5 * PERIOD
    assert np.ptp(sent, axis=0).min() > 0.3, "it moved"


@pytest.mark.parametrize("fault", FAULTS)
def test_a_reference_is_one_cycle_old_again_after_faults_of_the_packets(fault: str) -> None:
    """Overtaken packets get no reply, so nothing is left in the queue of the controller."""
    rates = replace(FAULTS[fault](0.5), until=4.0, pause=(1.0, 0.5) if fault == "pause" else (0.0, 0.0))
    found, controller = play(rates, None, 6.0)
    assert found.reason == "the time is up"
    assert controller.statistics.last_age == 1
    assert len(controller.inbox) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_for_a_minute(fault: str) -> None:
    """1, 10 and 50 % of the datagrams in both directions; all seven faults together take half a minute."""
    for share in SHARES:
        check(*play(FAULTS[fault](share), FAULTS[fault](share)))
