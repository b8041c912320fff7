"""A server over real sockets, with clients that are slow, silent, hostile, cut off or too many, or never read."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.arbiter import Arbiter
from armlab.bridge.servers.labcomm import ArmChannel, LabCommServer, Row
from armlab.bridge.servers.labcomm.channels import FusedArm, FusedChannel
from armlab.bridge.servers.labcomm.rows import STOP, RowTypes
from armlab.bridge.servers.labcomm.server import Ports, RowFeed, to_arbiter
from armlab.errors import LinkError, UnknownName
from armlab.log import Tick
from armlab.state import Command, State
from armlab.wire.labcomm import Decoder, Encoder, Sample, parse_lc
from armlab.wire.labcomm.types import Definition, SampleType, Version

from ..conftest import until
from .conftest import Plain, Started, row

COMMAND = RowTypes().accepted
VECTORS = Path(__file__).parents[5] / "shared/data/labcomm_vectors"
Start = Callable[..., Started]
TICK = Tick(0, -1, 0, 0, -1, 0)


def command(tm: int, encoder: Encoder | None = None) -> bytes:
    encoder = encoder or Encoder()
    head = encoder.version() + encoder.define(COMMAND)
    return head + encoder.data(COMMAND, {"tm": tm, "pos": [0.1] * 7, "vel": [0.0] * 7, "trq": [0.0] * 7})


def test_rows_come_in_order_whatever_other_clients_do(start: Start) -> None:
    one = start(ArmChannel("left", 0), ArmChannel("right", 0))
    silent, deaf, good = one.client("left"), one.client("left"), one.client("left")
    hostile = sorted((VECTORS / "bad_streams").glob("*.bin")) if VECTORS.exists() else []
    streams = [path.read_bytes() for path in hostile] or [b"\xff", b"\x01\x0f\x0eLabComm2014.v2"]
    good.read(2)
    for tm in range(1000):
        one.server.row("left", row(tm))
        if tm % 25 == 0:
            bad = one.client("left")
            bad.socket.sendall(streams[tm // 25 % len(streams)])
            bad.socket.close()
        good.read(3 + tm)
    events = good.read(1002)
    assert [type(event) for event in events[:2]] == [Version, Definition]
    assert [event.value["tm"] for event in events[2:] if isinstance(event, Sample)] == list(range(1000))
    late = [event.value["tm"] for event in silent.read(200) if isinstance(event, Sample)]
    assert late == sorted(set(late)), "a client that reads late gets the buffered rows in order"
    until(lambda: sum("offset" in text for text in one.said) >= 30)
    assert one.server.counts["left"]["clients"] == 3
    assert deaf.socket.fileno() > 0


def test_a_client_that_never_reads_loses_the_oldest_rows_only(start: Start) -> None:
    one = start(FusedChannel(0))
    deaf, arms = one.client("fused"), [FusedArm("arm", 0, row(0))] * 60
    for k in range(2000):
        one.server.fused(k, arms)
        until(lambda: len(one.server._published) < 200)
        if one.server.counts["fused"]["dropped"] > 100:
            break
    assert one.server.counts["fused"]["dropped"] > 100
    last = k
    numbers: list[int] = []
    while not numbers or numbers[-1] < last:
        numbers = [e.value["t_us"] for e in deaf.read(len(deaf.events) + 1) if isinstance(e, Sample)]
    assert numbers == sorted(set(numbers))
    assert numbers[0] == 0, "rows in transit are not lost"
    assert one.server.lost == 0


def test_commands_come_whole_from_any_cut(start: Start) -> None:
    taken: list[int] = []
    one = start(ArmChannel("left", 0, lambda name, row, client: taken.append(row.tm)))
    client = one.client("left")
    raw = command(0)
    for k in range(len(raw)):
        client.socket.sendall(raw[k : k + 1])
    until(lambda: taken == [0])
    for k in range(0, len(raw), 20):
        cut = one.client("left")
        cut.read(2)  # otherwise the system resets the connection instead of closing it
        cut.socket.sendall(raw[:k])
        cut.socket.close()
        until(lambda: one.server.counts["left"]["clients"] == 1)
    assert taken == [0]
    assert any("the end of the stream after" in text for text in one.said)


@pytest.mark.parametrize("dialect", ["2014v1", "2014", "2014i", "2013", "2006"])
def test_a_port_follows_its_client(start: Start, dialect: str) -> None:
    taken: list[int] = []
    one = start(ArmChannel("left", 0, lambda name, row, client: taken.append(row.tm), follows_client=True))
    client = one.client("left")
    client.socket.sendall(command(4, Encoder(dialect)))
    until(lambda: taken == [4])
    one.server.row("left", row(1))
    client.read(2 if dialect == "2006" else 3)
    assert client.decoder.dialect == dialect


def test_a_port_speaks_its_own_dialect_to_who_says_nothing(start: Start) -> None:
    one = start(ArmChannel("left", 0, dialect="2014", follows_client=True))
    client = one.client("left")
    assert client.read(2)[0] == Version("LabComm2014")


def test_at_most_eight_clients(start: Start) -> None:
    one = start(ArmChannel("left", 0))
    clients = [one.client("left") for _ in range(8)]
    assert one.client("left").is_closed()
    clients[0].socket.close()
    until(lambda: one.server.counts["left"]["clients"] == 7)
    one.client("left").read(2)


def test_a_row_of_another_shape_and_a_callback_that_raises_stop_nobody(start: Start) -> None:
    def broken(name: str, row: Row, client: str) -> None:
        raise RuntimeError("broken")

    one = start(ArmChannel("left", 0, broken))
    client = one.client("left")
    one.server.row("left", Row(1, np.zeros(3)))
    client.socket.sendall(command(1))
    until(lambda: any("RuntimeError: broken" in text for text in one.said))
    one.server.row("left", row(2))
    assert client.read(3)[-1].value["tm"] == 2
    assert any("a row was not sent" in text for text in one.said)


def test_a_port_that_is_taken_is_named(start: Start) -> None:
    one = start(ArmChannel("left", 0))
    with pytest.raises(LinkError, match="for left to be free"):
        LabCommServer([ArmChannel("left", one.server.ports["left"])])
    with pytest.raises(UnknownName, match="left"):
        one.server.row("middle", row(0))


@pytest.mark.parametrize("name", ["tcp_client", "command_row"])
@pytest.mark.parametrize("dialect", ["2014v1", "2014", "2014i"])
def test_what_the_c_library_sent_commands_the_arm(start: Start, dialect: str, name: str) -> None:
    path = VECTORS / dialect / ("c_tcp" if name == "tcp_client" else "c_armlab") / f"{name}.bin"
    if not path.exists():
        pytest.skip("needs ../shared/data/labcomm_vectors")
    raw, taken = path.read_bytes(), []
    values = [event.value for event in Decoder().feed(raw) if isinstance(event, Sample)]
    kept = [value for value in values if np.isfinite(value["pos"]).all()]
    one = start(ArmChannel("left", 0, lambda name, row, client: taken.append(row), order="chain", dialect=dialect))
    client = one.client("left")
    client.socket.sendall(raw)
    until(lambda: sum(one.server.counts["left"].get(what, 0) for what in ("commands", "refused")) == len(values))
    assert [row.tm for row in taken] == [value["tm"] for value in kept]
    for got, value in zip(taken, kept, strict=True):
        assert got.q.tolist() == value["pos"]
        assert (got.qd is None) == (not np.nan_to_num(value["vel"]).any())
    assert client.read(2)[0].text == ("LabComm2014.v1" if dialect == "2014v1" else "LabComm2014")


def state(robot: str, **fields: Any) -> State:
    return State(t=1.5, dt=0.004, q=np.arange(7.0), qd=np.zeros(7), tau=np.full(7, np.nan), robot=robot, **fields)


def test_rows_of_a_run_are_published(start: Callable[..., Started]) -> None:
    one = start(ArmChannel("left", 0), ArmChannel("right", 0), FusedChannel(0))
    feed = RowFeed(one.server, {"yumi_left": "left", "yumi_right": "right"})
    left, fused = one.client("left"), one.client("fused")
    feed.row(state("yumi_right"), None, TICK)
    feed.row(state("yumi_left", robot_ns=7_000_000, t_receive=9_000), None, TICK)
    feed.row(state("gripper"), None, TICK)
    feed.event("told", warn=True)
    value = left.read(3)[-1].value
    assert (value["tm"], value["pos"]) == (7, [0.0, 1.0, 3.0, 4.0, 5.0, 6.0, 2.0])
    assert np.isnan(value["trq"]).all()
    event = fused.read(3)[-1]
    assert isinstance(event, Sample)
    assert (event.value["t_us"], [arm["name"] for arm in event.value["arm"]]) == (9, ["right", "left"])
    assert event.value["arm"][0]["tm"] == 1500


def test_commands_pass_the_rights_of_an_arbiter() -> None:
    arm = robots.load("yumi_left")
    arbiter, home = Arbiter([arm], ["labcomm"]), np.array(arm.q_home)
    here = State(0.0, 0.004, home, 0 * home, 0 * home, robot=arm.name)
    take = to_arbiter(arbiter, arm.name)
    assert arbiter(here) is None
    take("left", Row(1, home + 0.06), "far")
    assert arbiter(here) is None, "too far to begin"
    take("left", Row(1, home + 0.01, 0 * home), "near")
    command = arbiter(here)
    assert isinstance(command, Command)
    assert np.allclose(command.q, home + 0.01)
    assert arbiter.commander(arm.name) == "labcomm near"
    assert arbiter.refused == {"labcomm far": 1}


@pytest.mark.parametrize(
    ("order", "called"), [("abb", "axis_7 (number 7 of the vector)"), ("chain", "joint 3 (axis_7)")]
)
def test_a_refusal_names_the_number_that_the_client_sent(order: Any, called: str) -> None:
    """The third joint from the base is ABB's axis 7."""
    arm = robots.load("yumi_left")
    said: list[str] = []
    arbiter = Arbiter([arm], ["labcomm"], answer=lambda client, text: said.append(text))
    home, types = np.array(arm.q_home), RowTypes(arm.abb_axes, order)
    far = home.copy()
    far[2] += 0.5
    sent = types.value(Row(1, far))["pos"]
    to_arbiter(arbiter, arm.name, order)("left", types.command({"pos": sent}), "far")
    arbiter(State(0.0, 0.004, home, 0 * home, 0 * home, robot=arm.name))
    (text,) = said
    assert f"got {far[2]:.4f} for {called} of yumi_left" in text
    assert sent[6 if order == "abb" else 2] == far[2]


