"""The server of ROS 2 at the other end of an exchange; a participant of the same process plays the nodes."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.servers.hub import Exchange
from armlab.errors import LinkError
from armlab.log import Tick
from armlab.state import Command, State

from .dds_peers import Node, free_domain, numbers, taken, until, write

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

from armlab.bridge.servers.ros.dds import DdsServer, serve

ARM = robots.load("yumi_left")
JOINTS, ARRAY, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String"
WALL = 1_700_000_000_000_000_000
VELOCITY = "/yumi_left/joint_group_velocity_controller/commands"


class Running:
    """The server's work in a thread, a loop that gives rows, and a node."""

    def __init__(self, rights: Literal["anyone", "commander"] = "anyone", **options: Any) -> None:
        declared = Parameters([Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights=rights)])
        self.exchange = Exchange([ARM], ["ros2"], declared, ["ros2"], about={"cell": "yumi"}, **options)
        self.feed = self.exchange.open("ros2")
        domain = free_domain()
        self.server = DdsServer(self.feed, {"domain": domain, "host": "127.0.0.1"})
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()
        self.ticks = 0
        until(lambda: self.exchange.poll() or self.exchange.outlets["ros2"].where, "the server listening")
        self.where = self.exchange.outlets["ros2"].where
        self.domain, self.node = domain, Node(domain)  # a participant, so one client

    def row(self, q: np.ndarray = ARM.q_home) -> Command | None:
        """One tick of the loop; what the arm is told."""
        self.ticks += 1
        nothing = np.full(7, np.nan)
        state = State(t=1.0, dt=0.004, q=q, qd=nothing, tau=nothing, robot=ARM.name, q_start=np.array(ARM.q_home))
        command = self.exchange.arbiter(state)
        tick = Tick(self.ticks, self.ticks, WALL + 4_000_000 * self.ticks, 1_000, 2_000, 3)
        self.exchange.row(state, command, tick)
        assert not isinstance(command, tuple)
        return command

    def close(self) -> None:
        del self.node
        self.exchange.close()
        self.thread.join()
        self.feed.close()


@pytest.fixture
def running() -> Iterator[Running]:
    one = Running()
    yield one
    one.close()


def client(writer: Any) -> str:
    return writer.guid.hex[:24]


def answer(running: Running, diagnostics: Any) -> str:
    """What the newest diagnostics say to clients, "" while none has come."""
    running.ticks += 250  # a second later
    running.row()
    found = taken(diagnostics, "diagnostic_msgs/msg/DiagnosticArray")
    values = {one.key: one.value for message in found for one in message.status[0].values}
    return values.get("last answer", "none").replace("none", "")


def test_rows_become_messages_of_what_is_read(running: Running) -> None:
    assert running.where == [f"127.0.0.1 (ros2, DDS domain {running.domain})"]
    readers = [running.node.reader("/yumi_left/joint_states", JOINTS)]
    found: list[Any] = []

    def came() -> bool:
        running.row(ARM.q_home + 1e-3 * running.ticks)
        found.extend(taken(readers[0], JOINTS))
        return len(found) >= 10

    until(came)
    for message in found:
        k = (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - WALL) // 4_000_000
        assert np.array_equal(message.position, ARM.q_home + 1e-3 * (k - 1))
        assert len(message.velocity) == len(message.effort) == 0
    counts = running.exchange.summary()["servers"]["ros2"]["clients"]
    assert list(counts) == ["/yumi_left/joint_states"]
    written, full = counts["/yumi_left/joint_states"]
    assert len(found) <= written <= running.ticks
    assert full == 0
    readers.clear()
    until(lambda: running.row() is None and running.server.wanted == frozenset(), "nobody reading")


def test_commands_take_the_arm_until_the_writer_leaves(running: Running) -> None:
    writers = {"velocity": running.node.writer(VELOCITY, ARRAY)}
    qd = np.arange(7) / 100.0

    def obeyed() -> bool:
        write(writers["velocity"], ARRAY, *numbers(*qd))
        command = running.row()
        return command is not None and command.qd is not None and np.array_equal(command.qd, qd)

    until(obeyed)
    who = running.exchange.arbiter.commander("yumi_left")
    assert who == f"ros2 {client(writers['velocity'])}"
    events: list[str] = []
    running.exchange.begin(lambda text, *_: events.append(text))
    running.exchange.arbiter._lease_ns = 10**12  # what ends it is that the writer leaves
    writers.clear()
    until(lambda: running.row() is None and f"{who} no longer commands yumi_left: it closed. The arm holds." in events)


