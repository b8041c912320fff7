"""One benchmark in a process of its own."""

from __future__ import annotations

import signal
import sys
import traceback
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from importlib import import_module
from multiprocessing import active_children, get_context
from time import perf_counter

from machine import OtherLoad
from report import Section

LIMIT = 900.0  # s for one benchmark: the longest takes three minutes
GRACE = 30.0  # s to end what it started


def measure(name: str, quick: bool) -> Section:
    """Run the benchmark ``bench_NAME.py``, once more if it fails: what runs in real time may do so for a moment's load.

    One that hangs fails after a quarter of an hour. Returns its tables, none with the reason if it fails twice.
    """
    start = perf_counter()
    section = _tried(name, quick)
    if section.failure:
        print(f"{name} failed, {section.failure} Once more ...", file=sys.stderr, flush=True)
        section = replace(_tried(name, quick), earlier=section.failure)
    return replace(section, seconds=perf_counter() - start)


def _tried(name: str, quick: bool) -> Section:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_run, name, quick, LIMIT).result(LIMIT + GRACE)
        except Exception as error:  # the others are not lost
            traceback.print_exc()
            for worker in active_children():  # one that waits where no signal reaches it would be waited for
                worker.kill()
            said = str(error) or f"took more than {LIMIT:g} s"
            return Section(name, [], 0.0, failure=f"{type(error).__name__}: {said}")


def _run(name: str, quick: bool, limit: float) -> Section:
    def too_long(*_: object) -> None:
        raise TimeoutError(f"took more than {limit:g} s")

    signal.signal(signal.SIGALRM, too_long)  # an exception: what it started is ended on the way out
    signal.setitimer(signal.ITIMER_REAL, limit)
    module = import_module(f"bench_{name}")
    with OtherLoad() as load:
        tables = module.run(quick)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    return Section(name, tables, load.cores)
