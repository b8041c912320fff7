"""ROS 2 with rmw_zenoh: a Zenoh session plays the nodes; a router between them is killed and started again."""

from __future__ import annotations

import math
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.ros.rmw_zenoh import ANY, Distribution, Names, Nodes, Origin, RmwZenohServer, Writer
from armlab.bridge.servers.ros.topics import store
from armlab.bridge.servers.zenoh.session import LabAddress, close_session
from armlab.errors import ConfigError, MissingExtra

from ....processes import Started, free_port
from ..conftest import WALL, Served, until

pytest.importorskip("zenoh", reason="the extra net is not installed")
pytest.importorskip("xxhash", reason="the extra net is not installed")
ARM = robots.load("yumi_left")
JOINTS, ARRAY, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
VELOCITY = "/yumi_left/joint_group_velocity_controller/commands"


class Running(Served):
    """The server in a thread, and a session of a node."""

    def __init__(self) -> None:
        gain, port = Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights="anyone"), free_port()
        options = {"domain": 0, "host": "127.0.0.1", "port": port, "router": "", "distribution": "jazzy"}
        super().__init__("rmw_zenoh", ARM, lambda feed: RmwZenohServer(feed, options), [gain])
        self.node = LabAddress("127.0.0.1", port).open()
        self.names = Names(0, str(self.node.zid()), node="theirs")
        self.sent = 0

    def read(self, topic: str, type_: str) -> list[Any]:
        """Return a list that fills with the samples of a topic."""
        samples: list[Any] = []
        self.node.declare_subscriber(self.names.data(topic, type_), samples.append)
        return samples

    def write(self, topic: str, type_: str, raw: bytes, sender: bytes = b"s" * 16) -> None:
        self.sent += 1
        self.node.put(self.names.data(topic, type_), raw, attachment=Origin(self.sent, 0, sender).pack())

    def close(self) -> None:
        close_session(self.node)
        super().close()


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters and diagnostics come ten times a second, an arm is silent after a fifth of one."""
    monkeypatch.setattr("armlab.bridge.servers.ros.server._AGAIN", 0.1)
    monkeypatch.setattr("armlab.bridge.servers.ros.topics._PERIOD_NS", 10**8)
    monkeypatch.setattr("armlab.bridge.servers.ros.topics._SILENT", 0.2)


@pytest.fixture
def running() -> Iterator[Running]:
    one = Running()
    yield one
    one.close()


def message(sample: Any, type_: str) -> Any:
    return store().deserialize_cdr(sample.payload.to_bytes(), type_)


def numbers(values: Any) -> bytes:
    types = store().types
    array = types[ARRAY](types["std_msgs/msg/MultiArrayLayout"]([], 0), np.asarray(values, dtype=float))
    return bytes(store().serialize_cdr(array, ARRAY))


def answer(running: Running, diagnostics: list[Any]) -> str:
    """What the newest diagnostics say to clients, "" while none has come."""
    running.tick += 250
    running.commanded()
    found = [message(sample, DIAGNOSTICS) for sample in diagnostics]
    values = {one.key: one.value for each in found for one in each.status[0].values}
    return values.get("last answer", "none").replace("none", "")


def test_joint_states_reach_a_node_that_reads_them(running: Running) -> None:
    running.commanded()
    assert running.server.wanted() == frozenset()
    samples = running.read("/yumi_left/joint_states", JOINTS)
    until(lambda: running.server.wanted() == {"/yumi_left/joint_states"})
    for _ in range(5):
        running.commanded()
    until(lambda: len(samples) == 5)
    found = message(samples[0], JOINTS)
    assert np.array_equal(found.position, ARM.q_home)
    assert (list(found.name), len(found.effort)) == (list(ARM.ros_joint_names), 0)
    origins = [Origin.read(sample.attachment.to_bytes()) for sample in samples]
    assert [origin.seq for origin in origins if origin] == [1, 2, 3, 4, 5]
    assert samples[0].payload.to_bytes()[:4] == b"\0\1\0\0"


def test_what_a_reader_missed_that_comes_again_is_numbered(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    topic = "/yumi_left/joint_states"
    output = running.server._outputs[topic]
    samples: list[Any] = []
    for last in (1, 5):
        reader = running.node.declare_subscriber(running.names.data(topic, JOINTS), samples.append)
        until(lambda: output.wanted and topic in running.server.wanted())
        running.commanded()
        until(lambda last=last: samples and Origin.read(samples[-1].attachment.to_bytes()).seq == last)
        reader.undeclare()
        until(lambda: not output.wanted)
        for _ in range(3):
            running.commanded()
        until(lambda last=last: running.server._writers[topic]._seq == last + 3)
    assert len(samples) == output.sent == 2
    monkeypatch.setattr("armlab.bridge.servers.ros.rmw_zenoh._MAY_COME_AGAIN", 0.0)
    running.server._read_until[topic] = 0.0
    until(lambda: running.server.wanted() == frozenset())


def test_what_is_read_is_noted_also_while_parameters_are_told_all_the_time(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a topic whose reader's way is cut would not be numbered: its half minute had passed."""
    topic = "/yumi_left/joint_states"
    running.read(topic, JOINTS)
    until(lambda: topic in running.server.wanted())
    monkeypatch.setattr("armlab.bridge.servers.ros.rmw_zenoh._LOOK", 0.05)
    running.server._told = math.inf
    for _ in range(3):
        before = running.server._read_until[topic]
        until(lambda before=before: running.server._read_until[topic] > before)


