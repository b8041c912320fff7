"""Round trips of EGM clients with `armlab sim` in one run: the bridge, abb_libegm, PyPI packages, and an echo.

abb_libegm is included if the variable LIBEGM contains its source folder, and protoc, protobuf and Boost are installed.
A C++ program that echoes each datagram shows the limit of the machine.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from blocks import Contender, Figure, Table, alternate, figures
from identified import model

from armlab import models, robots
from armlab.wire.egm import EgmCodec, Reference

ROBOT, BOTH = "yumi_right", ("yumi_left", "yumi_right")
PRIORITY = 50  # real-time priority of the simulator and its clients
CLIENT, PEER = (Path(__file__).parent / name for name in ("egm_client.py", "egm_peer.cpp"))
PEERS = ("ABBRobotEGM", "abb_robot_client")
LIBEGM, ECHO = "abb_libegm", "echo in C++"
BARS = {"ahead": 0.65, "spin": 0.35, "estimator": 1.0}  # relative to each PyPI package, p50 and p99
OF_LIBEGM = {"ahead": 1.0, "spin": 0.8, "estimator": 1.2, "both": 1.3}
REPORTED = {
    "ahead": "armlab bridge, empty controller",
    "spin": 'armlab bridge, empty controller, wait="spin"',
    "estimator": "armlab bridge with contact.Estimator in the loop",
}


def round_trips(quick: bool) -> list[Table]:
    """Measure at 250 Hz in alternating blocks, then two arms in one loop, and once the late replies at 1 kHz."""
    seconds, rounds = (3.0, 2) if quick else (3.0, 5)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.toml"
        robot = robots.load(ROBOT)
        models.save(model(robot, seconds=15), file)
        compiled = _compiled(Path(folder))
        clients = [*REPORTED, *PEERS, *compiled]

        def block(client: str) -> Callable[[], np.ndarray]:
            program = compiled.get(client)

            def percentiles() -> np.ndarray:
                measured = run(client, file, seconds, 0.004, program)[0]["round_trip_us"]
                return 1e-6 * np.array([measured["p50"], measured["p99"]])

            return percentiles

        contenders = [Contender(client, block(client)) for client in clients]
        samples = alternate(contenders, rounds, warm=False)
        both = _two_arms(file, seconds, rounds, compiled)
        long = 5.0 if quick else 60.0
        fast = ["ahead", "spin", *(client for client in compiled if client == ECHO)]
        late = [_late(client, run(client, file, long, 0.001, compiled.get(client))[0]) for client in fast]
    text = (
        f"`armlab sim {ROBOT} --robotware 7 --extension` at 250 Hz and one client, each in its own process and (with "
        f"two cores) on its own core, both with real-time priority if permitted. Times are measured from just before "
        "a packet is sent to the kernel's stamp of its reply: median or 99th percentile of a block of "
        f"{seconds:g} s, {rounds} alternating blocks per client, without the first second. "
        "Armlab's bridge records a log. "
        + ("" if LIBEGM in compiled else f"{LIBEGM} was not measured, because its sources were not given. ")
        + "Lower targets apply relative to the PyPI packages."
    )
    slow = f"Replies of a run of {long:g} s at 1 kHz that took longer than a period."
    chosen = [(way, number) for number in (0, 1) for way in REPORTED]
    tables = (_table(way, number, text, clients, contenders, samples, rounds) for way, number in chosen)
    return [*tables, both, Table("EGM at 1 kHz: late replies", slow, "%", tuple(late), 1)]


def _compiled(folder: Path) -> dict[str, list[str]]:
    """Build the C++ clients; return their commands without the port, or nothing if there is no compiler."""
    compiler, robot, found = shutil.which("c++"), robots.load(ROBOT), {}
    if compiler is None:
        return found
    reply = EgmCodec(robot).encode(Reference(robot.q_home, None, None, 0, 0)).hex()
    words = [compiler, "-O2", "-std=c++17", str(PEER)]
    subprocess.run([*words, "-o", str(folder / "echo")], check=True)
    found[ECHO] = [str(folder / "echo"), reply]
    if "LIBEGM" in os.environ:
        source = Path(os.environ["LIBEGM"])
        proto = [str(path) for path in sorted((source / "proto").glob("*.proto"))]
        subprocess.run(["protoc", f"-I{source / 'proto'}", f"--cpp_out={folder}", *proto], check=True)
        sources = [*sorted((source / "src").glob("*.cpp")), *sorted(folder.glob("*.pb.cc"))]
        include = [f"-I{source / 'include'}", f"-I{folder}", "-DLIBEGM"]
        libraries = ["-lprotobuf", "-lboost_system", "-lboost_thread", "-pthread"]
        subprocess.run([*words, *include, *map(str, sources), "-o", str(folder / "libegm"), *libraries], check=True)
        found[LIBEGM] = [str(folder / "libegm"), ""]
    return found


def _two_arms(file: Path, seconds: float, rounds: int, compiled: dict[str, list[str]]) -> Table:
    """Return the round trips of a robot's two arms, which send simultaneously, compared with those of one arm."""

    def block(client: str) -> Callable[[], np.ndarray]:
        program = compiled.get(client)
        return lambda: np.array(
            [1e-6 * one["round_trip_us"]["p50"] for one in run(client, file, seconds, 0.004, program)]
        )

    contenders = [
        Contender("each of two arms in one loop", block("both"), "armlab"),
        Contender("one arm", block("ahead"), "limit", bar=OF_LIBEGM["both"]),
    ]
    if LIBEGM in compiled:
        contenders.append(Contender(f"{LIBEGM}, one arm", block(LIBEGM), bar=OF_LIBEGM["both"]))
    text = (
        f"`armlab sim {' '.join(BOTH)}` and one bridge with an empty controller, which is called for the packets of "
        f"the first arm. Both packets are sent simultaneously. Mean of the arms' medians over blocks of {seconds:g} s, "
        f"{rounds} alternating blocks each."
    )
    samples = alternate(contenders, rounds, warm=False)
    return Table("EGM round trip, two arms", text, "µs", figures(contenders, samples, np.mean), rounds)


