"""One benchmark in a process of its own."""

from __future__ import annotations

import sys
import traceback
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from importlib import import_module
from multiprocessing import get_context
from time import perf_counter

from machine import OtherLoad
from report import Section


def measure(name: str, quick: bool) -> Section:
    """Run the benchmark ``bench_NAME.py``, once more if it fails: what runs in real time may do so for a moment's load.

    Returns its tables, none with the reason if it fails twice.
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
            return pool.submit(_run, name, quick).result()
        except Exception as error:  # the others are not lost
            traceback.print_exc()
            return Section(name, [], 0.0, failure=f"{type(error).__name__}: {error}")


def _run(name: str, quick: bool) -> Section:
    module = import_module(f"bench_{name}")
    with OtherLoad() as load:
        tables = module.run(quick)
    return Section(name, tables, load.cores)
