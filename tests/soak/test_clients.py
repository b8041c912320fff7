"""Clients that come and go, one after another, leave nothing behind in the servers that they came to."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator

import pytest

from armlab.bridge.servers.labcomm import LabCommClient
from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe
from soak.processes import family, held, label
from soak.programs import Program
from tests.processes import free_port, until

pytestmark = pytest.mark.slow

MIB = 2**20  # bytes by which memory may grow: the piece in which Python takes it from the kernel
TOPIC = {"op": "subscribe", "topic": "/yumi_left/joint_states", "type": "sensor_msgs/msg/JointState"}


@pytest.fixture(scope="module")
def ports() -> dict[str, int]:
    return {name: free_port() for name in ("rosbridge", "labcomm", "zenoh")}


@pytest.fixture(scope="module")
def bridge(ports: dict[str, int], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Program]:
    """A bridge with a simulated arm and a server of each kind that is tried; its local socket is this test's own."""
    folder = tmp_path_factory.mktemp("clients")
    text = '[[robots]]\nname = "yumi_left"\nlink = "sim://yumi_left?lagging=true"\n'
    text += f"[servers.labcomm]\nports = {{ yumi_left = 0 }}\nparameters = 0\nrows = {ports['labcomm']}\n"
    text += "".join(f"[servers.{name}]\nport = {ports[name]}\n" for name in ("rosbridge", "zenoh"))
    (folder / "cell.toml").write_text(text)
    words = [sys.executable, "-m", "armlab", "bridge", "--config", str(folder / "cell.toml")]
    with (
        pytest.MonkeyPatch.context() as patch,
        Program("bridge", words, folder, {"XDG_RUNTIME_DIR": str(folder)}) as it,
    ):
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        it.await_word("Listening:")
        yield it
        assert it.end(signal.SIGINT) in (0, 130)


def local(_: int) -> None:
    with LocalFeed() as feed:
        feed.ask(Subscribe(rate=None))
        for _ in range(5):
            feed.receive()


def labcomm(port: int) -> None:
    with LabCommClient(port=port) as client:
        for _ in range(2):
            list(client.events(1.0))


def rosbridge(port: int) -> None:
    client = pytest.importorskip("websockets.asyncio.client")

    async def visit() -> None:
        async with client.connect(f"ws://127.0.0.1:{port}", compression=None) as socket:
            await socket.send(json.dumps(TOPIC))
            for _ in range(3):
                await socket.recv()

    asyncio.run(visit())


def zenoh(port: int) -> None:
    feed = pytest.importorskip("armlab.bridge.servers.zenoh").ZenohFeed(f"zenoh://127.0.0.1:{port}", patience=30.0)
    try:
        feed.ask(Subscribe(rate=None))
        feed.wait(5.0)
        feed.receive()
    finally:
        feed.close()


@pytest.mark.parametrize(("visit", "count"), [(local, 50), (labcomm, 50), (rosbridge, 50), (zenoh, 4)])
def test_clients_that_come_and_go_leave_nothing_behind(
    bridge: Program, ports: dict[str, int], visit: Callable[[int], None], count: int
) -> None:
    """Three lots of them: the second costs the server no more than one piece of memory, nor does the third.

    Takes 2 to 20 s each.
    """
    name = visit.__name__
    looks = []
    for _ in range(3):
        for _ in range(count):
            visit(ports.get(name, 0))
        looks.append(settled(bridge.process.pid, f"server {name}", looks))
    memory, descriptors, threads = zip(*looks, strict=True)
    assert memory[2] - memory[0] <= MIB
    assert max(descriptors) <= descriptors[0]
    assert max(threads) <= threads[0]


def settled(root: int, name: str, before: list[tuple[int, int, int]]) -> tuple[int, int, int]:
    """Return what a server holds, once the last client's connection has been closed on its side too."""
    (pid,) = [one for one in family(root) if label(one, root) == name]

    def look() -> tuple[int, int, int]:
        return held(pid)[:3]

    looks = [look()]

    def is_still() -> bool:
        """Whether nothing was closed in twenty looks; later lots also wait until they cost what the first did."""
        looks.append(look())
        return len({one[1:] for one in looks[-20:]}) == 1 and len(looks) >= 20

    until(is_still)
    if before:
        until(lambda: look()[1] <= before[0][1] and look()[2] <= before[0][2])
    return look()


def test_the_socket_is_that_of_the_test(bridge: Program) -> None:
    assert str(bridge.out.parent) == os.environ["XDG_RUNTIME_DIR"]
