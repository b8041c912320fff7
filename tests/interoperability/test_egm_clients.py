"""Third-party EGM clients, each in its own environment and process, driven by `armlab sim`.

They are installed from PyPI; where that is not possible the tests are skipped with the reason. About 50 s in all,
mostly for installing, and one minute with both clients and our own bridge at once.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
CLIENTS = {"ABBRobotEGM": "abb_robot_egm.txt", "abb_robot_client": "abb_robot_client.txt"}
SECONDS, MOTION = 10.0, 6.0
MINUTE, BOTH = 60.0, {"ABBRobotEGM": "irb1200", "abb_robot_client": "yumi_right"}
GAIN = 5.0  # 1/s of the controller: without speeds a reference runs ahead by v / gain
FLAVOURS = [("6", "6.07", ()), ("7", "6.10", ("--extension",)), ("7", "7", ("--force", "--rapid-data", "2"))]
RUNS = [(client, *flavour) for client in CLIENTS for flavour in FLAVOURS]

pytestmark = pytest.mark.slow


def install(folder: Path, client: str) -> Path | str:
    """Return the interpreter of a client's environment, or the reason why there is none."""
    python = folder / client / "bin" / "python"
    pip = [python, "-m", "pip", "--disable-pip-version-check", "install", "-q", "-r", HERE / CLIENTS[client]]
    for command in ([sys.executable, "-m", "venv", folder / client], pip):
        done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
        if done.returncode:
            return f"{client} cannot be installed: {(done.stderr or done.stdout).strip().splitlines()[-1:]}"
    return python


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def drive(folder: Path, python: Path | str, run: tuple[str, str, str, tuple[str, ...]]) -> Any:
    """Return the observations of a client and the simulator, or the reason why the client did not run."""
    client, axes, robotware, more = run
    if isinstance(python, str):
        return python
    port, stats = free_port(), folder / f"{client}_{axes}_{robotware}.json"
    simulator = [
        *(sys.executable, "-m", "armlab", "sim", "--axes", axes, "--robotware", robotware, *more),
        *("--to", f"127.0.0.1:{port}", "--seconds", str(SECONDS), "--stats", str(stats)),
        *("--window", "0.005", "--condition-time", "1.5", "--patience", "60"),
    ]
    client_command = [str(python), str(HERE / "client.py"), client, str(port), str(MOTION)]
    with subprocess.Popen(client_command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as other:
        done = subprocess.run(simulator, capture_output=True, text=True)
        out, err = other.communicate(timeout=60)
    assert done.returncode == 0, done.stderr
    assert other.returncode == 0, err
    [counted] = json.loads(stats.read_text()).values()
    return json.loads(out), counted


@pytest.fixture(scope="module")
def pythons(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path | str]:
    """The clients' environments, created in parallel."""
    folder = tmp_path_factory.mktemp("environments")
    with ThreadPoolExecutor() as pool:
        return dict(zip(CLIENTS, pool.map(lambda client: install(folder, client), CLIENTS), strict=True))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory, pythons: dict[str, Path | str]) -> dict[Any, Any]:
    """All clients and flavours, three runs at a time: two cores cannot handle more."""
    folder = tmp_path_factory.mktemp("clients")
    with ThreadPoolExecutor(3) as pool:
        return dict(zip(RUNS, pool.map(lambda run: drive(folder, pythons[run[0]], run), RUNS), strict=True))


@pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run[0]}, {run[1]} axes, RobotWare {run[2]}")
def test_a_client_moves_the_simulated_robot(results: dict[Any, Any], run: Any) -> None:
    """Joint 1 and axis 7 follow a cosine with the expected lag and arrive; the arm converges, a new session begins."""
    if isinstance(results[run], str):
        pytest.skip(results[run])
    seen, counted = results[run]
    axes = int(run[1])
    assert len(seen["last"]) == axes
    for k in (0, 6)[: axes - 5]:
        assert seen["last"][k] == pytest.approx(seen["wanted"][k], abs=0.1)
        assert seen["last"][k] - seen["first"][k] == pytest.approx(20.0, abs=0.1)
    for k in range(1, 6):
        assert seen["last"][k] == pytest.approx(seen["first"][k], abs=0.1)
    lag = 10.0 * 3.1416 / MOTION / GAIN  # degrees, at the fastest
    assert 0.8 * lag < seen["error"] < 1.5 * lag + 0.3
    assert counted["rapid"]["1"] == 1.5
    if run[2] == "7":
        assert seen["rapid"][0] == 1.5, "RAPID sends back what it receives"
        assert seen["packets"] - 8 < seen["rapid"][1] < seen["packets"]
    assert seen["restarts"] >= 1
    counts = counted["counts"]
    assert counts["sessions"] >= 2
    assert seen["packets"] > 0.95 * counts["packets"]
    assert counts["replies"] > 0.95 * counts["packets"]
    assert not {"unparsable", "wrong type", "joint count", "no joints"} & set(counted["drops"])


