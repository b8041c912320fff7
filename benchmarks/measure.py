"""Run one benchmark in a separate process."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import traceback
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from importlib import import_module
from multiprocessing import active_children, get_context
from time import perf_counter

from machine import OtherLoad, family
from report import Section

LIMIT = 1500.0  # s, limit of one attempt; the slowest benchmark takes twelve minutes
GRACE = 30.0  # s, to terminate the processes that it started


class TooLong(BaseException):
    """Attempt that took too long; `except Exception` in a benchmark or in the measured code cannot catch it."""


def measure(name: str, quick: bool) -> Section:
    """Run the benchmark ``bench_NAME.py``, and repeat it once if it fails, because the load may be temporary.

    An attempt that takes more than `LIMIT` fails. If both attempts fail, returns the reason without tables.
    """
    start = perf_counter()
    section = _tried(name, quick)
    if section.failure:
        print(f"{name} failed, {section.failure} Repeating ...", file=sys.stderr, flush=True)
        section = replace(_tried(name, quick), earlier=section.failure)
    return replace(section, seconds=perf_counter() - start)


def _tried(name: str, quick: bool) -> Section:
    pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    future = pool.submit(_run, name, quick, LIMIT)
    try:
        return future.result(LIMIT + GRACE)
    except (Exception, TooLong) as error:  # keep the results of other benchmarks
        traceback.print_exc()
        said = str(error) if future.done() else f"took more than {LIMIT:g} s"
        return Section(name, [], 0.0, failure=f"{type(error).__name__}: {said}")
    finally:
        pool.shutdown(wait=False)
        for worker in active_children():
            worker.join(GRACE)
            if worker.is_alive():  # blocked where no signal reaches it
                _kill(worker.pid)


def _kill(pid: int | None) -> None:
    """Kill a worker and all its descendants."""
    for one in list(family(pid)) if pid else []:
        with contextlib.suppress(ProcessLookupError):
            os.kill(one, signal.SIGKILL)


def _run(name: str, quick: bool, limit: float) -> Section:
    def too_long(*_: object) -> None:
        raise TooLong(f"took more than {limit:g} s")

    signal.signal(signal.SIGALRM, too_long)  # raises, so context managers terminate its processes
    signal.setitimer(signal.ITIMER_REAL, limit)
    module = import_module(f"bench_{name}")
    with OtherLoad() as load:
        tables = module.run(quick)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    return Section(name, tables, load.cores)
