"""Server processes: start, supervision, restart and giving up, without any effect on the loop."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge import connect
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.labcomm.process import labcomm_options
from armlab.bridge.servers.local import LocalFeed, cells
from armlab.bridge.servers.messages import CommandRequest, Stop, Subscribe
from armlab.bridge.servers.row import Row
from armlab.bridge.servers.serve import SERVERS, serve
from armlab.bridge.servers.supervisor import PLACE, Servers
from armlab.errors import LinkError
from armlab.robots import Robot
from armlab.state import Command, State

from .conftest import until

LEFT = robots.load("yumi_left")
QUIET = (
    'import socket,sys; s=socket.socket(fileno=int(sys.argv[1])); s.send(b\'{"kind":"listening","where":["here"]}\')\n'
)
WAITS = QUIET + "while s.recv(100000): pass"
FAILS = "import sys; sys.stderr.write('no luck'); sys.exit(3)"


def command(program: str) -> list[str]:
    return [sys.executable, "-S", "-c", program, PLACE]


def watched(*names: str) -> tuple[Hub, list[str]]:
    exchange, told = Hub([LEFT], names), list[str]()
    exchange.begin(lambda text, *_: told.append(text))
    return exchange, told


def test_a_server_listens_and_ends_with_the_bridge() -> None:
    exchange = Hub([LEFT], ["a"])
    with Servers(exchange, {"a": command(WAITS)}) as servers:
        assert servers.ready() == ["here"]
        pid = servers.processes()["a"]
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    servers.close()


def test_a_server_that_fails_is_left_dead() -> None:
    exchange, told = watched("a")
    program = QUIET + "while b'Now.' not in s.recv(100000): pass\n" + FAILS
    with Servers(exchange, {"a": command(program)}, restarts=(0.01,)) as servers:
        for ends in range(2):
            assert servers.ready() == ["here"]
            exchange.event("Now.")
            until(lambda ends=ends: len(told) > ends)
        assert servers.dead == {"a"}
    says = "The server a ended with status 3. The server is not restarted; the loop continues. Its output: no luck"
    assert told[-1] == says


@pytest.mark.parametrize(
    ("well", "outcome"), [(0.0, "The server restarts in 0.01 s."), (1e6, "The server is not restarted")]
)
def test_a_server_that_ran_well_begins_a_new_series(well: float, outcome: str) -> None:
    exchange, told = watched("a")
    with Servers(exchange, {"a": command(WAITS)}, restarts=(0.01,), well=well) as servers:
        for ends in range(2):
            assert servers.ready(60.0) == ["here"]
            until(lambda: servers._children[0].since is not None)
            os.kill(servers.processes()["a"], signal.SIGKILL)
            until(lambda ends=ends: len(told) > ends)
        assert servers.dead == (set() if well == 0.0 else {"a"})
    assert told[0] == "The server a ended with status -9. The server restarts in 0.01 s. Its output: nothing"
    assert outcome in told[-1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (command(FAILS), "ended with status 3. Its output: no luck"),
        (["/no/such/program"], "could not be started. Its output: [Errno 2] No such file"),
    ],
)
def test_a_server_that_never_listens_refuses_at_once(words: list[str], said: str) -> None:
    with Servers(Hub([LEFT], ["a"]), {"a": words}) as servers:
        began = time.monotonic()
        with pytest.raises(LinkError, match=re.escape(f"Expected the server a to listen, but it {said}")):
            servers.ready(60.0)
        assert time.monotonic() - began < 30.0


@pytest.mark.parametrize("name", SERVERS)
def test_a_loop_that_has_gone_before_it_described_its_rows_ends_a_server(name: str, tmp_path: Path) -> None:
    where = {"host": "127.0.0.1", "port": 0, "to": "127.0.0.1", "domain": 0, "distribution": "jazzy", "router": ""}
    options = {**where, "lab": "lab", "dialect": "ros2", "fields": None, "master": "http://127.0.0.1:1", "python": "p"}
    hub = Hub([LEFT], [name], about={"cell": "yumi"})
    feed = hub.open(name)
    feed.recv(2**17)
    hub.close()
    with feed, pytest.raises(LinkError, match="Start the bridge again"):
        serve(name, feed, {**labcomm_options([LEFT]), **options, "path": tmp_path / "x"})
    assert not (tmp_path / "x").exists()


def test_a_server_that_says_nothing() -> None:
    with Servers(Hub([LEFT], ["a"]), {"a": command("import time; time.sleep(60)")}) as servers:
        with pytest.raises(LinkError, match=r"Expected a to listen within 0.2 s"):
            servers.ready(0.2)
        os.kill(servers.processes()["a"], signal.SIGKILL)


def test_an_error_of_the_watch_does_not_end_it(monkeypatch: pytest.MonkeyPatch) -> None:
    exchange, told = watched("a", "b")
    look, idle, broken = Servers._check, exchange.idle, [False]

    def fail(servers: Servers, child: Any) -> None:
        if broken[0] and child.name == "a":
            raise RuntimeError("odd")
        look(servers, child)

    def fail_to_idle(longer_ns: int) -> None:
        if broken[0]:
            broken[0] = len(told) < 3
            idle(0)
            raise ValueError("also odd")
        idle(longer_ns)

    monkeypatch.setattr(Servers, "_check", fail)
    monkeypatch.setattr(exchange, "idle", fail_to_idle)
    with Servers(exchange, {"a": command(WAITS), "b": command(WAITS)}, restarts=(0.01,)) as servers:
        servers.ready()
        other = servers.processes()["b"]
        broken[0] = True
        until(lambda: not broken[0])
        os.kill(other, signal.SIGKILL)
        until(lambda: any("The server b ended with status -9" in text for text in told))
    assert "The server a could not be supervised. The server restarts in 0.01 s. Its output: RuntimeError: odd" in told
    assert sum("The server a" in text for text in told) == 2
    assert any("Client requests could not be handled: ValueError: also odd" in text for text in told)


def test_no_server_outlives_a_bridge_that_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "x"
    program = f"""
