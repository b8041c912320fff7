"""Dask workers as computers of a cluster: identification with a lost, slow or stopped worker, and jobs per second.

    python benchmarks/fleet_dask.py identify    60 logs on 4 workers, and the same logs in this process
    python benchmarks/fleet_dask.py jobs        jobs that only wait, on 4 to 1000 slots: limits of scheduler and caller

Scheduler and workers are separate processes, started as in docs/how_to/many_logs.md, but without a parent that restarts
lost workers: a lost computer does not return.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import identified
import numpy as np
from distributed import Client
from fleet_identify import ROBOT

from armlab import fleet, log, robots
from armlab.fleet.mapping import map_logs, workers

LOGS, DISTINCT, SECONDS = 60, 10, 20.0
MACHINES = 4
SLOWDOWN = 10  # slowdown factor of the slow worker
SILENCE = "10s"  # s after which the scheduler gives up on a silent worker; Dask's default is 5 minutes
SLOTS = (4, 16, 64, 250, 1000)
LASTS, THERE, BACK = 0.05, 100_000, 90_000  # s, bytes, bytes: job of one log in docs/growth.md


@contextmanager
def cluster(machines: int, slots: int = 1) -> Iterator[tuple[str, Sequence[subprocess.Popen[bytes]]]]:
    """Start a scheduler and workers on 127.0.0.1; yield the scheduler's address and the workers."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    with ExitStack() as opened:
        folder = opened.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": SILENCE, "OMP_NUM_THREADS": "1"}

        def start(*words: str) -> subprocess.Popen[bytes]:
            own = ["--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0"]
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *words, *own], env=environment, stderr=subprocess.DEVNULL
            )
            opened.callback(process.wait)
            opened.callback(process.kill)
            return process

        start("scheduler", "--port", address.rpartition(":")[2])
        local = ["--nthreads", str(slots), "--no-nanny", "--local-directory", folder]
        started = [start("worker", address, *local) for _ in range(machines)]
        with Client(address, timeout=60) as client:
            client.wait_for_workers(machines, timeout=60)
        yield address, started


def leave(_: subprocess.Popen[bytes]) -> None:
    """Leave all workers undisturbed."""


def lose(worker: subprocess.Popen[bytes]) -> None:
    """Kill a worker during its job."""
    worker.kill()


def slow(worker: subprocess.Popen[bytes]) -> None:
    """Let a worker, including its heartbeats, run only a tenth of the time."""

    def drag() -> None:
        while worker.poll() is None:
            worker.send_signal(signal.SIGSTOP)
            time.sleep(0.1 * (1.0 - 1.0 / SLOWDOWN))
            worker.send_signal(signal.SIGCONT)
            time.sleep(0.1 / SLOWDOWN)

    threading.Thread(target=drag, daemon=True).start()


def stop(worker: subprocess.Popen[bytes]) -> None:
    """Stop a worker permanently; its connection stays open, but it does not respond."""
    worker.send_signal(signal.SIGSTOP)


def identify() -> None:
    """Print the times of each case, and whether its result is bit-identical."""
    robot = robots.load(ROBOT)
    with tempfile.TemporaryDirectory() as folder:
        made = [identified.log(robot, SECONDS, k) for k in range(DISTINCT)]
        for k in range(LOGS):
            log.write(made[k % DISTINCT].rows(slice(k // DISTINCT, None)), Path(folder, f"log{k:04d}.mcap"), robot)
        alone = _identified(Path(folder), None, lambda: None)
        print(f"this process: sums in {alone[0]:.1f} s, all in {alone[1]:.1f} s", flush=True)
        for name, spoil in (("four", leave), ("one lost", lose), ("one slow", slow), ("one stopped", stop)):
            with cluster(MACHINES) as (address, processes):
                found = _identified(Path(folder), address, partial(spoil, processes[0]))
            used = f"{len(found[2].used)} logs used, {len(found[2].skipped)} skipped"
            same = _bits(found[2]) == _bits(alone[2])
            print(f"{name}: sums in {found[0]:.1f} s, all in {found[1]:.1f} s; {used}; same bits: {same}", flush=True)


def _bits(found: fleet.Identified) -> bytes:
    return b"".join(part.tobytes() for part in (found.fit.parameters, found.fit.cov, found.fit.residuals))


def _identified(folder: Path, dask: str | None, spoil: Callable[[], None]) -> tuple[float, float, fleet.Identified]:
    """Return the time of the sums, the total time, and the result; call `spoil` after a fifth of the logs."""
    marks: dict[int, float] = {}

    def look(done: int, total: int, what: str) -> None:
        if total == LOGS and "logs" in what:
            marks.setdefault(done, time.perf_counter())
            if done >= LOGS // 5 and -1 not in marks:
                marks[-1] = 0.0
                spoil()

    with workers(dask=dask) as executor:
        start = time.perf_counter()
        found = fleet.identify(folder, robots.load(ROBOT), executor, look)
        return marks[LOGS] - marks[0], time.perf_counter() - start, found


def jobs() -> None:
    """Print jobs per second for increasing numbers of slots, and the processor time of scheduler and caller."""
    for slots in SLOTS:
        with cluster(MACHINES, slots // MACHINES) as (address, _), workers(dask=address) as executor:
            count = min(40 * slots, 4000)
            sent = np.random.default_rng(0).bytes(THERE)
            map_logs(_job, dict.fromkeys(map(str, range(slots)), LASTS), sent, executor=executor)
            start, busy = time.perf_counter(), time.process_time()
            done = map_logs(_job, dict.fromkeys(map(str, range(count)), LASTS), sent, executor=executor)
            seconds, busy = time.perf_counter() - start, time.process_time() - busy
            assert len(done.results) == count
            ideal = slots / LASTS
            print(
                f"{slots} slots: {count / seconds:.0f} jobs/s of {ideal:.0f}; caller {1e3 * busy / count:.2f} ms/job",
                flush=True,
            )


def _job(lasts: float, sent: bytes) -> bytes:
    time.sleep(lasts)
    return sent[:BACK]


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    {"identify": identify, "jobs": jobs}[sys.argv[1]]()
