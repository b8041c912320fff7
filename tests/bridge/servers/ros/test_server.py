"""ROS 2 nodes read the same data and send the same commands over DDS and over Zenoh."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.ros.topics import store

from ..conftest import WALL, until
from .conftest import cell_class

pytestmark = pytest.mark.usefixtures("often")
ARM = robots.load("yumi_left")
JOINTS, ARRAY, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String"
EMPTY, DIAGNOSTICS = "std_msgs/msg/Empty", "diagnostic_msgs/msg/DiagnosticArray"
VELOCITY, POSITION = (f"/yumi_left/joint_group_{kind}_controller/commands" for kind in ("velocity", "position"))
SET = "/yumi_left/set_parameter"


@pytest.fixture(params=["ros2", pytest.param("rmw_zenoh", marks=pytest.mark.slow)])
def start(request: pytest.FixtureRequest) -> Iterator[Callable[..., Any]]:
    with ExitStack() as stack:
        yield lambda **options: stack.enter_context(closing(cell_class(request.param)(**options)))


@pytest.fixture
def running(start: Callable[..., Any]) -> Any:
    return start()


def raw(type_: str, *fields: Any) -> bytes:
    return bytes(store().serialize_cdr(store().types[type_](*fields), type_))


def numbers(*values: float) -> bytes:
    return raw(ARRAY, store().types["std_msgs/msg/MultiArrayLayout"]([], 0), np.array(values, dtype=float))


def answer(running: Any, diagnostics: Callable[[], list[Any]]) -> str:
    running.tick += 250  # a second later
    running.commanded()
    values = {one.key: one.value for message in diagnostics() for one in message.status[0].values}
    return values.get("last answer", "none").replace("none", "")


def test_rows_become_messages_of_what_is_read(running: Any) -> None:
    running.commanded()
    assert running.server.wanted() == frozenset()
    came = running.node.read("/yumi_left/joint_states", JOINTS)
    until(lambda: running.row(q=ARM.q_home + 1e-3 * running.tick) and len(came()) >= 10)
    for message in came():
        k = (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - WALL) // 4_000_000
        assert np.array_equal(message.position, ARM.q_home + 1e-3 * k)
        assert (len(message.velocity), len(message.effort)) == (7, 0)
        assert list(message.name) == list(ARM.ros_joint_names)
    counts = running.exchange.summary()["servers"][running.name]["clients"]
    assert list(counts) == ["/yumi_left/joint_states"]
    written, dropped = counts["/yumi_left/joint_states"]
    assert (10 <= written <= running.tick, dropped) == (True, 0)


def test_all_writers_of_a_node_are_one_client_until_the_last_goes(start: Callable[..., Any]) -> None:
    running, qd = start(rights="commander"), np.arange(7) / 100.0
    velocity, setter = running.node.writer(VELOCITY, ARRAY), running.node.writer(SET, TEXT)

    def obeyed() -> bool:
        velocity.write(numbers(*qd))
        command = running.commanded()
        return command is not None and command.qd is not None and np.array_equal(command.qd, qd)

    who = f"{running.name} {running.node.client}"
    until(lambda: obeyed() and running.exchange.arbiter.commander(ARM.name) == who)
    until(lambda: obeyed() and (setter.write(raw(TEXT, '{"gain": 0.75}')) or running.exchange.parameters.gain == 0.75))
    events: list[str] = []
    running.exchange.begin(lambda text, *_: events.append(text))
    running.exchange.arbiter._lease_ns = 10**12  # so that only the departure of the writers ends it
    until(obeyed)
    velocity.leave()
    for _ in range(30):
        running.commanded()
        time.sleep(0.01)
    assert running.exchange.arbiter.commander(ARM.name) == who
    setter.leave()
    over = f"{who} no longer commands yumi_left: it disconnected. The arm holds."
    until(lambda: running.commanded() is None and over in events)


def test_a_second_commander_is_refused_by_a_sentence(running: Any) -> None:
    first = running.node.writer(VELOCITY, ARRAY)
    until(lambda: first.write(numbers(*[0.01] * 7)) or running.commanded())
    other = running.join("others")
    second = other.writer(POSITION, ARRAY)
    diagnostics = running.node.read("/yumi_left/diagnostics", DIAGNOSTICS)
    who = f"{running.name} {running.node.client}"
    said = f"{other.client}: yumi_left is commanded by {who}. You have read-only access."

    def told() -> bool:
        first.write(numbers(*[0.01] * 7))
        if running.exchange.arbiter.commander(ARM.name) == who:  # otherwise its lease ended: the second takes the arm
            second.write(numbers(*ARM.q_home))
        return answer(running, diagnostics).startswith(said)

    until(told)


def test_diagnostics_come_and_say_so_when_no_row_comes(running: Any) -> None:
    diagnostics = running.node.read("/yumi_left/diagnostics", DIAGNOSTICS)
    until(lambda: diagnostics() and diagnostics()[-1].status[0].message == "no packet yet")
    running.commanded()
    until(lambda: "no packet for" in diagnostics()[-1].status[0].message)
    assert diagnostics()[-1].status[0].level == 2


def test_parameters_are_set_and_told_again_to_who_comes_later_and_the_arms_are_stopped(running: Any) -> None:
    setter, stop = running.node.writer(SET, TEXT), running.node.writer("/yumi_left/stop", EMPTY)
    gain = raw(TEXT, '{"gain": 0.75}')
    until(lambda: setter.write(gain) or running.commanded() or running.exchange.parameters.gain == 0.75)
    came = running.node.read("/yumi_left/parameters", TEXT)
    until(came)
    assert came()[-1].data.startswith('{"gain": 0.75, ')
    until(lambda: stop.write(raw(EMPTY)) or running.commanded() or running.exchange.arbiter.stopped)
    assert running.exchange.arbiter.stopped == f"{running.name} {running.node.client}", "any node may"


def test_what_is_no_command_is_told_and_the_next_is_heard(running: Any) -> None:
    diagnostics = running.node.read("/yumi_left/diagnostics", DIAGNOSTICS)
    velocity, setter = running.node.writer(VELOCITY, ARRAY), running.node.writer(SET, TEXT)
    events: list[str] = []
    running.exchange.begin(lambda text, *_: events.append(text))
    noise = (velocity, b"\0\1\0\0nothing", "Expected a std_msgs/msg/Float64MultiArray, got 11 invalid bytes")
    for writer, wrong, words in (
        *[noise] * (running.name == "rmw_zenoh"),  # DDS passes no invalid message
        (velocity, numbers(*[0.0] * 6), "Expected 7 numbers"),
        (velocity, numbers(*[np.nan] * 7), "Expected finite numbers"),
        (setter, raw(TEXT, '{"gain": "\\ud800"}'), "Expected a request that can be encoded as UTF-8 JSON"),
    ):

        def told(writer: Any = writer, wrong: bytes = wrong, words: str = words) -> bool:
            writer.write(wrong)
            return words in answer(running, diagnostics) and any(words in text for text in events)

        until(told)
    assert not running.exchange.arbiter.obeyed[ARM.name]
    until(lambda: velocity.write(numbers(*[0.0] * 7)) or running.commanded())
