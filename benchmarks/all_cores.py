"""Cases of a Monte Carlo on all cores at once: for errors, which are the same on any; never for times."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

Result = TypeVar("Result")


def on_all_cores(case: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
    """Return what a function of a module returns for each set of arguments, in their order; processes share them."""
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        return list(pool.map(case, *arguments))
