"""One benchmark in a process of its own."""

from __future__ import annotations

import traceback
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context

from machine import OtherLoad
from report import Section


def measure(name: str, quick: bool) -> Section:
    """Run the benchmark ``bench_NAME.py`` in a new process and return its tables, none with the reason if it fails."""
    print(f"Measuring {name} ...", flush=True)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_run, name, quick).result()
        except Exception as error:  # the others are not lost
            traceback.print_exc()
            return Section(name, [], 0.0, f"{type(error).__name__}: {error}")


def _run(name: str, quick: bool) -> Section:
    module = import_module(f"bench_{name}")
    with OtherLoad() as load:
        tables = module.run(quick)
    return Section(name, tables, load.cores)
