"""Whole bridges with the simulated robot, LabComm clients and the local feed."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log, robots
from armlab.bridge.cell import Cell, parse_cell, run_cell
from armlab.bridge.command.arbiter import Arbiter
from armlab.bridge.inputs.parameters import Parameters
from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import CommandRequest, SetRequest, Stop, Subscribe
from armlab.bridge.servers.row import Row
from armlab.cli import main
from armlab.state import Command
from tests.processes import bound


def server_process(name: str) -> int:
    """Number of the newest process that serves under a name."""
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            words = (folder / "cmdline").read_bytes().split(b"\0")
            if b"armlab.bridge.servers.serve" in words and name.encode() in words and folder.name.isdigit():
                parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
                found += [int(folder.name)] if int(parent) == os.getpid() else []
    return max(found)


JOINT = np.eye(7)[3]

ALL = """
[servers.ros2]
domain = {domain}
[servers.rmw_zenoh]
domain = {domain}
port = {router}
[servers.zenoh]
port = {zenoh}
[servers.rosbridge]
port = 0
[servers.plotjuggler]
port = {free}
"""


def free_ports(count: int) -> list[int]:
    """Return ports on which nobody listens."""
    with contextlib.ExitStack() as stack:
        probes = [stack.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in probes]


class Bench:
    """Runs a cell in this thread while a script plays its clients in another."""

    def __call__(self, cell: Cell, script: Callable[[dict[str, int]], None], seconds: float, **options: Any) -> Any:
        failures: list[BaseException] = []
        threads: list[threading.Thread] = []
        self.line = ""

        def play(ports: dict[str, int]) -> None:
            try:
                script(ports)
            except BaseException as error:
                failures.append(error)

        def ready(line: str) -> None:
            self.line = line
            ports = {name: int(port) for port, name in re.findall(r":(\d+) \(labcomm, (\w+)\)", line)}
            threads.append(threading.Thread(target=play, args=(ports,), daemon=True))
            threads[0].start()

        try:
            return run_cell(cell, seconds=seconds, ready=ready, patience=10.0, **options)
        finally:
            threads[0].join(20.0)
            assert not threads[0].is_alive()
            if failures:
                raise failures[0]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return Bench()  # type: ignore[return-value]


def rows(feed: LocalFeed) -> Iterator[Any]:
    while True:
        message = feed.receive()
        if isinstance(message, Row):
            yield message.values


def test_a_local_client_commands_in_real_time(cell_text: str, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """It moves one joint; the parameter is set; what was sent is what it asked for. The run ends when it has left."""
    asked: list[np.ndarray] = []
    there = threading.Event()
    obey = Arbiter.__call__

    def obey_or_end(arbiter: Arbiter, state: Any) -> Any:
        command = obey(arbiter, state)
        return Command.stop() if there.is_set() and not arbiter.commander("yumi_left") else command

    monkeypatch.setattr(Arbiter, "__call__", obey_or_end)

    def script(ports: dict[str, int]) -> None:
        with contextlib.ExitStack() as stack:
            stack.callback(there.set)
            feed = stack.enter_context(LocalFeed())
            assert bound(os.getpid()) == {"127.0.0.1"}, "127.0.0.1 only, in a full run"
            feed.ask(Subscribe(rate=None))
            feed.ask(SetRequest(values={"gain": 3.0, "gentle": False}))
            start = None
            for values in rows(feed):
                start = values["yumi_left.q"] if start is None else start
                if values["yumi_left.mci"] != 3:
                    continue
                asked.append(start + min(0.04, 0.0005 * len(asked)) * JOINT)
                feed.ask(CommandRequest(arm="yumi_left", q=asked[-1].tolist(), seq=len(asked)))
                off = values["yumi_left.q_sent"] - start - 0.04 * JOINT
                is_there = np.abs([off, values["yumi_left.qd_sent"]]).max() < 1e-9
                if is_there and values["yumi_left.commander"]:
                    assert values["yumi_left.commander"].startswith("local ")
                    assert len(asked) > 80
                    return

    cell = parse_cell(cell_text.replace("?lockstep=true", ""))
    run = bench(cell, script, seconds=60.0)
    told = [text for _, text in run.events]
    assert run.reason == "the controller ended the run"
    assert "yumi_left" in bench.line
    assert any(re.fullmatch(r"local \d+ commands yumi_left\.", text) for text in told)
    assert any("no longer commands yumi_left" in text for text in told)
    assert any("Parameter gain = 3.0, set by local " in text for text in told)
    sent = run.table["q_sent"][np.isfinite(run.table["q_sent"]).all(axis=1)]
    np.testing.assert_allclose(sent[-1], asked[-1], atol=1e-9)
    assert np.abs(np.delete(sent - sent[0], 3, axis=1)).max() < 1e-3


@pytest.mark.slow
def test_a_controller_of_its_own_reads_parameters_and_listens_to_a_stop(
    cell_text: str, bench: Bench, tmp_path: Path
) -> None:
    """Two arms; the history of the parameters is in both logs. Takes 4 s."""
    both = cell_text.replace("?lockstep=true", "").replace(
        "[parameters.gain]", '[[robots]]\nname = "yumi_right"\nlink = "sim://yumi_right"\n[parameters.gain]'
    )
    both = both.replace("ports = {yumi_left = 0}", "ports = {yumi_left = 0, yumi_right = 0}")
    cell = parse_cell(both.replace('name = "yumi"', f'name = "yumi"\nrecord = "{tmp_path / "run.mcap"}"'))
    params = Parameters(cell.parameters)
    seen: list[float] = []

    def controller(state: Any) -> Any:
        seen.append(params.gain)
        return Command(qd=np.full(14, 0.01))

    def script(ports: dict[str, int]) -> None:
        with LocalFeed() as feed:
            feed.ask(Subscribe(rate=None))
            for values in rows(feed):
                if values["yumi_right.qd_sent"][0] > 0.009:
                    break
            feed.ask(CommandRequest(arm="yumi_left", qd=[0.0] * 7))
            feed.ask(SetRequest(values={"gain": 7.0}))
            for _ in rows(feed):
                if seen[-1] == 7.0:
                    break
            feed.ask(Stop())

    run = bench(cell, script, seconds=1.5, controller=controller, parameters=params)
    assert (seen[0], seen[-1]) == (2.0, 7.0)
    for arm in run.arms:
        assert arm.path is not None
        assert log.inspect(arm.path).attachments["cell.toml"] == cell.text.encode()
        sent = arm.table.dropna("qd_sent")["qd_sent"]  # a tick that found no packet of the robot sends nothing
        assert len(sent) > 20
        assert np.abs(sent[-20:]).max() < 1e-9
        assert arm.statistics["parameters"]["gain"] == 7.0
    assert main(["log", "show", "--parameters", str(tmp_path / "runleft.mcap")]) == 0


@pytest.mark.slow
def test_stop_holds_all_arms(cell_text: str, bench: Bench) -> None:
    """Takes 4 s."""

    def script(ports: dict[str, int]) -> None:
        with LocalFeed() as feed, LocalFeed() as other:
            feed.ask(Subscribe(rate=None))
            for k, values in enumerate(rows(feed)):
                if values["yumi_left.mci"] != 3:
                    continue
                feed.ask(CommandRequest(arm="yumi_left", qd=[0.02] * 7))
                if values["yumi_left.commander"] and k > 50:
                    other.ask(Stop())
                    break
            for values in rows(feed):
                if not values["yumi_left.commander"]:
                    return

    run = bench(parse_cell(cell_text.replace("?lockstep=true", "")), script, seconds=1.0)
    assert any("Stopped by local" in text for _, text in run.events)
    sent = run.table.dropna("qd_sent")["qd_sent"]  # a tick that found no packet of the robot sends nothing
    assert np.abs(sent[-20:]).max() < 1e-9


@pytest.mark.slow
def test_torques_of_a_client_reach_the_arm_within_the_bound(cell_text: str, bench: Bench) -> None:
    """Torques are clipped at the bound. Takes 4 s."""

    def push(ports: dict[str, int]) -> None:
        with LocalFeed() as feed:
            feed.ask(Subscribe(rate=None))
            for values in rows(feed):
                if values["yumi_left.mci"] == 3:
                    feed.ask(CommandRequest(arm="yumi_left", tau=[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
                if values["yumi_left.tau_sent"][0] == 1.5:
                    return

    text = cell_text.replace("?lockstep=true", "").replace("speed = 0.5", "speed = 0.5\ntorque = 1.5")
    run = bench(parse_cell(text), push, seconds=0.8)
    assert np.nanmax(run.table["tau_sent"]) == 1.5
    assert run.statistics["clamps"]["torque"][0] > 0


@pytest.mark.slow
def test_a_controller_over_labcomm(cell_text: str, bench: Bench) -> None:
    """A controller elsewhere, through the LabComm port of the arm. Takes 6 s."""
    from armlab import bridge

    seen: list[Any] = []

    def script(ports: dict[str, int]) -> None:
        url = f"labcomm://127.0.0.1:{ports['yumi_left']}"

        def sway(state: Any) -> Any:
            seen.append(state.q)
            return Command(state.q_start + 0.02 * np.sin(3.0 * state.t))

        with bridge.connect(url, robots.load("yumi_left"), patience=5.0) as link:
            link.run(sway, seconds=0.8)

    cell = parse_cell(cell_text.replace("?lockstep=true", "").replace('["local"]', '["labcomm"]'))
    run = bench(cell, script, seconds=2.5)
    assert len(seen) > 100
    assert any("labcomm 127.0.0.1:" in text and "commands yumi_left." in text for _, text in run.events)
    assert np.nanmax(run.table["q_sent"][:, 2]) - np.nanmin(run.table["q_sent"][:, 2]) > 0.005


@pytest.mark.slow
def test_ten_idle_clients_and_one_that_never_reads(cell_text: str, bench: Bench) -> None:
    """Nor does the loop notice that the server of LabComm is killed; it starts again. Takes 5 s."""

    def script(ports: dict[str, int]) -> None:
        idle = [
            socket.create_connection(("127.0.0.1", ports[name])) for name in ("yumi_left", "fused") for _ in range(5)
        ]
        with LocalFeed() as silent, LocalFeed() as feed:
            silent.ask(Subscribe(rate=None))
            feed.ask(Subscribe(rate=None))
            numbers = []
            for values in rows(feed):
                numbers.append(values["yumi_left.tick"])
                if len(numbers) == 200:
                    os.kill(server_process("labcomm"), signal.SIGKILL)
                if len(numbers) == 600:
                    break
            assert np.all(np.diff(numbers) > 0)
        for one in idle:
            one.close()

    run = bench(parse_cell(cell_text.replace("?lockstep=true", "")), script, seconds=3.5)
    assert run.statistics["missed"] == 0
    told = [text for _, text in run.events]
    assert any("The server labcomm ended with status -9. It starts again in 1 s." in text for text in told)


@pytest.mark.slow
def test_a_full_run_with_every_server_listens_on_this_computer_only(cell_text: str, bench: Bench) -> None:
    """Cyclone DDS alone binds to all addresses, and is tied to loopback: see ros/test_dds_domain.py. Takes 10 s."""
    for module, extra in (("cyclonedds", "ros"), ("zenoh", "net"), ("websockets", "net"), ("xxhash", "net")):
        pytest.importorskip(module, reason=f"the extra {extra} is not installed")
    from .servers.ros.dds_peers import free_domain

    def script(ports: dict[str, int]) -> None:
        ros2 = server_process("ros2")
        assert bound(os.getpid(), but=ros2) == {"127.0.0.1"}
        if shutil.which("ss"):
            listed = subprocess.run(["ss", "-Huanp"], capture_output=True, text=True, check=True).stdout.splitlines()
            own = [line.split()[3] for line in listed if f"pid={ros2}," in line]
            assert any("%lo:" in one for one in own)
            assert all(one.startswith("127.0.0.1:") or "%lo:" in one for one in own), own

    router, zenoh, free = free_ports(3)
    text = cell_text.replace("?lockstep=true", "")
    text += ALL.format(domain=free_domain(), router=router, zenoh=zenoh, free=free)
    bench(parse_cell(text), script, seconds=1.0)
    for name in ("labcomm", "ros2", "rmw_zenoh", f"127.0.0.1:{zenoh}", "rosbridge", "plotjuggler", "local"):
        assert name in bench.line
