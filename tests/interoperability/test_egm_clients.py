"""EGM clients of other people, each in an environment and a process of its own, driven by `armlab sim`.

They are installed from PyPI; where that is not possible the tests are skipped with the reason. About 50 s in all,
mostly for installing.
"""

from __future__ import annotations

import json
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
GAIN = 5.0  # 1/s of the controller: without speeds a reference runs ahead by v / gain
FLAVOURS = [("6", "6.07", ()), ("7", "6.10", ("--extension",)), ("7", "7", ("--force", "--rapid-data", "2"))]
RUNS = [(client, *flavour) for client in CLIENTS for flavour in FLAVOURS]

pytestmark = pytest.mark.slow


def install(folder: Path, client: str) -> Path | str:
    """Return the interpreter of an environment with a client, or why there is none."""
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
    """Return what a client and the simulator have seen of each other, or why it did not run."""
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
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[Any, Any]:
    """All clients and flavours: environments beside each other, then three runs at a time: two cores carry no more."""
    folder = tmp_path_factory.mktemp("clients")
    with ThreadPoolExecutor(3) as pool:
        pythons = dict(zip(CLIENTS, pool.map(lambda client: install(folder, client), CLIENTS), strict=True))
        return dict(zip(RUNS, pool.map(lambda run: drive(folder, pythons[run[0]], run), RUNS), strict=True))


@pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run[0]}, {run[1]} axes, RobotWare {run[2]}")
def test_a_client_moves_the_simulated_robot(results: dict[Any, Any], run: Any) -> None:
    """Joint 1 and axis 7 follow a cosine, lag as they must and arrive; the arm converges and a new session begins."""
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
        assert seen["rapid"][0] == 1.5, "RAPID sends back what it hears"
        assert seen["packets"] - 8 < seen["rapid"][1] < seen["packets"]
    assert seen["restarts"] >= 1
    counts = counted["counts"]
    assert counts["sessions"] >= 2
    assert seen["packets"] > 0.95 * counts["packets"]
    assert counts["replies"] > 0.95 * counts["packets"]
    assert not {"unparsable", "wrong type", "joint count", "no joints"} & set(counted["drops"])
