"""The Zenoh server, alone and in complete cells: rows and events out; commands, parameters and stops in."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.row import RowSchema, read_row
from armlab.bridge.servers.zenoh.feed import robots_at
from armlab.bridge.servers.zenoh.messages import Attachment, key
from armlab.bridge.servers.zenoh.session import queried
from armlab.robots import Robot

from ....processes import free_port
from ..conftest import until
from .conftest import Running, heard

ME, OTHER = bytes(range(16)), bytes(range(100, 116))
Start = Callable[..., Running]
Open = Callable[..., Any]


def attached(seq: int, sender: bytes = ME) -> bytes:
    return Attachment(sender, seq, 5).pack()


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
    ("position", bytes(8 * 65), attached(1), "1 to 64 float64 numbers for .*, got 520 bytes"),
    ("position", b"", attached(1), "got 0 bytes"),
    ("position", bytes(8 * 200), attached(1), "got 1600 bytes"),
    ("motion", bytes(8 * 7), attached(1), "as many velocities as positions"),
    ("jump", bytes(56), attached(1), "one of position, velocity, effort, motion, got 'jump'"),
    ("position", bytes(56), None, "attachment of 32 bytes.*got none"),
    ("position", bytes(56), b"short", "got 5 bytes"),
    ("position", bytes(8 * 6), attached(1), "7"),
    ("position", np.full(7, np.nan).tobytes(), attached(1), "finite"),
    ("effort", bytes(56), attached(1), "torque"),
]


@pytest.mark.slow
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
        one.exchange.arbiter._answered.clear()  # answer each message immediately
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
