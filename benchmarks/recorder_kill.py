"""Trial of `bench_recorder`: a process with two recorders is killed. `python recorder_kill.py FOLDER` records.

The process counts the accepted rows in a memory-mapped file, which survives the kill.
"""

from __future__ import annotations

import mmap
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from recorder_rows import PERIOD, full_rows, signals

from armlab import robots
from armlab.log import Recorder, inspect, read

ARMS = ("yumi_left", "yumi_right")
SHORTEST, LONGEST = 1.0, 4.0  # s
COUNT = struct.Struct("<q")
ATTACHED = b"the model of the arm"


def killed(folder: Path, seed: int) -> list[int]:
    """Return how many rows each recorder lost; raise if anything else was lost."""
    folder.mkdir()
    (folder / "count").write_bytes(bytes(COUNT.size * len(ARMS)))
    command = [sys.executable, __file__, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        if child.stdout is None or child.stdout.readline() != "recording\n":
            raise RuntimeError("Expected the process to record, but it ended.")
        time.sleep(np.random.default_rng(seed).uniform(SHORTEST, LONGEST))
        child.kill()
    counts = [count for (count,) in COUNT.iter_unpack((folder / "count").read_bytes())]
    return [_lost(folder / f"{arm}.mcap", count) for arm, count in zip(ARMS, counts, strict=True)]


def _lost(path: Path, count: int) -> int:
    table = read(path, raw=True)  # rows repeat after a while, including their stamps
    held = inspect(path)
    told = [event.text for event in held.events]
    whole = held.metadata["armlab"]["note"] == "kill" and held.attachments["model.toml"] == ATTACHED
    if held.finished or not whole or "connected" not in told or count < SHORTEST / PERIOD / 4:
        raise RuntimeError(f"Expected metadata, attachments and events in {path}, got {held.metadata}, {told}.")
    if not np.array_equal(table["tick"], np.arange(len(table))):
        raise RuntimeError(f"Expected the first rows of {path} without gaps, got other rows.")
    return max(count - len(table), 0)


def record(folder: Path) -> None:
    """Record until killed."""
    rows = full_rows(500)
    with (folder / "count").open("r+b") as file:
        taken = mmap.mmap(file.fileno(), 0)
    options = {"extra": signals(), "attachments": {"model.toml": ATTACHED}, "note": "kill"}
    recorders = [Recorder(folder / f"{arm}.mcap", robots.load(arm), **options) for arm in ARMS]
    for recorder in recorders:
        recorder.event("connected", time.time_ns())
    print("recording", flush=True)
    wall, due, k = time.time_ns(), time.perf_counter(), 0
    while True:
        due += PERIOD
        time.sleep(max(0.0, due - time.perf_counter()))
        state, command, tick = rows[k % len(rows)]
        tick = tick._replace(number=k, stamp_ns=wall + round(k * PERIOD * 1e9))
        for place, recorder in enumerate(recorders):
            if recorder.row(state, command, tick):
                COUNT.pack_into(taken, place * COUNT.size, k + 1)
        k += 1


if __name__ == "__main__":
    record(Path(sys.argv[1]))
