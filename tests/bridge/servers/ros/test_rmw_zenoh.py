"""ROS 2 with rmw_zenoh: a Zenoh session plays the nodes; a router between them is killed and restarted."""

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
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.ros.rmw_zenoh import ANY, Distribution, Names, Nodes, Origin, RmwZenohServer, Writer
from armlab.bridge.servers.ros.topics import store
from armlab.bridge.servers.zenoh.session import LabAddress, close_session
from armlab.errors import ConfigError, MissingExtra

from ....processes import Started, free_port
from ..conftest import WALL, Served, until
from .zenoh_nodes import ZenohCell

pytest.importorskip("zenoh", reason="the extra net is not installed")
pytest.importorskip("xxhash", reason="the extra net is not installed")
ARM = robots.load("yumi_left")
JOINTS, ARRAY, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
VELOCITY = "/yumi_left/joint_group_velocity_controller/commands"


@pytest.fixture
def running(often: None) -> Iterator[ZenohCell]:
    one = ZenohCell()
    yield one
    one.close()


def numbers(values: Any) -> bytes:
    types = store().types
    array = types[ARRAY](types["std_msgs/msg/MultiArrayLayout"]([], 0), np.asarray(values, dtype=float))
    return bytes(store().serialize_cdr(array, ARRAY))


def test_what_a_reader_missed_that_comes_again_is_numbered(running: ZenohCell, monkeypatch: pytest.MonkeyPatch) -> None:
    topic = "/yumi_left/joint_states"
    output = running.server._outputs[topic]
    samples: list[Any] = []
    for last in (1, 5):
        reader = running.node.session.declare_subscriber(running.node.names.data(topic, JOINTS), samples.append)
        until(lambda: output.wanted and topic in running.server.wanted())
        running.commanded()
        until(lambda last=last: samples and Origin.read(samples[-1].attachment.to_bytes()).seq == last)
        reader.undeclare()
        until(lambda: not output.wanted)
        for _ in range(3):
            running.commanded()
        until(lambda last=last: running.server._writers[topic]._seq == last + 3)
    assert len(samples) == output.sent == 2
    monkeypatch.setattr("armlab.bridge.servers.ros.rmw_zenoh._MAY_RETURN", 0.0)
    running.server._read_until[topic] = 0.0
    until(lambda: running.server.wanted() == frozenset())


