"""One benchmark in a process of its own."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context

from machine import OtherLoad
from report import Section


def measure(name: str, quick: bool) -> Section:
    """Run the benchmark ``bench_NAME.py`` in a new process and return its tables."""
    print(f"Measuring {name} ...", flush=True)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_run, name, quick).result()


def _run(name: str, quick: bool) -> Section:
    module = import_module(f"bench_{name}")
    with OtherLoad() as load:
        tables = module.run(quick)
    return Section(name, tables, load.cores)