def test_the_graph_has_the_node_its_writers_and_readers(running: Running) -> None:
    def tokens() -> list[list[str]]:
        replies = running.node.liveliness().get("@ros2_lv/0/**", timeout=2.0)
        return [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]

    expected = len(running.server._topics.published) + len(running.server._commands.types) + 1
    until(lambda: len(tokens()) == expected)
    found = tokens()
    kinds = [words[5] for words in found]
    assert {kind: kinds.count(kind) for kind in ("NN", "MP", "MS")} == {"NN": 1, "MP": 11, "MS": 8}
    assert len({words[4] for words in found}) == expected, "each endpoint has its own number"
    joints = next(words for words in found if len(words) > 9 and words[9] == "%yumi_left%joint_states")
    origin = running.server._writers["/yumi_left/joint_states"]
    assert (joints[10], joints[12]) == ("sensor_msgs::msg::dds_::JointState_", "::,10:,:,:,,")
    assert len(origin.id) == 16


def test_all_writers_of_a_node_are_one_client_until_the_last_goes(running: Running) -> None:
    names, node = running.names, running.node
    tokens = [names.writer(1, VELOCITY, ARRAY), names.writer(2, "/yumi_left/set_parameter", TEXT)]
    lives = [node.liveliness().declare_token(token) for token in tokens]
    ids = [Writer(token).id for token in tokens]
    until(lambda: all(one in running.server._nodes._clients for one in ids))
    who = f"rmw_zenoh /theirs@{node.zid()!s}"

    def commanded(k: int) -> bool:
        running.write(VELOCITY, ARRAY, numbers([0.0] * 7), ids[k])
        return running.commanded() is not None

    until(lambda: commanded(0))
    running.exchange.arbiter._lease_ns = 10**12  # silence frees nothing
    assert running.exchange.arbiter.commander(ARM.name) == who
    refused = running.exchange.arbiter.refused
    obeyed = running.exchange.arbiter.obeyed[ARM.name]
    so_far = obeyed[who]
    until(lambda: commanded(1) and obeyed[who] > so_far + 1)
    assert not refused
    lives[0].undeclare()
    until(lambda: ids[0] not in running.server._nodes._clients)
    running.commanded()
    assert running.exchange.arbiter.commander(ARM.name) == who
    lives[1].undeclare()
    until(lambda: running.commanded() is None and running.exchange.arbiter.commander(ARM.name) == "")


def test_what_is_no_command_is_told(running: Running) -> None:
    diagnostics = running.read("/yumi_left/diagnostics", DIAGNOSTICS)
    events: list[str] = []
    running.exchange.begin(lambda text, *_: events.append(text))
    for type_, raw, words in (
        (ARRAY, numbers([0.0] * 6), "Expected 7 numbers"),
        (ARRAY, b"\0\1\0\0nothing", "Expected a std_msgs/msg/Float64MultiArray, got 11 bytes"),
        (ARRAY, numbers([np.nan] * 7), "Expected finite numbers"),
    ):

        def told(type_: str = type_, raw: bytes = raw, words: str = words) -> bool:
            running.write(VELOCITY, type_, raw)
            return words in answer(running, diagnostics) and any(words in text for text in events)

        until(told)

    half = bytes(store().serialize_cdr(store().types[TEXT]('{"gain": "\\ud800"}'), TEXT))

    def answered() -> bool:
        running.write("/yumi_left/set_parameter", TEXT, half)
        return "Expected what JSON in UTF-8 can say" in answer(running, diagnostics)

    until(answered)

    def dropped() -> bool:
        running.node.put(running.names.data(VELOCITY, ARRAY), numbers([0.0] * 7))
        words = "33 bytes attached"
        return words in answer(running, diagnostics) and any(words in text for text in events)

    until(dropped)
    assert not running.exchange.arbiter.obeyed[ARM.name]