def real_time() -> None:
    """Give a process real-time priority, where that is permitted."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))


def stolen() -> float:
    """Return the time that a hypervisor took from this machine [s], 0 if not reported."""
    with contextlib.suppress(OSError, IndexError):
        return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")
    return 0.0


def test_both_clients_are_answered_for_a_minute_without_a_cycle_missed_by_us(
    tmp_path: Path, pythons: dict[str, Path | str]
) -> None:
    """Six and seven axes at once, with our own bridge on a third arm: 60 s of traffic, joint motion is followed.

    A cycle counts as missed by us if the simulated controller skips it because its own computation took longer than a
    period, if it does not read a received message, or if our bridge is late through its own computation. Delays from
    other work on the machine, and late replies of a client, are counted but not attributed to us. Time taken by a
    hypervisor looks like computation, so as many cycles as fit into it are excused; none on a real machine.
    """
    for python in pythons.values():
        if isinstance(python, str):
            pytest.skip(python)
    ports, stats = [free_port() for _ in range(3)], tmp_path / "stats.json"
    motion = MINUTE - 3.0
    commands = [
        [str(pythons[client]), str(HERE / "client.py"), client, str(port), str(motion)]
        for client, port in zip(BOTH, ports, strict=False)
    ]
    commands.append([sys.executable, str(HERE / "beside.py"), str(ports[2])])
    simulator = [
        *(sys.executable, "-m", "armlab", "sim", *BOTH.values(), "yumi_left", "--robotware", "7", "--rapid-data", "2"),
        *("--to", ",".join(f"127.0.0.1:{port}" for port in ports), "--seconds", str(MINUTE), "--stats", str(stats)),
        *("--window", "0", "--phase", "0.001", "--comm-timeout", "10"),
    ]
    before = stolen()
    with contextlib.ExitStack() as running:
        peers = [
            running.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
            for command in commands
        ]
        done = subprocess.run(simulator, capture_output=True, text=True, preexec_fn=real_time)
        said = [peer.communicate(timeout=60) for peer in peers]
    assert done.returncode == 0, done.stderr
    assert [peer.returncode for peer in peers] == [0, 0, 0], said
    *seen, ours = (json.loads(out) for out, _ in said)
    counted, excused = json.loads(stats.read_text()), int((stolen() - before) / 0.004032)
    for arm in counted.values():
        counts, waiting = arm["counts"], int(max(arm["queue_depth"], key=int))
        taken = sum(count for depth, count in arm["queue_depth"].items() if int(depth) > 0)
        if counts.get("skipped", 0) > 0.2 * MINUTE / 0.004032:
            pytest.skip(f"this machine was too busy: {counts['skipped']} cycles skipped")
        assert counts.get("overruns", 0) <= excused, arm
        assert counts["packets"] + counts.get("skipped", 0) >= MINUTE / 0.004032 - 10
        assert counts["replies"] - sum(arm["drops"].values()) - taken <= waiting, "every received message was read"
        assert not set(arm["drops"]) - {"not guiding", "queue full"}, "full: by a client that stalled"
        assert counts["sessions"] == 1
    for found, arm in zip(seen, counted.values(), strict=False):
        unheard = arm["counts"].get("refused", 0)  # before the client was there
        assert found["packets"] >= arm["counts"]["packets"] - unheard - 2, "all our packets arrive"
        assert found["last"][0] - found["first"][0] == pytest.approx(20.0, abs=0.1)
        assert found["error"] < 1.0
    assert ours["own"] <= excused, ours
    assert ours["replies"] + ours["overtaken"] >= ours["packets"] - 2
