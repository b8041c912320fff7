"""Identification from the logs in a folder in a separate process; prints times, memory and bytes as JSON.

python benchmarks/fleet_identify.py FOLDER WORKERS
"""

from __future__ import annotations

import hashlib
import json
import pickle
import re
import sys
import warnings
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter, process_time, sleep
from typing import Any

import numpy as np

from armlab import fleet, robots
from armlab.fleet.mapping import workers
from armlab.identify.many import fit_draft, log_sums
from armlab.log import read_arm

ROBOT = "yumi_right"


def main(folder: Path, count: int) -> dict[str, Any]:
    """Return the times of draft, map and solution [s], rows, memory [B] of this process and the largest worker, and a
    digest.
    """
    robot, logs = robots.load(ROBOT), sorted(folder.iterdir())
    marks: dict[int, float] = {}

    def tell(done: int, total: int, what: str) -> None:
        if total == len(logs) and "logs" in what:
            marks.setdefault(done, perf_counter())

    with ExitStack() as opened:
        executor = opened.enter_context(workers(count))
        _started(executor, count)
        start, busy = perf_counter(), process_time()
        found = fleet.identify(logs, robot, executor, tell)
        end, busy = perf_counter(), process_time() - busy
        pids = list(getattr(executor, "_processes", {}))
        memory = {"caller": _peak("self"), "worker": max(map(_peak, pids), default=0)}
    fit = found.fit
    digest = hashlib.sha256(np.concatenate([fit.parameters, fit.cov.ravel(), fit.residuals.ravel()]).tobytes())
    seconds = {"draft": marks[0] - start, "map": marks[len(logs)] - marks[0], "solution": end - marks[len(logs)]}
    return {**seconds, **memory, "busy": busy, "rows": fit.n, "used": len(found.used), "digest": digest.hexdigest()}


def share(folder: Path) -> dict[str, float]:
    """Return the processor time [s] to read one log and to compute its sums, and the bytes sent to the worker and
    back."""
    robot, logs = robots.load(ROBOT), sorted(folder.iterdir())[:10]
    start = process_time()
    tables = [read_arm(log, robot) for log in logs]
    read = (process_time() - start) / len(logs)
    _, pattern = fit_draft(tables, robot, 1000)
    start = process_time()
    sums = [log_sums(table, pattern) for table in tables]
    made = (process_time() - start) / len(logs)
    return {"read": read, "sums": made, "there": len(pickle.dumps(pattern)), "back": len(pickle.dumps(sums[0]))}


def _started(executor: Executor | None, count: int) -> None:
    """Wait until all workers have started and loaded their modules."""
    if executor is not None:
        for held in [executor.submit(_loaded) for _ in range(4 * count)]:
            held.result()


def _loaded() -> None:
    import scipy.linalg
    import scipy.signal  # noqa: F401

    sleep(0.2)


def _peak(pid: int | str) -> int:
    """Return the peak resident memory of a process [B]."""
    told = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text(encoding="ascii"))
    return 1024 * int(told[1]) if told else 0


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    where, at_work = Path(sys.argv[1]), int(sys.argv[2])
    print(json.dumps(main(where, at_work) if at_work else share(where)))
