"""Identification of one model from 1000 YuMi logs of 20 s with 1, 2 and (on four cores) 4 workers.

There is no peer, because FIGAROH stores the regressor of all samples at once and supports neither workers nor multiple
logs. The benchmark "Identification" compares armlab with FIGAROH on one record.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import identified
import numpy as np
from blocks import Contender, Disagreement, Table, figures
from fleet_identify import ROBOT

from armlab import log, robots

SECONDS, DISTINCT = 20.0, 20
LOGS, QUICK = (1000,), (10,)
WORKERS = (1, 2, 4)
BARS = {2: 1 / 1.6, 4: 1 / 3.0}  # relative to one worker, with the largest number of logs, if there are enough cores
PROGRAM = Path(__file__).with_name("fleet_identify.py")


def run(quick: bool) -> list[Table]:
    """Measure `fleet.identify` without a cache of sums; results must be bit-identical."""
    counts, rounds = (QUICK, 1) if quick else (LOGS, 1)
    robot, cores = robots.load(ROBOT), len(os.sched_getaffinity(0))
    sharing = [count for count in WORKERS if count <= max(cores, 2)]
    contenders, samples = [], []
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder, "made")
        first.mkdir()
        made = [identified.log(robot, SECONDS, k) for k in range(DISTINCT)]
        for k, table in enumerate(made):
            log.write(table, first / f"{k}.mcap", robot)
        cost = _told(first, 0)
        for count in counts:
            logs = Path(folder, str(count))
            logs.mkdir()
            for k in range(count):
                table = made[k % DISTINCT].rows(slice(k // DISTINCT, None))  # copies would be skipped as duplicates
                log.write(table, logs / f"log{k:04d}.mcap", robot)
            alone = None
            for workers in sharing:
                found = _told(logs, workers)
                alone = alone or found
                if found["digest"] != alone["digest"] or found["used"] != count:
                    raise Disagreement(
                        f"{count} logs: expected results from {workers} workers that are bit-identical "
                        "to those of one worker, got different results."
                    )
                whole, serial = (one["draft"] + one["map"] + one["solution"] for one in (found, alone))
                bar = BARS.get(workers) if count == counts[-1] and workers <= cores else None
                note = (
                    f"draft {found['draft']:.1f}, sums {found['map']:.1f}, solution {found['solution']:.1f} s; sums at "
                    f"{found['rows'] / found['map']:.0f} rows/s; {serial / whole:.2f} times one worker, the sums alone "
                    f"{alone['map'] / found['map']:.2f}; memory: caller {1e-6 * found['caller']:.0f} MB, worker "
                    f"{1e-6 * found['worker']:.0f} MB"
                )
                name, over = f"{count} logs, {workers} worker{'s' * (workers > 1)}", f"{count} logs, 1 worker"
                contenders.append(Contender(name, lambda: np.zeros(0), "armlab", bar, note, over if bar else ""))
                samples.append([np.array([whole])])
    text = (
        f"Wall-clock time of `fleet.identify` with workers already running. {DISTINCT} logs of {SECONDS:g} s at 250 "
        f"Hz are "
        "repeated as often as needed; each copy omits more leading rows, so it is not a duplicate. Files are read from "
        f"memory, without a cache, on {cores} cores. One log: {1e3 * cost['read']:.1f} ms of core time to read, "
        f"{1e3 * cost['sums']:.1f} ms for its sums; {1e-3 * cost['there']:.0f} kB are sent to the worker and "
        f"{1e-3 * cost['back']:.0f} kB returned. All results were bit-identical. Targets: 1.6 times as fast with two "
        "workers, and three times as fast with four workers on four cores."
    )
    return [Table("Fleet: one model from many logs", text, "s", figures(contenders, samples), rounds)]


def _told(folder: Path, workers: int) -> dict[str, float]:
    """Return the results that `fleet_identify.py` prints for a folder."""
    words = [sys.executable, str(PROGRAM), str(folder), str(workers)]
    said = subprocess.run(words, stdout=subprocess.PIPE, check=True, text=True)
    return json.loads(said.stdout)
