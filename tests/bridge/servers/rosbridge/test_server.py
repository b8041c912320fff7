"""`RosbridgeServer` as a process, with WebSocket clients: permissions, waiting, and clients that do not read."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import ssl
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.asyncio.client import connect as one_thread
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from armlab import robots
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.rosbridge.server import Access, RosbridgeServer, read_access
from armlab.errors import ConfigError

from ..conftest import PATIENCE, ServedProcess, until
from .conftest import HANDSHAKE

STATES = "/yumi_right/joint_states"
POSITION = "/yumi_right/joint_group_position_controller/command"
OPTIONS = {"host": "127.0.0.1", "port": 0, "dialect": "ros2", "origins": ["https://lab.example"]}


class Running(ServedProcess):
    def __init__(self, stack: contextlib.ExitStack, **options: Any) -> None:
        super().__init__(stack, "rosbridge", {**OPTIONS, **options})
        self.port = int(self.where.partition(" ")[0].rpartition(":")[2])

    def client(self, **options: Any) -> ClientConnection:
        scheme = "wss" if "ssl" in options else "ws"
        options |= {"max_queue": None, "close_timeout": 1.0}
        return self.stack.enter_context(connect(f"{scheme}://127.0.0.1:{self.port}", **options))

    def until(self, condition: Callable[[], Any]) -> Any:
        return until(lambda: condition() or self.row())

    def heard(self, client: ClientConnection, op: str = "publish") -> Any:
        def look() -> Any:
            with contextlib.suppress(TimeoutError):
                message = json.loads(client.recv(0.0))
                return message if message["op"] == op else None
            return None

        return self.until(look)


@pytest.fixture
def start() -> Iterator[Callable[..., Running]]:
    with contextlib.ExitStack() as stack:
        yield lambda **options: Running(stack, **options)


@pytest.fixture(scope="module")
def shared() -> Iterator[Running]:
    with contextlib.ExitStack() as stack:
        yield Running(stack)


@pytest.fixture
def running(shared: Running) -> Iterator[Running]:
    with contextlib.ExitStack() as shared.stack:
        yield shared


def say(client: ClientConnection, op: str, **fields: Any) -> None:
    client.send(json.dumps({"op": op, **fields}))


def frame(op: str, **fields: Any) -> bytes:
    """Return an operation as a WebSocket frame with a mask of zeros."""
    text = json.dumps({"op": op, **fields}).encode()
    return struct.pack(">BBH4s", 0x81, 0x80 | 126, len(text), bytes(4)) + text


def test_rows_go_out_and_commands_come_back(start: Callable[..., Running]) -> None:
    running = start()
    assert re.fullmatch(r"127\.0\.0\.1:\d+ \(rosbridge\)", running.where)
    client, other = running.client(), running.client()
    say(client, "subscribe", topic=STATES)
    message = running.heard(client)
    assert message["msg"]["position"] == running.robot.q_home.tolist()
    goal = (running.robot.q_home + 0.01).tolist()
    me, they = ("rosbridge {}:{}".format(*one.local_address[:2]) for one in (client, other))
    arbiter = running.exchange.arbiter

    def commanded() -> bool:
        say(client, "publish", topic=POSITION, msg={"data": goal})  # repeated: a command is valid for only 100 ms
        command = arbiter(running.state())
        is_ours = command is not None and command.q is not None and np.allclose(command.q, goal)
        return is_ours and arbiter.commander("yumi_right") == me

    def refused() -> ClientConnection | None:
        say(other, "publish", topic=POSITION, msg={"data": goal})
        commanded()
        return other if they in arbiter.refused else client if me in arbiter.refused else None

    running.until(commanded)
    second = running.until(refused)  # `client`, after it has been silent for 100 ms
    say(other, "publish", topic="/yumi_right/stop", msg={})
    running.until(lambda: arbiter.stopped)
    assert (
        f"is commanded by {they if second is client else me}. You have read-only access."
        in running.heard(second, "status")["msg"]
    )
    client.close()
    counted = running.exchange.summary()["servers"]["rosbridge"]["clients"]
    assert counted[me.removeprefix("rosbridge ")][0] > 0


def test_a_commander_that_goes_frees_its_arm(running: Running) -> None:
    client = running.client()
    say(client, "publish", topic=POSITION, msg={"data": running.robot.q_home.tolist()})
    running.until(lambda: running.exchange.arbiter(running.state()))
    client.socket.shutdown(socket.SHUT_RDWR)
    running.until(lambda: not running.exchange.arbiter.commander("yumi_right"))


def test_parameters_are_set_and_refused(running: Running) -> None:
    client = running.client()
    say(client, "call_service", service="/rosapi/set_param", args={"name": "gain", "value": "0.75"}, id="1")
    assert running.heard(client, "service_response")["result"]
    assert running.exchange.parameters.gain == 0.75
    say(client, "call_service", service="/rosapi/set_param", args={"name": "gain", "value": "7"}, id="2")
    refused = running.heard(client, "service_response")
    assert (refused["id"], refused["result"]) == ("2", False)
    assert "from 0 to 1" in refused["values"]
    say(client, "call_service", service="/rosapi/set_param", args={"name": "gain", "value": "0.5"}, id="3")
    assert running.heard(client, "service_response")["result"]


def test_a_client_that_does_not_read_disturbs_nobody(running: Running) -> None:
    client, deaf = running.client(), socket.socket()
    running.stack.callback(deaf.close)
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    deaf.connect(("127.0.0.1", running.port))
    deaf.sendall(HANDSHAKE)
    for name in ("joint_states", "tcp_pose", "egm_states"):
        deaf.sendall(frame("subscribe", topic=f"/yumi_right/{name}"))
    say(client, "subscribe", topic=STATES)
    last = running.heard(client)["msg"]["header"]["stamp"]["nanosec"]
    end = time.monotonic() + PATIENCE
    name = "{}:{}".format(*deaf.getsockname())

    def dropped() -> int:
        return running.exchange.outlets["rosbridge"].clients.get(name, (0, 0))[1]  # type: ignore[union-attr]

    running.exchange.outlets["rosbridge"].clients = {}
    while dropped() < 500:
        assert time.monotonic() < end, "nothing was dropped"
        for _ in range(100):
            running.row()
            message = json.loads(client.recv(PATIENCE))
            assert message["msg"]["header"]["stamp"]["nanosec"] == last + 1
            last += 1
        running.exchange.outlets["rosbridge"].send(b'{"kind":"count"}')


def test_sixteen_clients_at_most(running: Running) -> None:
    def connected() -> Any:
        with contextlib.suppress(InvalidStatus):
            return running.client()

    clients = [running.until(connected) for _ in range(16)]
    with pytest.raises(InvalidStatus, match="HTTP 503"):
        running.client()
    clients[0].close()
    assert running.until(connected)


def test_pages_of_other_sites_may_not_connect(running: Running) -> None:
    for origin in ("http://localhost:8000", "http://127.0.0.1", "https://lab.example"):
        running.client(origin=origin)
    for origin in ("https://elsewhere.example", "null", "http://localhost.elsewhere.example", "http://localhost:1@a"):
        with pytest.raises(InvalidStatus, match="HTTP 403"):
            running.client(origin=origin)


def test_too_much_at_once_ends_the_connection_and_no_other(running: Running) -> None:
    client, other = running.client(), running.client()
    client.send("x" * 1_100_000)
    with pytest.raises(ConnectionClosed, match="1009"):
        client.recv(PATIENCE)
    other.send(b"\xff\x00")
    assert "got a binary message" in running.heard(other, "status")["msg"]


@pytest.mark.slow
def test_a_token_over_tls(start: Callable[..., Running], tmp_path: Path) -> None:
    """Uses the asyncio client, because the threaded client sometimes waits forever with TLS."""
    secret = tmp_path / "token"
    secret.write_text(TOKEN)
    secret.chmod(0o600)
    certificate, key = make_certificate(tmp_path)
    running = start(token_file=str(secret), certificate=certificate, key=key)
    assert "TLS" in running.where
    trusted = ssl.create_default_context(cafile=certificate)
    command = json.dumps({"op": "publish", "topic": POSITION, "msg": {"data": running.robot.q_home.tolist()}})
    where, headers = f"wss://127.0.0.1:{running.port}", {"Authorization": f"Bearer {TOKEN}"}

    async def talk() -> None:
        async with (
            one_thread(where, ssl=trusted, additional_headers=headers) as knows,
            one_thread(where, ssl=trusted) as reads,
        ):
            with pytest.raises(InvalidStatus, match="HTTP 401"):
                await one_thread(where, ssl=trusted, additional_headers={"Authorization": "Bearer wrong"})
            await reads.send(command)
            answer = json.loads(await asyncio.wait_for(reads.recv(), PATIENCE))
            assert answer["op"] == "status"
            assert "Expected a token" in answer["msg"]
            await knows.send(command)
            running.until(lambda: running.exchange.arbiter(running.state()))

    asyncio.run(talk())


def test_it_ends_with_the_loop() -> None:
    hub = Hub([robots.load("yumi_right")], ["rosbridge"], about={"cell": "yumi"})
    with hub.open("rosbridge") as feed:
        hub.close()
        RosbridgeServer(feed, OPTIONS).run()


TOKEN = "0123456789abcdef-_"


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n")
    path.chmod(0o600)
    return path


def test_without_a_token_everybody_may_ask() -> None:
    access = read_access({})
    assert access.judge(None) is True
    assert access.judge("Bearer whatever") is True
    assert access.context is None
    assert isinstance(access, Access)


def test_with_a_token_those_who_know_it(secret: Path) -> None:
    for access in (read_access({"token_file": str(secret)}), read_access({"token_variable": "T"}, {"T": TOKEN})):
        assert access.judge(f"Bearer {TOKEN}") is True
        assert access.judge(f"bearer  {TOKEN} ") is True
        assert access.judge(None) is False, "reads"
        for wrong in ("", "Bearer", f"Bearer {TOKEN}x", TOKEN, f"Basic {TOKEN}", "Bearer \ud800\u00e4"):
            assert access.judge(wrong) is None
        assert TOKEN not in repr(access)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644, 0o660])
def test_a_file_that_others_read_is_no_secret(secret: Path, mode: int) -> None:
    secret.chmod(mode)
    with pytest.raises(ConfigError, match=f"got mode {mode:04o}. Run chmod 600"):
        read_access({"token_file": str(secret)})


def test_what_is_no_token(tmp_path: Path, secret: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        read_access({"token_file": str(tmp_path / "none")})
    with pytest.raises(ConfigError, match="got both"):
        read_access({"token_file": str(secret), "token_variable": "T"})
    for text in ("", "short", "with spaces in the middle", "\u00e4" * 20):
        with pytest.raises(ConfigError, match=r"at least 16 ASCII characters .* in the variable T") as caught:
            read_access({"token_variable": "T"}, {"T": text})
        assert not text or text not in str(caught.value)


def test_certificates(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path)
    assert read_access({"certificate": certificate, "key": key}).context is not None
    wrong: list[dict[str, Any]] = [
        {"certificate": certificate, "key": certificate},
        {"certificate": str(tmp_path / "none"), "key": key},
    ]
    for options in wrong:
        with pytest.raises(ConfigError, match="Expected a certificate in"):
            read_access(options)
    for name in ("certificate", "key"):
        with pytest.raises(ConfigError, match="got only one of them"):
            read_access({name: certificate})


def make_certificate(folder: Path) -> tuple[str, str]:
    certificate, key = str(folder / "certificate.pem"), str(folder / "key.pem")
    words = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=127.0.0.1"
    command = ["openssl", *words.split(), "-addext", "subjectAltName=IP:127.0.0.1", "-out", certificate, "-keyout", key]
    subprocess.run(command, check=True, capture_output=True)
    return certificate, key
