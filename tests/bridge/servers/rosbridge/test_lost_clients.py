"""Clients that stop reading, are stopped, are killed, or whose computer has gone, in a whole cell with one that reads.

A computer that has gone is a proxy that carries nothing any more and closes nothing.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import selectors
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from armlab.bridge.cell import parse_cell, run_cell

PROGRAM = """
import json, sys, time
from websockets.sync.client import connect
port, role, topics = int(sys.argv[1]), sys.argv[2], sys.argv[3:]
with connect(f"ws://127.0.0.1:{port}", compression=None, max_queue=None) as client:
    for name in topics:
        client.send(json.dumps({"op": "subscribe", "topic": f"/yumi_left/{name}"}))
    print("ready", flush=True)
    if role == "reader":
        numbers = [json.loads(text)["msg"]["header"]["seq"] for text in client]  # until the server closes
        print(json.dumps(numbers), flush=True)
        sys.exit()
    message = {"data": [0.0] * 7}
    command = {"op": "publish", "topic": "/yumi_left/joint_group_velocity_controller/command", "msg": message}
    for count in range(100000):
        client.recv(60) if count == 0 else time.sleep(0.01)
        client.send(json.dumps(command))
        if count == 50:
            print("commanding", flush=True)
"""
MANY = ("joint_states", "joint_states_sent", "tcp_pose", "egm_states", "wrench_hat", "joint_states_ref")
CELL = """
commands = ["rosbridge"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
speed = 0.5
[servers.rosbridge]
port = 0
dialect = "ros1"
"""
SECONDS = 30.0  # of the robot: a client is given up after 10 s without progress, or 15 s without an answer


class Proxy:
    """Carries bytes between one client and a server, until it is told to carry nothing."""

    def __init__(self, stack: contextlib.ExitStack, port: int) -> None:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        self.port = listener.getsockname()[1]
        self.is_dead, self.closed, self._over = threading.Event(), threading.Event(), threading.Event()
        thread = threading.Thread(target=self._carry, args=(listener, port))
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._over.set)

    def _carry(self, listener: socket.socket, port: int) -> None:
        listener.settimeout(20.0)
        client, _ = listener.accept()
        with client, socket.create_connection(("127.0.0.1", port)) as server, selectors.DefaultSelector() as ready:
            ready.register(client, selectors.EVENT_READ, server)
            ready.register(server, selectors.EVENT_READ, client)
            while not self._over.is_set() and not self.is_dead.is_set():
                for key, _ in ready.select(0.05):
                    key.data.sendall(key.fileobj.recv(65536))  # type: ignore[union-attr]
            name = "{}:{}".format(*server.getsockname())
            while not self._over.is_set() and not self.closed.is_set():
                if not _is_connected(name, port):
                    self.closed.set()
                self._over.wait(0.05)


def _is_connected(name: str, port: int) -> bool:
    """Return whether the server's end of a connection is there, told by the system: to look at ours takes bytes."""
    return any(
        _address(words[1]) == f"127.0.0.1:{port}" and _address(words[2]) == name and words[3] == "01"
        for words in map(str.split, Path("/proc/net/tcp").read_text().splitlines()[1:])
    )


def _address(text: str) -> str:
    host, port = text.split(":")
    return f"{socket.inet_ntoa(bytes.fromhex(host)[::-1])}:{int(port, 16)}"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="tells of connections on Linux only")
def test_one_client_reads_while_the_others_are_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Takes 35 s."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with contextlib.ExitStack() as stack:
        programs: list[subprocess.Popen[bytes]] = []
        proxies: list[Proxy] = []

        def run(port: int, role: str, *topics: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-c", PROGRAM, str(port), role, *topics]
            program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
            programs.append(stack.enter_context(program))
            stack.callback(program.kill)
            said(program, b"ready\n")
            return program

        def lose(port: int, commander: subprocess.Popen[bytes]) -> None:
            said(commander, b"commanding\n")
            proxies[1].is_dead.set()
            killed = run(port, "commander", "tcp_pose")
            said(killed, b"commanding\n")
            killed.kill()

        def ready(line: str) -> None:
            found = re.search(r":(\d+) \(rosbridge\)", line)
            assert found is not None, line
            port = int(found[1])
            proxies.extend(Proxy(stack, port) for _ in range(2))
            run(port, "reader", "joint_states")
            os.kill(run(port, "reader", *MANY).pid, signal.SIGSTOP)
            run(proxies[0].port, "reader", *MANY)
            proxies[0].is_dead.set()
            commander = run(proxies[1].port, "commander", "tcp_pose")
            thread = threading.Thread(target=lose, args=(port, commander))  # rows come when this has returned
            thread.start()
            stack.callback(thread.join)

        cell_run = run_cell(parse_cell(CELL), seconds=SECONDS, ready=ready, patience=30.0)
        assert all(proxy.closed.is_set() for proxy in proxies), "the server kept clients that had gone"
        output, _ = programs[0].communicate(timeout=30.0)
    numbers = np.array(json.loads(output))
    assert len(numbers) > 1000
    assert np.all(np.diff(numbers) > 0)
    assert len(numbers) >= 0.999 * (numbers[-1] - numbers[0] + 1)
    assert re.search(r"To its clients: .* dropped\)", cell_run.report())
    served = cell_run.statistics["servers"]["rosbridge"]
    assert served["lost"] == 0, "the loop waited for no client, and the server for none"
    assert sum(dropped > 0 for _, dropped in served["clients"].values()) == 3  # stopped, and twice gone
    freed = [event for _, event in cell_run.events if "no longer commands yumi_left" in event]
    assert len(freed) == 2, cell_run.events
    assert cell_run.statistics["missed"] <= 0.001 * cell_run.statistics["packets"]


def said(program: subprocess.Popen[bytes], line: bytes) -> None:
    assert program.stdout is not None
    assert program.stdout.readline() == line
