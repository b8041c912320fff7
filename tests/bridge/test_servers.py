"""Server processes: started, watched, started again, left dead; and the loop does not notice."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from armlab import robots
from armlab.bridge.feed import Exchange
from armlab.bridge.servers import PLACE, RESTARTS, Servers, server_command

LEFT = robots.load("yumi_left")
QUIET = (
    'import socket,sys; s=socket.socket(fileno=int(sys.argv[1])); s.send(b\'{"kind":"listening","where":["here"]}\')\n'
)
WAITS = QUIET + "while s.recv(100000): pass"
FAILS = "import sys; sys.stderr.write('no luck'); sys.exit(3)"


def command(program: str) -> list[str]:
    return [sys.executable, "-S", "-c", program, PLACE]


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_server_listens_and_ends_with_the_bridge() -> None:
    exchange = Exchange([LEFT], ["a"])
    with Servers(exchange, {"a": command(WAITS)}) as servers:
        assert servers.ready() == ["here"]
        pid = servers.processes()["a"]
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    servers.close()


def test_a_killed_server_starts_again() -> None:
    exchange = Exchange([LEFT], ["a"])
    told: list[str] = []
    exchange.begin(lambda text, warn=False: told.append(text))
    with Servers(exchange, {"a": command(WAITS)}, restarts=(0.01, 0.01)) as servers:
        servers.ready()
        first = servers.processes()["a"]
        os.kill(first, signal.SIGKILL)
        until(lambda: servers.processes().get("a", first) != first)
        assert servers.ready() == ["here"]
        until(lambda: bool(told))
    assert told[0] == "The server a ended with status -9. It starts again in 0.01 s. It said: nothing"


def test_a_server_that_fails_is_left_dead() -> None:
    exchange = Exchange([LEFT], ["a"])
    told: list[str] = []
    exchange.begin(lambda text, warn=False: told.append(text))
    with Servers(exchange, {"a": command(FAILS)}, restarts=(0.01, 0.01)) as servers:
        assert servers.ready() == ["a: not listening (no luck)"]
        assert servers.dead == {"a"}
        until(lambda: len(told) == 3)
    assert told[-1] == "The server a ended with status 3. It stays dead; the loop goes on. It said: no luck"


def test_a_program_that_is_not_there() -> None:
    with Servers(Exchange([LEFT], ["a"]), {"a": ["/no/such/program"]}, restarts=()) as servers:
        assert servers.ready() == ["a: not listening ([Errno 2] No such file or directory: '/no/such/program')"]


def test_times_and_command() -> None:
    assert RESTARTS == (1.0, 5.0, 30.0)
    assert server_command("local", {"path": "x"})[-3:] == ["local", PLACE, '{"path": "x"}']


def test_no_server_outlives_a_bridge_that_is_killed(tmp_path: Path) -> None:
    """The system closes its end of the socket; the server removes its own socket when it ends."""
    path = tmp_path / "x"
    program = f"""
import time
from armlab import robots
from armlab.bridge.feed import Exchange
from armlab.bridge.servers import Servers, server_command

command = server_command("local", {{"path": "{path}"}})
with Servers(Exchange([robots.load("ur5e")], ["local"]), {{"local": command}}) as servers:
    print(*servers.ready(60.0), flush=True)
    time.sleep(60.0)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as bridge:
        assert bridge.stdout is not None
        assert bridge.stdout.readline() == f"{path} (local)\n"
        assert path.exists()
        bridge.kill()
    until(lambda: not path.exists())