def test_a_second_commander_is_refused_by_a_sentence(running: Running) -> None:
    first = running.node.writer(VELOCITY, ARRAY)
    until(lambda: write(first, ARRAY, *numbers(*[0.01] * 7)) or running.row())
    other = Node(running.domain)
    second = other.writer("/yumi_left/joint_group_position_controller/command", ARRAY)
    diagnostics = running.node.reader("/yumi_left/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

    def told() -> str:
        write(first, ARRAY, *numbers(*[0.01] * 7))
        write(second, ARRAY, *numbers(*ARM.q_home))
        return answer(running, diagnostics)

    said = f"{client(second)}: yumi_left is commanded by ros2 {client(first)}. You may read."
    assert until(told).startswith(said)


def test_who_commands_with_one_topic_sets_parameters_and_commands_with_another() -> None:
    running = Running(rights="commander")
    velocity = running.node.writer(VELOCITY, ARRAY)
    writers = [running.node.writer("/yumi_left/joint_group_position_controller/command", ARRAY)]
    setter = running.node.writer("/yumi_left/set_parameter", TEXT)

    def is_set() -> bool:
        write(velocity, ARRAY, *numbers(*[0.01] * 7))
        write(setter, TEXT, '{"gain": 0.75}')
        running.row()
        return running.exchange.parameters.gain == 0.75 and running.exchange.arbiter.commander(ARM.name) != ""

    def moves() -> bool:
        write(writers[0], ARRAY, *numbers(*ARM.q_home))
        command = running.row()
        return command is not None and command.q is not None

    until(is_set)
    running.exchange.arbiter._lease_ns = 10**12  # silence frees nothing
    until(moves)
    writers.clear()
    assert until(lambda: running.row() and running.exchange.arbiter.commander(ARM.name)) == f"ros2 {client(velocity)}"
    running.close()


@pytest.mark.parametrize(
    ("type_", "fields", "sentence"),
    [
        (ARRAY, numbers(0.0, 1.0), "Expected 7 numbers on {}, got 2."),
        (
            ARRAY,
            numbers(*[0.0] * 6, np.nan),
            "Expected finite numbers on {}, got nan for yumi_robl_joint_7 (number 7 of the message).",
        ),
    ],
)
def test_wrong_numbers_are_answered_in_the_diagnostics(
    running: Running, type_: str, fields: Any, sentence: str
) -> None:
    writer = running.node.writer(VELOCITY, type_)
    diagnostics = running.node.reader("/yumi_left/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    events: list[str] = []
    running.exchange.begin(lambda text, *_: events.append(text))

    def told() -> str:
        write(writer, type_, *fields)
        return answer(running, diagnostics)

    found = until(told)
    until(lambda: running.row() or f"ros2 {found}" in events, "an event of the log")
    assert found == f"{client(writer)}: {sentence.format(VELOCITY)}"
    assert running.exchange.arbiter.commander("yumi_left") == ""


def test_diagnostics_come_and_say_so_when_no_row_comes(running: Running) -> None:
    diagnostics = running.node.reader("/yumi_left/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    found: list[Any] = []

    def words() -> str:
        found.extend(taken(diagnostics, "diagnostic_msgs/msg/DiagnosticArray"))
        return found[-1].status[0].message if found else ""

    until(lambda: words() == "no packet yet")
    running.row()
    until(lambda: "no packet for" in words())
    assert found[-1].status[0].level == 2


def test_half_a_surrogate_pair_is_answered(running: Running) -> None:
    writer = running.node.writer("/yumi_left/set_parameter", TEXT)
    diagnostics = running.node.reader("/yumi_left/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

    def told() -> str:
        write(writer, TEXT, '{"gain": "\\ud800"}')
        return answer(running, diagnostics)

    assert "Expected what JSON in UTF-8 can say" in until(told)


def test_parameters_are_set_and_told_again_to_who_comes_later(running: Running) -> None:
    writer = running.node.writer("/yumi_left/set_parameter", TEXT)
    until(lambda: write(writer, TEXT, '{"gain": 0.75}') or running.row() or running.exchange.parameters.gain == 0.75)
    reader = running.node.reader("/yumi_left/parameters", TEXT)
    found: list[Any] = []
    until(lambda: found.extend(taken(reader, TEXT)) or found)
    assert found[-1].data == '{"gain": 0.75}'


def test_any_node_may_stop_the_arms(running: Running) -> None:
    writer = running.node.writer("/yumi_left/stop", "std_msgs/msg/Empty")
    until(lambda: write(writer, "std_msgs/msg/Empty") or running.row() or running.exchange.arbiter.stopped)
    assert running.exchange.arbiter.stopped == f"ros2 {client(writer)}"


def test_a_server_that_listens_beyond_this_computer_is_for_reading() -> None:
    running = Running(read_only=["ros2"])
    writer = running.node.writer(VELOCITY, ARRAY)
    diagnostics = running.node.reader("/yumi_left/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

    def told() -> str:
        write(writer, ARRAY, *numbers(*[0.01] * 7))
        return answer(running, diagnostics)

    assert "it listens beyond this computer. Read." in until(told)
    assert running.exchange.arbiter.commander("yumi_left") == ""
    running.close()


def test_a_loop_that_has_gone_ends_the_process() -> None:
    exchange = Exchange([ARM], ["ros2"], about={"cell": "yumi"})
    feed = exchange.open("ros2")
    feed.recv(2**17)
    exchange.close()
    with pytest.raises(LinkError, match="Start it again"), feed:
        serve(feed, {"domain": 0, "host": "127.0.0.1"})