def test_what_is_read_is_noted_also_while_parameters_are_told_all_the_time(
    running: ZenohCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    topic = "/yumi_left/joint_states"
    running.node.read(topic, JOINTS)
    until(lambda: topic in running.server.wanted())
    monkeypatch.setattr("armlab.bridge.servers.ros.rmw_zenoh._CHECK_EVERY", 0.05)
    running.server._parameters_sent = math.inf
    for _ in range(3):
        before = running.server._read_until[topic]
        until(lambda before=before: running.server._read_until[topic] > before)


def test_the_graph_has_the_node_its_writers_and_readers(running: ZenohCell) -> None:
    def tokens() -> list[list[str]]:
        replies = running.node.session.liveliness().get("@ros2_lv/0/**", timeout=2.0)
        return [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]

    server = running.server
    taken = len(server._commands.types) + len(server._goals.topics)
    expected = len(server.published) + taken + len(server.services) + 2
    until(lambda: len(tokens()) == expected)
    found = tokens()
    kinds = [words[5] for words in found]
    assert {kind: kinds.count(kind) for kind in ("NN", "MP", "MS", "SS")} == {"NN": 2, "MP": 16, "MS": 9, "SS": 9}
    assert len({words[4] for words in found}) == expected, "each endpoint has its own number"
    joints = next(words for words in found if len(words) > 9 and words[9] == "%yumi_left%joint_states")
    origin = running.server._writers["/yumi_left/joint_states"]
    assert (joints[10], joints[12]) == ("sensor_msgs::msg::dds_::JointState_", "::,10:,:,:,,")
    assert len(origin.id) == 16


def test_writers_of_every_distribution_are_heard_and_others_are_told_why_not(running: ZenohCell) -> None:
    humble, put = Names(0, "1", "humble").data(VELOCITY, ARRAY), running.node.session.put
    events: list[str] = []
    running.exchange.begin(lambda text, *_: events.append(text))
    until(lambda: put(humble, numbers([0.0] * 7)) or running.commanded() or any("33 bytes" in one for one in events))
    assert not running.exchange.arbiter.obeyed[ARM.name]
    attached = Origin(1, 0, b"h" * 16).pack()
    until(lambda: put(humble, numbers([0.0] * 7), attachment=attached) or running.commanded())


def test_it_refuses_commands_through_a_router_elsewhere() -> None:
    about = {"cell": "yumi", "commands": ["rmw_zenoh"]}
    options = {"domain": 0, "host": "127.0.0.1", "port": free_port(), "router": "192.168.1.9:7447"}
    exchange = Hub([ARM], ["rmw_zenoh"], about=about)
    with (
        exchange.open("rmw_zenoh") as feed,
        pytest.raises(
            ConfigError, match=r"a router on this computer, got 192\.168\.1\.9:7447.*commands from other computers"
        ),
    ):
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
    assert writer.id[::-1].hex() == "99aa06d3014798d86001c324468d497f", "XXH3-128 of empty input, from its test vectors"
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
AGAIN_NS = 5e9  # specified limit; the longest of ten restarts at a load of 20 on two cores took 0.4 s
RESTART = 60.0  # s; only a test that fails waits so long


class Cell(Served):
    """Loop with a row every 4 ms, and a node that is connected only through the router."""

    def __init__(self, router: int) -> None:
        place = {"host": "127.0.0.1", "port": 0, "router": f"127.0.0.1:{router}"}
        options = {"domain": 0, "distribution": "jazzy", **place}
        super().__init__("rmw_zenoh", ARM, lambda feed: RmwZenohServer(feed, options))
        self.over = threading.Event()
        self.threads = [threading.Thread(target=one) for one in (self._loop, self._command)]
        self.node = LabAddress("127.0.0.1", router).open_behind()
        self.names = Names(0, str(self.node.zid()), node="theirs")
        self.came: list[tuple[int, int, int]] = []  # number, tick and time of writing [ns] of each message
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
        replies = self.node.liveliness().get("@ros2_lv/0/**", timeout=1.0)
        return sum(reply.ok is not None for reply in replies)

    def close(self) -> None:
        self.over.set()
        for one in self.threads:
            one.join(RESTART)
        close_session(self.node)
        super().close()


@pytest.fixture
def cell(often: None, processes: Callable[..., Started]) -> Iterator[tuple[Cell, Callable[[], Started]]]:
    """Return the cell, and a function that kills the router and starts the next one."""
    port = free_port()
    routers = [processes("router", port)]
    one = Cell(port)

    def restart() -> Started:
        routers[-1].kill()
        until(lambda: one.commander == "", patience=RESTART)  # no more commands arrive
        routers.append(processes("router", port))
        return routers[-1]

    yield one, restart
    one.close()


@pytest.mark.slow
def test_a_node_behind_a_router_that_is_killed_twice(cell: tuple[Cell, Callable[[], Started]]) -> None:
    one, restart = cell
    who = f"rmw_zenoh {SENDER.hex()}"
    until(lambda: one.commander == who and len(one.came) > 100, patience=RESTART)
    everything = one.tokens()
    server = one.server
    taken = len(server._commands.types) + len(server._goals.topics)
    assert everything == len(server.published) + taken + len(server.services) + 2
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


def test_a_client_of_services_has_gone_with_its_token(running: ZenohCell) -> None:
    node = running.node
    token = node.names.service(77, "/yumi_left/any", "rcl_interfaces/srv/GetParameters").replace("/SS/", "/SC/")
    life = node.session.liveliness().declare_token(token)
    origin = Origin(1, 0, Writer(token).id)
    until(lambda: running.server._nodes.client(origin) == node.client)
    life.undeclare()
    until(lambda: running.server._nodes.client(origin) == origin.client)