def test_writers_of_every_distribution_are_heard(running: Running) -> None:
    """Humble has no hashes; its key differs, and the subscription takes any."""
    humble = Names(0, "1", "humble")

    def commanded() -> bool:
        running.sent += 1
        attached = Origin(running.sent, 0, b"h" * 16).pack()
        running.node.put(humble.data(VELOCITY, ARRAY), numbers([0.0] * 7), attachment=attached)
        return running.commanded() is not None

    until(commanded)


def test_parameters_and_stop(running: Running) -> None:
    echoes = running.read("/yumi_left/parameters", TEXT)
    raw = bytes(store().serialize_cdr(store().types[TEXT]('{"gain": 0.75}'), TEXT))
    until(lambda: running.write("/yumi_left/set_parameter", TEXT, raw) or running.commanded() or echoes)
    until(lambda: running.commanded() or message(echoes[-1], TEXT).data == '{"gain": 0.75}')
    empty = b"\0\1\0\0\0"
    stop = "std_msgs/msg/Empty"
    until(
        lambda: running.write("/yumi_left/stop", stop, empty) or running.commanded() or running.exchange.arbiter.stopped
    )


def test_it_refuses_commands_through_a_router_elsewhere() -> None:
    about = {"cell": "yumi", "commands": ["rmw_zenoh"]}
    options = {"domain": 0, "host": "127.0.0.1", "port": free_port(), "router": "192.168.1.9:7447"}
    exchange = Hub([ARM], ["rmw_zenoh"], about=about)
    with exchange.open("rmw_zenoh") as feed, pytest.raises(ConfigError, match="through a router elsewhere"):
        RmwZenohServer(feed, {**options, "distribution": "jazzy"})
    exchange.close()


HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
NAMES = Names(0, "aac3178e146ba6f1fc6e6a4085e77f21")


def test_keys_of_data() -> None:
    key = f"0/yumi_left/joint_states/sensor_msgs::msg::dds_::JointState_/{HASH}"
    assert NAMES.data("/yumi_left/joint_states", JOINTS) == key
    assert NAMES.data("/a/b", ARRAY, ANY) == "0/a/b/std_msgs::msg::dds_::Float64MultiArray_/*"
    humble: Distribution = "humble"
    old = Names(7, "1", humble).data("/joint_states", JOINTS)
    assert old == "7/joint_states/sensor_msgs::msg::dds_::JointState_/TypeHashNotSupported"
    assert NAMES.hash(JOINTS) == HASH == store().hash_rihs01(JOINTS)


def test_tokens() -> None:
    start = "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0"
    assert NAMES.node() == f"{start}/0/NN/%/%/armlab"
    about = f"%yumi_left%joint_states/sensor_msgs::msg::dds_::JointState_/{HASH}"
    assert NAMES.writer(10, "/yumi_left/joint_states", JOINTS) == f"{start}/10/MP/%/%/armlab/{about}/::,10:,:,:,,"
    assert NAMES.reader(2, "/yumi_left/joint_states", JOINTS) == f"{start}/2/MS/%/%/armlab/{about}/2::,1:,:,:,,"


def test_the_attachment_is_what_zenoh_serialises() -> None:
    ext = pytest.importorskip("zenoh.ext", reason="the extra net is not installed")
    id_ = bytes(range(16))
    expected = ext.z_serialize((ext.Int64(3), ext.Int64(1_700_000_000_000_000_000), id_)).to_bytes()
    assert Origin(3, 1_700_000_000_000_000_000, id_).pack() == expected
    assert len(expected) == 33
    assert Origin.read(expected) == (3, 1_700_000_000_000_000_000, id_)


def test_messages_of_a_writer_are_numbered_from_one() -> None:
    writer = Writer("")
    assert writer.id[::-1].hex() == "99aa06d3014798d86001c324468d497f", "XXH3-128 of nothing, by its own test vectors"
    found = [Origin.read(writer.next(stamp)) for stamp in (5, 6)]
    assert found == [(1, 5, writer.id), (2, 6, writer.id)]
    assert Writer("a").id != Writer("b").id


@given(st.binary(max_size=50))
def test_other_attachments_are_none(data: bytes) -> None:
    found = Origin.read(data)
    assert (found is not None) == (len(data) == 33 and data[16] == 16)
    if found is not None:
        assert found.pack() == data
        assert len(found.client) == 32
    assert Origin.read(None) is None


def test_without_xxhash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xxhash", None)
    with pytest.raises(MissingExtra, match=r"armlab\[net\]"):
        Writer("")


def origin(token: str) -> Origin:
    return Origin(1, 0, Writer(token).id)


def test_a_namespace_is_part_of_the_name_and_what_is_no_token_is_none() -> None:
    nodes = Nodes(lambda client: None)
    token = f"@ros2_lv/0/ab/0/3/MP/%/%lab%left/node/%topic/{TEXT}/hash/::,10:,:,:,,"
    nodes.token(token, is_there=True)
    nodes.token("@ros2_lv/0/ab/0/4/MP", is_there=True)
    assert nodes.client(origin(token)) == "/lab/left/node@ab"