TURNS = 200  # of 50 ms at most; reached only if a test fails


class Bench:
    def __init__(self) -> None:
        self.said: list[str] = []
        self.stops: list[str] = []
        self.clients: list[Plain] = []
        self.ours, self.beside = socket.socketpair()
        told: Callable[..., Any] = lambda text, warn=False: self.said.append(text)  # noqa: E731
        self.ports = Ports([ArmChannel("left", 0)], "127.0.0.1", told, self.stops.append, self.beside)

    def until(self, condition: Callable[[], Any]) -> None:
        for _ in range(TURNS):
            if condition():
                return
            self.ports.turn()
        raise AssertionError("it did not happen")

    def client(self) -> Plain:
        client = Plain(self.ports.numbers["left"])
        self.clients.append(client)
        address = "{}:{}".format(*client.socket.getsockname())
        self.until(lambda: any(address in text for text in self.said))
        return client

    def close(self) -> None:
        for client in self.clients:
            client.socket.close()
        self.ports.close()
        self.ours.close()
        self.beside.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    one = Bench()
    yield one
    one.close()


def test_a_client_that_reads_again_gets_what_waited(bench: Bench) -> None:
    client = bench.client()
    (peer,) = bench.ports._peers["left"]
    sent = 0
    while not peer.is_stuck:
        bench.ports.put("left", row(sent))
        sent += 1
        assert sent < 10**6
    numbers: list[int] = []
    client.socket.setblocking(False)

    def reads() -> bool:
        try:
            data = client.socket.recv(2**20)
        except BlockingIOError:
            return False
        numbers.extend(event.value["tm"] for event in client.decoder.feed(data) if isinstance(event, Sample))
        return numbers[-1:] == [sent - 1]

    bench.until(reads)
    assert numbers == list(range(sent))
    assert not peer.is_waiting
    assert not bench.ports.turn(), "no write is requested when nothing is queued"