import time
from armlab import robots
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.supervisor import Servers, server_command

command = server_command("local", {{"path": "{path}"}})
with Servers(Hub([robots.load("ur5e")], ["local"]), {{"local": command}}) as servers:
    print(*servers.ready(60.0), flush=True)
    time.sleep(60.0)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as bridge:
        assert bridge.stdout is not None
        assert bridge.stdout.readline() == f"{path} (local)\n"
        assert path.exists()
        bridge.kill()
    until(lambda: not path.exists())


MESSAGES = 2000  # maximum number of messages until a row arrives


@pytest.mark.slow
def test_rows_of_a_link_are_offered_and_a_stop_holds_it(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with connect(f"sim://{robot.name}?lockstep=true", robot, offer="small") as link, LocalFeed() as feed:
        assert link._offering is not None
        exchange = link._offering.exchange
        assert cells() == ["small"]
        feed.ask(Subscribe(rate=None))
        feed.ask(CommandRequest(arm=robot.name, qd=[0.1] * 7))
        answers: list[str] = []

        def heard(true: Callable[[Any], bool]) -> Any:
            while not true(message := feed.receive()):
                pass
            return message

        def controller(state: State) -> Command:
            if len(answers) < 1 and state.t > 0.1:
                exchange.poll()
                answers.append(heard(lambda message: isinstance(message, dict) and message["kind"] == "answer")["text"])
                feed.ask(Stop())
                while not exchange.arbiter.stopped:
                    exchange.poll()
            return Command(qd=np.full(7, 0.05))

        run = link.run(controller, seconds=0.6)
        assert f"{robot.name}.q" in heard(lambda message: isinstance(message, Row)).values
    assert "the controller of the run" in answers[0], "who holds the arm"
    sent = run.table["qd_sent"]
    assert sent.max() > 0.04
    assert np.abs(sent[-10:]).max() < 1e-9, "the arm came to rest and held"
    assert cells() == []


@pytest.mark.slow
def test_who_only_listens_offers_what_it_hears(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with connect(f"sim://{robot.name}", robot, offer="small") as link, LocalFeed() as feed:
        feed.ask(Subscribe(rate=None))
        for _ in range(2):
            link.run(None, seconds=0.05)
            for _ in range(MESSAGES):
                message = feed.receive()
                if isinstance(message, Row):
                    break
            else:
                pytest.fail("no row came")
        with pytest.raises(LinkError, match="Expected the server local to listen"):
            connect("egm://127.0.0.1:0", robot, offer="small")
        assert cells() == ["small"]