def run(client: str, file: Path, seconds: float, period: float, program: list[str] | None = None) -> list[dict]:
    """Return the simulator's statistics per arm with one client; `program`: command of a compiled client."""
    arms = BOTH if client == "both" else (ROBOT,)
    ports = [_free_port() for _ in arms]
    stats = file.parent / "stats.json"
    model_file = [str(file)] if client == "estimator" else []
    at = ",".join(map(str, ports))
    command = [sys.executable, str(CLIENT), client, at, *model_file]
    if program is not None:
        command = [program[0], at, *program[1:]]
    variables = {**os.environ, "TMPDIR": str(file.parent)}  # for the log
    with _on_core(-1):
        started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=variables)
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
        peer.kill()  # otherwise, it would wait for more packets
    return list(json.loads(stats.read_text()).values())


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def _on_core(number: int, priority: int = 0) -> Iterator[None]:
    """Start processes on one core (if there are several) and with a priority (if permitted)."""
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


def _late(client: str, counted: dict) -> Figure:
    """Return the percentage of packets without a reply within one period."""
    share = 100.0 * counted["counts"].get("missed", 0) / max(counted["counts"]["packets"], 1)
    kind = ("armlab", 0.0) if client in REPORTED else ("limit", None)
    contender = Contender(REPORTED.get(client, client), lambda: np.zeros(0), *kind)
    return figures([contender], [[np.array([share])]])[0]


def _table(
    way: str, number: int, text: str, clients: list[str], contenders: list[Contender], samples: list, rounds: int
) -> Table:
    """Return the table of the median (0) or 99th percentile (1) for one bridge mode, with the peers."""
    chosen = [way, *PEERS, *(client for client in clients if client in (LIBEGM, ECHO))]
    bars = {**dict.fromkeys(PEERS, BARS[way]), LIBEGM: OF_LIBEGM[way], ECHO: None}
    named = [Contender(REPORTED[way], contenders[0].block, "armlab")]
    named += [
        Contender(peer, contenders[0].block, "limit" if peer == ECHO else "peer", bars[peer]) for peer in chosen[1:]
    ]
    blocks = [samples[clients.index(client)] for client in chosen]
    title = f"EGM round trip, {REPORTED[way].removeprefix('armlab ')}{', 99th percentile' if number else ''}"
    return Table(title, text, "µs", figures(named, blocks, lambda block: block[number]), rounds)
