"""The simulated robot as a process."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from armlab.bridge.link import Simulator
from armlab.bridge.net.sockets import Port
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


_DIES_AT_ONCE = """
import os, sys
from armlab.bridge.link import Simulator
print(Simulator(["yumi_right"], [int(sys.argv[1])], {})._process.pid, flush=True)
os._exit(0)
"""


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="tells living processes by /proc")
def test_it_does_not_outlive_a_bridge_that_dies_while_it_starts() -> None:
    """The bridge is gone long before the simulator can look who started it."""
    port = Port("127.0.0.1", 0)
    command = [sys.executable, "-c", _DIES_AT_ONCE, str(port.port)]
    number = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE).stdout.strip()
    deadline = time.monotonic() + PATIENCE
    try:
        while _command_of(number) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not _command_of(number), "the simulator lives on without its bridge"
        assert not select.select([port], [], [], 0.0)[0], "it never spoke"
    finally:
        port.close()
        if _command_of(number):
            os.kill(int(number), signal.SIGKILL)


def _command_of(number: str) -> str:
    """Return the command of our process, "" when it is gone or only waits to be buried."""
    try:
        command = Path(f"/proc/{number}/cmdline").read_text(encoding="utf-8")
    except OSError:
        return ""
    return command if "armlab" in command else ""