def test_clients_share_what_a_turn_reads(bench: Bench) -> None:
    encoder = Encoder()
    raw = encoder.version() + encoder.define(STOP) + 30_000 * encoder.data(STOP, {})
    clients = [bench.client() for _ in range(4)]
    for client in clients:
        client.socket.sendall(raw)
    peers = bench.ports._peers["left"]
    until(lambda: len(select.select([peer.socket for peer in peers], [], [], 0.0)[0]) == 4)
    for k in range(1, 20):
        assert bench.ports.turn()
        read = [peer.decoder.offset + peer.decoder.pending for peer in peers]
        assert read == 4 * [1024 * k]
        assert len(bench.stops) == 4 * k, "one stop per read is enough"


def test_what_was_not_taken_is_told_once_and_counted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    client, encoder, (nothing,) = bench.client(), Encoder(), parse_lc("sample void x;")
    assert isinstance(nothing, SampleType)
    client.socket.sendall(encoder.version() + encoder.define(nothing) + 1500 * encoder.data(nothing, {}))
    bench.until(lambda: bench.ports.counts["left"].get("other type") == 1500)
    assert sum("was refused (1 so far), LabCommError" in text for text in bench.said) == 1
    assert len(bench.said) == 2
    monkeypatch.setattr("armlab.bridge.servers.labcomm.server._EVERY", 0.0)
    client.socket.sendall(encoder.data(nothing, {}))
    bench.until(lambda: any("was refused (1501 so far)" in text for text in bench.said))
    client.socket.close()
    bench.until(lambda: bench.said[-1].endswith("disconnected; 1501 samples from this client were refused."))
