"""Reading ten minutes at 250 Hz: one signal and all signals, compared with the bare readers of mcap and rosbags."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from blocks import Block, Contender, Table, once, table
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from armlab import log, robots
from armlab.lie import se3
from armlab.log import Column
from armlab.log.file_formats.opening import opened
from armlab.log.mcap.records import contents, unpacked
from armlab.robots import Robot

ROWS, RATE = 150_000, 250.0
ONE, ALL = 1.3, 3.0  # relative to the limit: one signal; all signals
LIMIT = "only SHA-256, zstd and CRC-32"
TEXT = """\
{size:.0f} MB of noise, wall-clock time. armlab checks every chunk, hashes the file and builds a numeric table in two
threads. mcap and rosbags return the messages of the topic of q as bytes. The limit is the work required by every read:
SHA-256 of the file, in parallel with zstd and CRC-32 of its chunks, without copying numbers.
"""


def run(quick: bool) -> list[Table]:
    """Measure `log.read` of recordings."""
    robot = robots.load("yumi_right")
    with tempfile.TemporaryDirectory() as folder:
        tables = []
        for name, values in (("30 signals", _signals(robot)), ("full layout", _layout(robot))):
            written = log.Table(np.arange(ROWS) / RATE, values, {"grip": Column(unit="N")}, t0_ns=1_700_000_000 * 10**9)
            path = log.write(written, Path(folder) / f"{name.split()[0]}.mcap", robot)
            tables.append(_table(name, path, robot, 2 if quick else 3))
        return tables


def _signals(robot: Robot) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    values = {name: rng.normal(size=(ROWS, robot.n)) for name in ("q", "qd", "tau")}
    return values | {"wrench_hat": rng.normal(size=(ROWS, 6)), "grip": rng.normal(size=(ROWS, 3))}


def _layout(robot: Robot) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    names = ("q_ref", "qd_ref", "tau_ref", "q_sent", "qd_sent", "tau_sent", "q_planned")
    values = _signals(robot) | {name: rng.normal(size=(ROWS, robot.n)) for name in names}
    values |= {"wrench_raw": rng.normal(size=(ROWS, 6)), "T_frame_tool": se3.exp(rng.normal(size=(ROWS, 6)))}
    return values | {"wrench_hat_cov": rng.normal(size=(ROWS, 6, 6))}


def _table(name: str, path: Path, robot: Robot, rounds: int) -> Table:
    topic = f"/{robot.name}/joint_states"
    contenders = [
        Contender("armlab log.read, only q", _wall(lambda: log.read(path, ["q"])), "armlab", ONE, over=LIMIT),
        Contender("armlab log.read, all", _wall(lambda: log.read(path)), "armlab", ALL, over=LIMIT),
        Contender(LIMIT, _wall(lambda: _limit(path)), "limit"),
        Contender("mcap, messages of one topic", _wall(lambda: _by_mcap(path, topic))),
        Contender("rosbags, messages of one topic", _wall(lambda: _by_rosbags(path, topic))),
    ]
    text = TEXT.format(size=path.stat().st_size / 1e6)
    return table(f"Recording, {name}, in", text, "s", contenders, rounds, warm=False)


def _wall(function: Callable[[], Any]) -> Block:
    return once(function, clock=perf_counter)


def _limit(path: Path) -> str:
    with opened(path) as view, ThreadPoolExecutor(3) as pool:
        digest = pool.submit(lambda: sha256(view).hexdigest())
        chunks = contents(view).chunks
        halves = [chunks[0::2], chunks[1::2]]
        assert sum(pool.map(lambda half: sum(len(unpacked(view, chunk)) for chunk in half), halves))
        return digest.result()


def _by_mcap(path: Path, topic: str) -> Any:
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages(topics=[topic]))


def _by_rosbags(path: Path, topic: str) -> Any:
    with Reader(path) as bag:
        return sum(1 for _ in bag.messages([one for one in bag.connections if one.topic == topic]))
