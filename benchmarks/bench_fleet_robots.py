"""Many robots over Zenoh: rows from publishers through a router to the files of `fleet.FleetRecorder`."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from blocks import Contender, Table, figures

from armlab.bridge.servers.zenoh.messages import EVERY
from armlab.bridge.servers.zenoh.session import LabAddress
from armlab.errors import ArmlabError
from armlab.fleet import FleetRecorder

RATE = 250
SETTLE = 1.0  # s excluded after the first rows
TOGETHER = 10  # robots per publishing process
BAR = 4.0  # p99 with ten robots over p99 with one
WHOLE = 0.999  # share of recorded rows below which no larger number of robots is tried
MOST = 160  # robots
PATIENCE = 30.0  # s
PUBLISHER = Path(__file__).with_name("fleet_publisher.py")


def run(quick: bool) -> list[Table]:
    """Measure 1, 5, 10, 20, ... robots until the machine is overloaded."""
    seconds, rounds = (2.0, 1) if quick else (2.0, 2)
    contenders, samples, count, more = [], [], 1, ""
    while count <= MOST:
        try:
            found = [_measured(count, seconds) for _ in range(rounds)]
        except (TooManyError, subprocess.TimeoutExpired):
            if count <= TOGETHER:
                raise
            more = f" {count} robots were too many: not all programs sent rows and exited in time."
            break
        share = min(one["share"] for one in found)
        told = {name: float(np.median([one[name] for one in found])) for name in ("p50", "router", "recorder", "rate")}
        note = (
            f"at least {100.0 * share:.3f} % of the rows recorded; {told['rate']:.0f} rows/s each; p50 "
            f"{1e3 * told['p50']:.2f} ms; router {100.0 * told['router']:.1f} %, recorder "
            f"{100.0 * told['recorder']:.1f} % of a core"
        )
        bar = BAR if count == 10 else None
        over = "1 robots" if bar else ""
        contenders.append(Contender(f"{count} robots", lambda: np.zeros(0), "armlab", bar, note, over))
        samples.append([np.array([one["p99"]]) for one in found])
        if count == 10 and share < 1.0:
            raise ArmlabError(f"Expected every row of ten robots in the files, got a share of {share:.6f}.")
        if share < WHOLE:
            break
        count = {1: 5, 5: 10}.get(count, 2 * count)
    text = (
        f"99th percentile of the time from a row's stamp to the callback of `FleetRecorder`, for {RATE} rows of 400 "
        "bytes per second and robot, with congestion control BLOCK, through a router in a separate process. Ten robots "
        f"share a process. Rows are counted from {SETTLE:g} s after the first row. All processes share the "
        f"machine's cores.{more}"
    )
    return [Table("Fleet: rows of many robots", text, "ms", figures(contenders, samples), rounds)]


class TooManyError(ArmlabError):
    """The machine cannot handle this number of robots."""


class _Timed(FleetRecorder):
    """Recorder that stores the transit time of each row."""

    def __init__(self, *words: Any) -> None:
        self.seconds: list[float] = []
        super().__init__(*words)

    def _take(self, sample: Any) -> None:
        now = time.monotonic_ns()
        self.seconds.append(1e-9 * (now - struct.unpack_from("<q", sample.payload.to_bytes(), 24)[0]))
        super()._take(sample)


def _measured(count: int, seconds: float) -> dict[str, float]:
    """Return percentiles [s], shares of a core, rows/s per robot, and the share of recorded rows."""
    with ExitStack() as opened:
        port = _free_port()
        router = _started(opened, "-m", "armlab", "fleet", "router", "--port", str(port))
        folder = opened.enter_context(tempfile.TemporaryDirectory())
        recorder = _Timed(LabAddress(port=port, lab=EVERY), folder)
        opened.callback(recorder.close)
        publishers = [
            _started(opened, str(PUBLISHER), str(port), str(first), str(min(TOGETHER, count - first)))
            for first in range(0, count, TOGETHER)
        ]
        _until(lambda: len(recorder.robots) == count and all(one.rows for one in recorder.robots.values()))
        time.sleep(SETTLE)
        before = {name: (one.rows, one.lost) for name, one in recorder.robots.items()}
        at, busy, own, began = len(recorder.seconds), _cpu(router.pid), time.process_time(), time.monotonic()
        time.sleep(seconds)
        passed = time.monotonic() - began
        found = np.array(recorder.seconds[at:])
        busy, own = _cpu(router.pid) - busy, time.process_time() - own
        published = {}
        for k, publisher in enumerate(publishers):
            said, _ = publisher.communicate("", timeout=PATIENCE)
            published |= {f"lab1/arm{k * TOGETHER + i}": int(said.split()[-1]) for i in range(TOGETHER)}
        time.sleep(0.5)
        recorder.close()
        rows = sum(one.rows - before[name][0] for name, one in recorder.robots.items())
        lost = sum(one.lost - before[name][1] for name, one in recorder.robots.items())
        tails = sum(max(published[name] - 1 - one.last, 0) for name, one in recorder.robots.items())
        p50, p99 = np.percentile(found, (50.0, 99.0))
        return {
            "p50": float(p50), "p99": float(p99), "router": busy / passed, "recorder": own / passed,
            "rate": len(found) / passed / count, "share": rows / (rows + lost + tails),
        }  # fmt: skip


def _started(opened: ExitStack, *words: str) -> subprocess.Popen[str]:
    process = opened.enter_context(
        subprocess.Popen([sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    )
    opened.callback(process.kill)
    return process


def _until(condition: Any) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            raise TooManyError(f"Expected rows of every robot within {PATIENCE:g} s, but some did not arrive.")
        time.sleep(0.01)


def _cpu(pid: int) -> float:
    """Return processor time of a process [s]."""
    words = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