def test_a_flood_of_writers_is_not_kept() -> None:
    nodes = Nodes(lambda client: None)
    names = Names(0, "ab")
    for k in range(5000):
        nodes.token(names.writer(k, "/topic", TEXT), is_there=True)
    assert len(nodes._clients) == 4096


SENDER = b"s" * 16
STAMP, PERIOD_NS = struct.Struct("<iI"), 4_000_000
AGAIN_NS = 5e9  # of the specification; of ten restarts beside a load of 20 on two cores the longest took 0.4 s
RESTART = 60.0  # s; only a test that fails waits so long


class Cell(Served):
    """A loop with a row every 4 ms, the server, and a node that has no way to it but the router."""

    def __init__(self, router: int) -> None:
        place = {"host": "127.0.0.1", "port": 0, "router": f"127.0.0.1:{router}"}
        options = {"domain": 0, "distribution": "jazzy", **place}
        super().__init__("rmw_zenoh", ARM, lambda feed: RmwZenohServer(feed, options))
        self.over = threading.Event()
        self.threads = [threading.Thread(target=one) for one in (self._loop, self._command)]
        self.node = LabAddress("127.0.0.1", router).open_behind()
        self.names = Names(0, str(self.node.zid()), node="theirs")
        self.came: list[tuple[int, int, int]] = []  # of each message its number, its tick, and when it was written [ns]
        self.node.declare_subscriber(self.names.data("/yumi_left/joint_states", JOINTS), self._take)
        for one in self.threads:
            one.start()

    def _take(self, sample: object) -> None:
        origin = Origin.read(sample.attachment.to_bytes())  # type: ignore[attr-defined]
        assert origin is not None
        seconds, rest = STAMP.unpack_from(sample.payload.to_bytes(), 4)  # type: ignore[attr-defined]
        tick = (seconds * 10**9 + rest - WALL) // PERIOD_NS
        self.came.append((origin.seq, tick, origin.stamp_ns))

    def _loop(self) -> None:
        while not self.over.wait(0.004):
            self.commanded()

    def _command(self) -> None:
        number, place = 0, self.names.data(VELOCITY, ARRAY)
        while not self.over.wait(0.01):
            number += 1
            self.node.put(place, numbers([0.01] * 7), attachment=Origin(number, 0, SENDER).pack())

    @property
    def commander(self) -> str:
        return self.exchange.arbiter.commander(ARM.name)

    def tokens(self) -> int:
        """How many of the server's are there."""
        replies = self.node.liveliness().get("@ros2_lv/0/**", timeout=1.0)
        return sum(reply.ok is not None for reply in replies)

    def close(self) -> None:
        self.over.set()
        for one in self.threads:
            one.join(RESTART)
        close_session(self.node)
        super().close()


@pytest.fixture
def cell(processes: Callable[..., Started]) -> Iterator[tuple[Cell, Callable[[], Started]]]:
    """Return the cell, and what kills the router and returns what starts the next one."""
    port = free_port()
    routers = [processes("router", port)]
    one = Cell(port)

    def restart() -> Started:
        routers[-1].kill()
        until(lambda: one.commander == "", patience=RESTART)  # nothing comes any more
        routers.append(processes("router", port))
        return routers[-1]

    yield one, restart
    one.close()


@pytest.mark.slow
def test_a_node_behind_a_router_that_is_killed_twice(cell: tuple[Cell, Callable[[], Started]]) -> None:
    """Messages, the graph and the rights to command come again without help, in order and none twice.

    By the stamps of the messages within 5 s after the router; what did not come is missing in their numbers.
    """
    one, restart = cell
    who = f"rmw_zenoh {SENDER.hex()}"
    until(lambda: one.commander == who and len(one.came) > 100, patience=RESTART)
    everything = one.tokens()
    assert everything == len(one.server._topics.published) + len(one.server._commands.types) + 1
    for _ in range(2):
        killed = len(one.came)
        router = restart()
        seen = len(one.came)
        until(lambda seen=seen: len(one.came) > seen, patience=RESTART)
        until(lambda: one.commander == who, patience=RESTART)
        until(lambda: one.tokens() == everything, patience=RESTART)
        until(lambda seen=seen: len(one.came) > seen + 100, patience=RESTART)
        numbered, ticks, stamps = np.array(one.came).T
        steps = np.diff(numbered)
        assert steps.min() == 1, "in order, none twice"
        assert steps[killed - 1 :].max() > 1
        np.testing.assert_array_equal(steps, np.diff(ticks))
        assert stamps[np.searchsorted(stamps, router.ready_ns)] - router.ready_ns <= AGAIN_NS
