"""The simulated robot as a process."""

from __future__ import annotations

import select
import time

import pytest

from armlab.bridge.port import Port
from armlab.bridge.simulator import Simulator
from armlab.errors import LinkError

PATIENCE = 30.0


def wait_until_gone(simulator: Simulator) -> str:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        reason = simulator.gone()
        if reason:
            return reason
        time.sleep(0.02)
    raise TimeoutError


def test_it_sends_and_is_stopped() -> None:
    port = Port("127.0.0.1", 0)
    simulator = Simulator(["yumi_right"], [port.port], {"lockstep": "true", "seed": "3"})
    try:
        assert select.select([port], [], [], PATIENCE)[0]
        assert simulator.gone() == ""
    finally:
        simulator.stop()
        port.close()
    assert "interrupted" in " ".join(simulator.lines)


def test_an_end_in_time_is_no_error() -> None:
    port = Port("127.0.0.1", 0)
    simulator = Simulator(["yumi_right"], [port.port], {"seconds": "0.05", "lockstep": "false"})
    try:
        assert wait_until_gone(simulator) == "the simulated robot ended"
    finally:
        simulator.stop()
        port.close()


def test_an_early_death_is_quoted() -> None:
    simulator = Simulator(["no_such_robot"], [9], {})
    try:
        with pytest.raises(LinkError, match=r"armlab sim no_such_robot .* status .*no_such_robot.*yumi_right"):
            wait_until_gone(simulator)
    finally:
        simulator.stop()
