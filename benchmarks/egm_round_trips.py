"""Round trips of EGM clients against `armlab sim`, all in one run: the bridge, and the clients on PyPI."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from blocks import Contender, Table, alternate, figures
from identified import model

from armlab import models, robots

ROBOT = "yumi_right"
CLIENT = Path(__file__).parent / "egm_client.py"
PEERS = ("ABBRobotEGM", "abb_robot_client")
BARS = {"ahead": 0.65, "spin": 0.35, "estimator": 1.0}  # of each peer's round trip, so of the faster one's
TOLD = {
    "ahead": "armlab bridge, empty controller",
    "spin": 'armlab bridge, empty controller, wait="spin"',
    "estimator": "armlab bridge with contact.Estimator in the loop",
}


def round_trips(quick: bool) -> list[Table]:
    """Measure at 250 Hz in alternating blocks, and lateness at 1 kHz once."""
    seconds, rounds = (3.0, 2) if quick else (10.0, 5)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.toml"
        robot = robots.load(ROBOT)
        models.save(model(robot, seconds=15), file)
        clients = [*TOLD, *PEERS]

        def block(client: str) -> Callable[[], np.ndarray]:
            return lambda: np.array([1e-6 * run(client, file, seconds, 0.004)["round_trip_us"]["p50"]])

        contenders = [Contender(client, block(client)) for client in clients]
        samples = alternate(contenders, rounds)
        late = {client: _late(run(client, file, 2 * seconds, 0.001)) for client in ("ahead", "spin")}
    text = (
        f"`armlab sim {ROBOT} --robotware 7 --extension` at 250 Hz and one client, each in a process; from just before "
        "a packet is sent to the kernel's stamp of its reply, median of a block. Real-time priority where permitted. "
        f"At 1 kHz replies later than a period: {late['ahead']:.2f} %, with spin {late['spin']:.2f} %."
    )
    return [_table(way, text, clients, contenders, samples, rounds) for way in TOLD]


def run(client: str, file: Path, seconds: float, period: float) -> dict:
    """Return what the simulator counted with one client."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    stats = file.parent / "stats.json"
    model_file = [str(file)] if client == "estimator" else []
    command = [sys.executable, str(CLIENT), client, str(port), *model_file]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as peer:
        if peer.stdout is None or peer.stdout.readline() != "ready\n":
            raise RuntimeError(f"Expected {client} to listen on port {port}, got {peer.communicate()[1]}.")
        subprocess.run(
            [
                *(sys.executable, "-m", "armlab", "sim", ROBOT, "--robotware", "7", "--extension", "--force"),
                *("--to", f"127.0.0.1:{port}", "--seconds", str(seconds + 3.0), "--period", str(period)),
                *("--stats", str(stats), *(["--lagging"] if period < 0.002 else [])),
            ],
            check=True,
            capture_output=True,
        )
    [counted] = json.loads(stats.read_text()).values()
    return counted


def _late(counted: dict) -> float:
    """Return the share of packets in percent that no reply answered within a period."""
    counts = counted["counts"]
    return 100.0 * counts.get("missed", 0) / max(counts["packets"], 1)


def _table(way: str, text: str, clients: list[str], contenders: list[Contender], samples: list, rounds: int) -> Table:
    """Return one way of running the bridge beside the peers."""
    chosen = [way, *PEERS]
    named = [Contender(TOLD[way], contenders[0].block, "armlab")]
    named += [Contender(peer, contenders[0].block, "peer", BARS[way]) for peer in PEERS]
    blocks = [samples[clients.index(client)] for client in chosen]
    return Table(f"EGM round trip, {TOLD[way].removeprefix('armlab ')}", text, "µs", figures(named, blocks), rounds)
