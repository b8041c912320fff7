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
from typing import Any

import numpy as np
from blocks import Contender, Figure, Table, alternate, figures
from identified import model
from machine import stolen

from armlab import models, robots
from armlab.wire.egm import EgmCodec, Reference

ROBOT, BOTH = "yumi_right", ("yumi_left", "yumi_right")
PRIORITY = 50  # real-time priority of the simulator and its clients
CLIENT, PEER = (Path(__file__).parent / name for name in ("egm_client.py", "egm_peer.cpp"))
PEERS = ("ABBRobotEGM", "abb_robot_client")
LIBEGM, ECHO = "abb_libegm", "echo in C++"
BARS = {"ahead": 0.65, "spin": 0.35, "estimator": 1.0}  # relative to each PyPI package, p50 and p99
OF_LIBEGM = {"ahead": 1.0, "spin": 0.8, "estimator": 1.2, "both": 1.3}
FIRST = 1.0  # first reply of a session, relative to any other client's
STATISTICS = {"p50": "", "p99": ", 99th percentile", "first": ", first packet of a session"}  # suffixes of the titles
REPORTED = {
    "ahead": "armlab bridge, empty controller",
    "spin": 'armlab bridge, empty controller, wait="spin"',
    "estimator": "armlab bridge with contact.Estimator in the loop",
}


def round_trips(quick: bool) -> list[Table]:
    """Measure at 250 Hz in alternating blocks, then two arms in one loop, and then the late replies at 1 kHz."""
    seconds, rounds = (3.0, 2) if quick else (3.0, 9)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.toml"
        robot = robots.load(ROBOT)
        models.save(model(robot, seconds=15), file)
        compiled = _compiled(Path(folder))

        def measured(clients: list[str], seconds: float, period: float) -> dict[str, list[list[dict]]]:
            """Return the statistics of each arm by client and round."""
            kept: dict[str, list[list[dict]]] = {client: [] for client in clients}

            def block(client: str) -> Callable[[], np.ndarray]:
                def measure() -> np.ndarray:
                    kept[client].append(run(client, file, seconds, period, compiled.get(client)))
                    return np.zeros(0)

                return measure

            alternate([Contender(client, block(client)) for client in clients], rounds, warm=False)
            return kept

        single = measured([*REPORTED, *PEERS, *compiled], seconds, 0.004)
        both = measured(["both", "ahead", *(client for client in compiled if client == LIBEGM)], seconds, 0.004)
        long = 5.0 if quick else 10.0
        fast = measured(["ahead", "spin", *(client for client in compiled if client == ECHO)], long, 0.001)
    text = (
        f"`armlab sim {ROBOT} --robotware 7 --extension` at 250 Hz and one client, each in its own process and (with "
        f"two cores) on its own core, both with real-time priority if permitted. Times are measured from just before "
        "a packet is sent to the kernel's stamp of its reply: median or 99th percentile of a block of "
        f"{seconds:g} s without the first second, or the first reply of the block; {rounds} alternating blocks per "
        "client. Armlab's bridge records a log. The echo has no target, because it neither decodes nor checks. "
        + (
            f"{LIBEGM} sends back the received joints through its controller interface. "
            if LIBEGM in compiled
            else f"{LIBEGM} was not measured, because its sources were not given. "
        )
        + "Lower targets apply relative to the PyPI packages."
    )
    tables = [_single(way, statistic, text, single, rounds) for statistic in STATISTICS for way in REPORTED]
    tables += [_two_arms(statistic, both, seconds, rounds) for statistic in ("p50", "p99")]
    slow = (
        f"Packets at 1 kHz whose reply had not arrived when the next packet left, in {rounds} alternating runs of "
        f"{long:g} s per client; *longest* is the longest round trip. "
        "Stolen time is the processor time that the virtual machine did not get during the run, summed over the cores."
    )
    late = tuple(_late(client, runs) for client, runs in fast.items())
    return [*tables, Table("EGM at 1 kHz: late replies", slow, "%", late, rounds)]


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


