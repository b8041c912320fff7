"""Fits run on one thread of BLAS: the same bits on every machine, and no waiting.

The matrices are tall and thin. Several threads spend their time on waiting for each other, all the more on a machine
that does other work: a fit took five times the processor time, and summed in another order.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from importlib import import_module
from threading import Lock
from typing import Any

_lock = Lock()
_inside = 0
_limits = ExitStack()


@contextmanager
def one_thread() -> Iterator[None]:
    """Give BLAS one thread in a `with` block or a decorated function, and as many as before after it.

    The number of threads belongs to the process: of blocks that overlap, in several threads, the last gives it back.
    """
    global _inside
    with _lock:
        if not _inside:
            _limits.enter_context(_libraries().limit(limits=1, user_api="blas"))
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if not _inside:
                _limits.close()


@cache
def _libraries() -> Any:
    """Return what limits the threads of the libraries of this process; to look for them takes milliseconds."""
    from threadpoolctl import ThreadpoolController

    import_module("scipy.linalg")  # only libraries that are loaded can be limited
    return ThreadpoolController()
