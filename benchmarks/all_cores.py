"""Parallel Monte Carlo cases on all cores: for errors, which do not depend on the core, but never for times."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

Result = TypeVar("Result")


def on_all_cores(case: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
    """Call a module's function with each set of arguments in several processes; return the results in order."""
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        return list(pool.map(case, *arguments))