def run(client: str, file: Path, seconds: float, period: float, program: list[str] | None = None) -> list[dict]:
    """Return the simulator's statistics per arm with one client, and the time stolen from the machine [s].

    `program` is the command of a compiled client.
    """
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
        before = stolen()
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
    return [{**one, "stolen": stolen() - before} for one in json.loads(stats.read_text()).values()]


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


def _late(client: str, runs: list[list[dict]]) -> Figure:
    """Return the percentage of packets without a reply within one period, over all runs."""
    arms = [arm for one in runs for arm in one]
    missed, packets = (sum(arm["counts"].get(name, 0) for arm in arms) for name in ("missed", "packets"))
    by_run = ", ".join(str(arm["counts"].get("missed", 0)) for arm in arms)
    longest, stolen = max(arm["round_trip_us"]["max"] for arm in arms), 1e3 * sum(arm["stolen"] for arm in arms)
    note = f"{by_run} of {packets // len(arms)} late; longest {1e-3 * longest:.3g} ms; {stolen:.0f} ms stolen"
    kind = ("armlab", 0.0) if client in REPORTED else ("limit", None)
    contender = Contender(REPORTED.get(client, client), lambda: np.zeros(0), *kind, note=note)
    return figures([contender], [[np.array([missed / packets])]])[0]


def _single(way: str, statistic: str, text: str, runs: dict[str, list[list[dict]]], rounds: int) -> Table:
    """Return the table of one statistic for one bridge mode and the peers."""
    bars = {ECHO: None, LIBEGM: OF_LIBEGM[way], **dict.fromkeys(PEERS, BARS[way])}
    if statistic == "first":
        bars |= dict.fromkeys((LIBEGM, *PEERS), FIRST)
    rows = [_row(REPORTED[way], way, 0, "armlab")]
    rows += [_row(peer, peer, 0, "limit" if peer == ECHO else "peer", bars[peer]) for peer in runs if peer in bars]
    title = f"EGM round trip, {REPORTED[way].removeprefix('armlab ')}{STATISTICS[statistic]}"
    return _table(title, text, statistic, rows, runs, rounds)


def _two_arms(statistic: str, runs: dict[str, list[list[dict]]], seconds: float, rounds: int) -> Table:
    """Return the table of one statistic for a robot's two arms, which send simultaneously, and for one arm."""
    alone, bar = "one arm", OF_LIBEGM["both"]
    over = f"{LIBEGM}, {alone}" if LIBEGM in runs else alone
    rows = [_row(f"{arm}, one of two arms", "both", k, "armlab", bar, over) for k, arm in enumerate(BOTH)]
    rows.append(_row(alone, "ahead", 0, "limit"))
    rows += [_row(over, LIBEGM, 0, "peer")] if LIBEGM in runs else []
    text = (
        f"`armlab sim {' '.join(BOTH)}` and one bridge with an empty controller, which is called for the packets of "
        f"the first arm. Both packets are sent simultaneously. Blocks of {seconds:g} s, {rounds} alternating blocks "
        "each."
    )
    return _table(f"EGM round trip, two arms{STATISTICS[statistic]}", text, statistic, rows, runs, rounds)


def _row(
    name: str, client: str, arm: int, role: Any, bar: float | None = None, over: str = ""
) -> tuple[Contender, str, int]:
    return Contender(name, lambda: np.zeros(0), role, bar, over=over), client, arm


def _table(
    title: str,
    text: str,
    statistic: str,
    rows: list[tuple[Contender, str, int]],
    runs: dict[str, list[list[dict]]],
    rounds: int,
) -> Table:
    samples = [
        [np.array([1e-6 * one[arm]["round_trip_us"][statistic]]) for one in runs[client]] for _, client, arm in rows
    ]
    return Table(title, text, "µs", figures([contender for contender, _, _ in rows], samples), rounds)
