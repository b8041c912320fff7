"""Round trips of EGM clients against `armlab sim`, all in one run: the bridge, and the clients on PyPI."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from blocks import Contender, Table, alternate, figures
from identified import model

from armlab import models, robots

ROBOT, BOTH = "yumi_right", ("yumi_left", "yumi_right")
PRIORITY = 50  # of the simulator, as the clients have
CLIENT = Path(__file__).parent / "egm_client.py"
PEERS = ("ABBRobotEGM", "abb_robot_client")
BARS = {"ahead": 0.65, "spin": 0.35, "estimator": 1.0}  # of each peer's round trip, so of the faster one's
TOLD = {
    "ahead": "armlab bridge, empty controller",
    "spin": 'armlab bridge, empty controller, wait="spin"',
    "estimator": "armlab bridge with contact.Estimator in the loop",
}


def round_trips(quick: bool) -> list[Table]:
    """Measure at 250 Hz in alternating blocks, two arms in one loop, and lateness at 1 kHz once."""
    seconds, rounds = (3.0, 2) if quick else (3.0, 3)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.toml"
        robot = robots.load(ROBOT)
        models.save(model(robot, seconds=15), file)
        clients = [*TOLD, *PEERS]

        def block(client: str) -> Callable[[], np.ndarray]:
            return lambda: np.array([1e-6 * run(client, file, seconds, 0.004)[0]["round_trip_us"]["p50"]])

        contenders = [Contender(client, block(client)) for client in clients]
        samples = alternate(contenders, rounds, warm=False)
        both = _two_arms(file, seconds, rounds)
        long = 5.0 if quick else 15.0
        late = {client: _late(run(client, file, long, 0.001)[0]) for client in ("ahead", "spin")}
    text = (
        f"`armlab sim {ROBOT} --robotware 7 --extension` at 250 Hz and one client, each in a process and, where there "
        f"are two, on a core of its own, both with real-time priority where permitted. From just before a packet is "
        f"sent to the kernel's stamp of its reply: median of a block of {seconds:g} s, {rounds} blocks of each client "
        f"in turns. At 1 kHz over {long:g} s replies later than a period: {late['ahead']:.2f} %, "
        f"with spin {late['spin']:.2f} %."
    )
    return [*(_table(way, text, clients, contenders, samples, rounds) for way in TOLD), both]


def _two_arms(file: Path, seconds: float, rounds: int) -> Table:
    """Return the round trips of both arms of a robot, which send at the same time, beside those of one alone."""

    def block(client: str) -> Callable[[], np.ndarray]:
        return lambda: np.array([1e-6 * one["round_trip_us"]["p50"] for one in run(client, file, seconds, 0.004)])

    rounds = min(rounds, 2)
    contenders = [
        Contender("each of two arms in one loop", block("both"), "armlab"),
        Contender("one arm", block("ahead"), "limit"),
    ]
    text = (
        f"`armlab sim {' '.join(BOTH)}` and one bridge with an empty controller, which is called on the packets of the "
        f"first arm. Both packets leave at the same time. Mean of the arms' medians over blocks of {seconds:g} s, "
        f"{rounds} blocks each in turns."
    )
    samples = alternate(contenders, rounds, warm=False)
    return Table("EGM round trip, two arms", text, "µs", figures(contenders, samples, np.mean), rounds)


def run(client: str, file: Path, seconds: float, period: float) -> list[dict]:
    """Return what the simulator counted of each arm with one client."""
    arms = BOTH if client == "both" else (ROBOT,)
    ports = [_free_port() for _ in arms]
    stats = file.parent / "stats.json"
    model_file = [str(file)] if client == "estimator" else []
    command = [sys.executable, str(CLIENT), client, ",".join(map(str, ports)), *model_file]
    with _on_core(-1):
        started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with started as peer:
        if peer.stdout is None or peer.stdout.readline() != "ready\n":
            raise RuntimeError(f"Expected {client} to listen on port {ports}, got {peer.communicate()[1]}.")
        with _on_core(0, PRIORITY):
            subprocess.run(
                [
                    *(sys.executable, "-m", "armlab", "sim", *arms, "--robotware", "7", "--extension", "--force"),
                    *("--to", ",".join(f"127.0.0.1:{port}" for port in ports), "--seconds", str(seconds)),
                    *("--period", str(period), "--stats", str(stats), *(["--lagging"] if period < 0.002 else [])),
                ],
                check=True,
                capture_output=True,
            )
        peer.kill()  # it waits for more
    return list(json.loads(stats.read_text()).values())


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def _on_core(number: int, priority: int = 0) -> Iterator[None]:
    """Start processes on one of the cores, where there are several, and with a priority, where that is permitted."""
    cores, rest = sorted(os.sched_getaffinity(0)), (os.sched_getscheduler(0), os.sched_getparam(0))
    if len(cores) > 1:
        os.sched_setaffinity(0, {cores[number]})
    with suppress(PermissionError):
        if priority:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    try:
        yield
    finally:
        os.sched_setscheduler(0, *rest)
        os.sched_setaffinity(0, cores)


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
