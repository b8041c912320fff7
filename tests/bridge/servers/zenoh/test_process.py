"""The Zenoh server: rows and events go out, commands, parameters and stops come back; and in whole cells."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.cell import parse_cell
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.row import RowSchema, read_row
from armlab.bridge.servers.supervisor import Servers, server_command
from armlab.bridge.servers.zenoh.feed import robots_at
from armlab.bridge.servers.zenoh.messages import Attachment, key
from armlab.bridge.servers.zenoh.session import LabAddress, close_session, queried
from armlab.errors import LinkError
from armlab.robots import Robot

from ....processes import free_port
from ..conftest import PATIENCE, play, until
from .conftest import Running

ME, OTHER = bytes(range(16)), bytes(range(100, 116))
Start = Callable[..., Running]
Open = Callable[..., Any]


def attached(seq: int, sender: bytes = ME) -> bytes:
    return Attachment(sender, seq, 5).pack()


def heard(session: Any, name: str) -> list[Any]:
    """Return a list that fills with the samples of a key."""
    samples: list[Any] = []
    session.declare_subscriber(name, lambda sample: samples.append(sample))
    return samples


def test_rows_go_out_under_three_keys_with_the_schema_beside(start: Start, session: Open, robot: Robot) -> None:
    one = start()
    reader = session(one.options["port"])
    found = {what: heard(reader, key("lab1", robot.name, what)) for what in ("state", "live", "view", "status")}
    ((_, text),) = queried(reader, key("lab1", "*", "schema"), 5.0)
    schema = RowSchema.read(text)
    assert schema.id == one.exchange.schema.id
    until(lambda: one.row() and all(found.values()))
    row = read_row(schema, found["live"][0].payload.to_bytes())
    assert np.array_equal(row.values[f"{robot.name}.q"], robot.q_home)
    first = len(found["view"]), len(found["live"])
    last = one.tick
    until(lambda: one.row() and one.tick > last + 200)
    until(lambda: len(found["live"]) >= first[1] + 200 and len(found["state"]) >= 200)
    assert len(found["view"]) - first[0] < 100, "views get 30 rows a second"
    numbers = [struct.unpack_from("<Q", sample.payload.to_bytes(), 16)[0] for sample in found["state"]]
    assert np.array_equal(np.diff(numbers), np.ones(len(numbers) - 1)), "a recorder gets every row, in order"
    assert json.loads(found["status"][0].payload.to_bytes())["kind"] == "status"
    assert robots_at(reader) == [("lab1", robot.name)]
    clients = one.exchange.summary()["servers"]["zenoh"]["clients"]
    sent, dropped = clients[f"{robot.name} live"]
    assert (sent >= len(found["live"]), dropped) == (True, 0)


def test_a_command_comes_back_and_a_second_commander_gets_a_sentence(start: Start, session: Open, robot: Robot) -> None:
    one = start()
    mine, others = session(one.options["port"]), session(one.options["port"])
    answers = heard(others, key("lab1", robot.name, "answer/*"))
    where, wanted = key(*("lab1", robot.name), "command/position"), np.asarray(robot.q_home) + 0.01
    count = iter(range(10**6))

    def commanded() -> bool:
        mine.put(where, wanted.tobytes(), attachment=attached(next(count)))
        command = one.commanded()
        return command is not None and np.array_equal(command.q, wanted)

    until(commanded)
    assert one.exchange.arbiter.commander(robot.name) == f"zenoh {ME.hex()}"

    def refused() -> bool:
        others.put(where, (wanted + 0.01).tobytes(), attachment=attached(1, OTHER))
        return commanded() and bool(answers)

    until(refused)
    assert "is commanded by zenoh" in answers[0].payload.to_string()
    assert str(answers[0].key_expr).endswith(OTHER.hex())


NO_COMMANDS = [
    ("position", b"1234567", attached(1), "8 bytes each, got 7 bytes"),
    ("position", bytes(8 * 65), attached(1), "1 to 64 numbers for .*, got 520 bytes"),
    ("position", b"", attached(1), "got 0 bytes"),
    ("position", bytes(8 * 200), attached(1), "got 1600 bytes"),
    ("motion", bytes(8 * 7), attached(1), "as many velocities as positions"),
    ("jump", bytes(56), attached(1), "one of position, velocity, effort, motion, got 'jump'"),
    ("position", bytes(56), None, "32 bytes attached.*got none"),
    ("position", bytes(56), b"short", "got 5 bytes"),
    ("position", bytes(8 * 6), attached(1), "7"),
    ("position", np.full(7, np.nan).tobytes(), attached(1), "finite"),
    ("effort", bytes(56), attached(1), "torque"),
]


def test_what_is_no_command_gets_a_sentence(start: Start, session: Open, robot: Robot) -> None:
    one = start()
    mine = session(one.options["port"])
    answers, told = heard(mine, key("lab1", robot.name, "answer/*")), []
    one.exchange.begin(lambda text, *_: told.append(text))
    for kind, data, attachment, words in NO_COMMANDS:

        def refused(kind: str = kind, data: bytes = data, attachment: Any = attachment, words: str = words) -> bool:
            mine.put(key("lab1", robot.name, f"command/{kind}"), data, attachment=attachment)
            assert one.commanded() is None
            is_told = any(re.search(f"zenoh .*{words}", text) for text in told)
            return is_told and any(re.search(words, answer.payload.to_string()) for answer in answers)

        answers.clear()
        one.exchange.arbiter._answered.clear()  # each is answered at once
        until(refused)


def test_parameters_are_read_set_and_echoed(start: Start, session: Open, robot: Robot) -> None:
    one = start()
    mine = session(one.options["port"])
    gain = key("lab1", robot.name, "param/gain")
    echoes, answers = (heard(mine, key("lab1", robot.name, what)) for what in ("parameters", "answer/*"))
    ((_, text),) = queried(mine, gain, 5.0)
    assert (json.loads(text)["value"], json.loads(text)["maximum"]) == (0.5, 1.0)
    assert len(queried(mine, key("lab1", robot.name, "param/*"), 5.0)) == 2
    until(lambda: mine.put(gain, "0.75") or one.exchange.poll() or echoes)
    assert one.exchange.parameters.gain == 0.75
    told = {about["name"]: about for about in json.loads(echoes[0].payload.to_bytes())["parameters"]}
    assert (told["gain"]["value"], told["gain"]["who"]) == (0.75, "zenoh unknown")
    for value, words in (("7.0", "at most"), ("no JSON", "as JSON")):
        answers.clear()
        until(lambda value=value: mine.put(gain, value) or one.exchange.poll() or answers)
        assert words in answers[-1].payload.to_string() or "1" in answers[-1].payload.to_string()
    assert one.exchange.parameters.gain == 0.75


def test_a_stop_of_anybody_and_events(start: Start, session: Open, robot: Robot) -> None:
    one = start()
    mine = session(one.options["port"])
    events = heard(mine, key("lab1", robot.name, "events"))
    until(lambda: one.exchange.event("Hello.") or events)
    assert json.loads(events[0].payload.to_bytes())["text"] == "Hello."
    until(lambda: mine.put(key("lab1", robot.name, "stop"), b"") or one.exchange.poll() or one.exchange.arbiter.stopped)
    assert one.exchange.arbiter.stopped == "zenoh unknown"
    answers = heard(mine, key("lab1", robot.name, f"answer/{ME.hex()}"))
    stop = key("lab1", robot.name, "stop")
    until(lambda: mine.put(stop, b"", attachment=attached(1)) or one.exchange.poll() or answers)
    assert answers[0].payload.to_string() == "Done."


def test_two_servers_at_one_port_share_the_router_and_a_restart_of_it_is_survived(
    start: Start, session: Open, robot: Robot
) -> None:
    left = robots.load("yumi_left")
    port = free_port()
    first, second = start(port), start(port, robot=left)
    assert "zenoh router" in str(first.exchange.outlets["zenoh"].where)
    assert "through the router" in str(second.exchange.outlets["zenoh"].where)
    reader = session(port)
    rows = heard(reader, key("lab1", left.name, "live"))
    until(lambda: second.row() and rows)
    until(lambda: len(robots_at(reader, "lab1")) == 2)
    first.exchange.close()
    first.thread.join(10.0)
    again = start(port)
    late = session(port)
    until(lambda: again.row() and len(robots_at(late, "lab1")) == 2)
    rows_again = heard(late, key("lab1", left.name, "live"))
    until(lambda: second.row() and rows_again)
    rows.clear()
    until(lambda: second.row() and rows)


@pytest.mark.slow
def test_a_port_that_something_else_holds(robot: Robot) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        exchange = Hub([robot], ["zenoh"])
        options = {"lab": "lab", "host": "127.0.0.1", "port": taken.getsockname()[1]}
        with (
            pytest.raises(LinkError, match="something else holds it"),
            Servers(exchange, {"zenoh": server_command("zenoh", options)}) as servers,
        ):
            servers.ready(30.0)


def test_it_is_one_of_the_bridge_s_servers(robot: Robot) -> None:
    """As a process, which ends with the loop."""
    exchange = Hub([robot], ["zenoh"])
    port = free_port()
    options = {"lab": "lab", "host": "127.0.0.1", "port": port}
    with Servers(exchange, {"zenoh": server_command("zenoh", options)}) as servers:
        assert servers.ready() == [f"tcp/127.0.0.1:{port} (zenoh router), armlab/lab"]
        (process,) = servers._children
        running = process.process
    assert running is not None
    assert running.returncode == 0


CELL = """
commands = ["zenoh"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[servers.zenoh]
port = {port}
"""


class Client:
    """Rows of the arm as they come, and commands to it."""

    def __init__(self, port: int, sender: bytes) -> None:
        self.session, self.sender, self.seq = LabAddress("127.0.0.1", port).open(), sender, 0
        ((_, text),) = queried(self.session, key("lab", "yumi_left", "schema"), PATIENCE)
        self.schema, self.rows, self.answers = RowSchema.read(text), [], []
        for name, found in (("live", self.rows), ("answer/*", self.answers)):
            self.session.declare_subscriber(key("lab", "yumi_left", name), found.append)

    def last(self) -> Any:
        return read_row(self.schema, self.rows[-1].payload.to_bytes()).values

    def command(self, q: np.ndarray) -> None:
        self.seq += 1
        attached = Attachment(self.sender, self.seq, 0).pack()
        self.session.put(key("lab", "yumi_left", "command/position"), q.tobytes(), attachment=attached)


@pytest.mark.slow  # 3 s: a whole bridge in real time
def test_a_client_moves_the_arm_and_another_may_only_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    port, moved = free_port(), []

    def script() -> None:
        clients = [Client(port, sender) for sender in (b"a" * 16, b"b" * 16)]
        one, other = clients
        until(lambda: one.rows and one.last()["yumi_left.mci"] == 3)
        start = one.last()["yumi_left.q"]
        steps = iter(range(1, 10**6))

        def commanded() -> bool:
            step = next(steps)
            one.command(start + 0.02 * min(step / 100, 1.0) * np.eye(7)[3])
            if one.last()["yumi_left.commander"] == "zenoh 61616161616161616161616161616161" and not other.answers:
                other.command(start)  # not when the first has lost the arm: it was late, and this one would keep it
            moved.append(one.last()["yumi_left.q"][3] - start[3])
            return moved[-1] > 0.018 and bool(other.answers)

        until(commanded)
        assert (
            "is commanded by zenoh 61616161616161616161616161616161. You may read."
            in other.answers[0].payload.to_string()
        )
        assert one.last()["yumi_left.commander"] == "zenoh 61616161616161616161616161616161"
        for client in clients:
            close_session(client.session)

    run = play(monkeypatch, parse_cell(CELL.format(port=port)), script)
    assert max(moved) > 0.018
    clients = run.statistics["zenoh" if "zenoh" in run.statistics else "servers"]
    assert "yumi_left live" in str(clients)


STOPPED = """
import sys, time
from armlab.bridge.servers.zenoh.session import LabAddress
from armlab.bridge.servers.zenoh.messages import key
session = LabAddress("127.0.0.1", int(sys.argv[1])).open()
session.declare_subscriber(key("lab", "yumi_left", "*"), lambda sample: print("row", flush=True))
time.sleep(600)
"""


@pytest.mark.slow
def test_a_reader_that_stands_still_disturbs_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reads every key and is stopped by a signal for 15 s, longer than its buffers last; then it is killed."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    port, gaps = free_port(), []

    def script() -> None:
        client = Client(port, b"a" * 16)
        until(lambda: client.rows)
        reader = subprocess.Popen([sys.executable, "-c", STOPPED, str(port)], stdout=subprocess.PIPE)
        assert reader.stdout is not None
        assert reader.stdout.readline() == b"row\n"
        os.kill(reader.pid, signal.SIGSTOP)
        ticks = [client.last()["yumi_left.tick"]]
        end = ticks[0] + 15 * 250
        del client.rows[:]

        until(lambda: client.rows and client.last()["yumi_left.tick"] >= end, patience=120.0)
        numbers = [read_row(client.schema, row.payload.to_bytes()).values["yumi_left.tick"] for row in client.rows]
        gaps.extend(np.diff(numbers).tolist())
        os.kill(reader.pid, signal.SIGCONT)
        reader.kill()
        reader.wait()
        reader.stdout.close()
        close_session(client.session)

    run = play(monkeypatch, parse_cell(CELL.format(port=port)), script)
    received, lost = len(gaps) + 1, sum(gap - 1 for gap in gaps)
    assert min(gaps) == 1, "in order"
    assert lost <= 0.001 * (received + lost), f"{lost} of {received + lost} lost"
    assert run.reason == "the controller ended the run"
