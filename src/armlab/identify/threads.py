"""Fits run on one thread of BLAS: the same bits on every machine, and no waiting.

The matrices are tall and thin. Several threads spend their time on waiting for each other, all the more on a machine
that does other work: a fit took five times the processor time, and summed in another order.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module

__all__ = ["one_thread"]


@contextmanager
def one_thread() -> Iterator[None]:
    """Give BLAS one thread in a `with` block or a decorated function, and as many as before after it."""
    from threadpoolctl import threadpool_limits

    import_module("scipy.linalg")  # only libraries that are loaded can be limited
    with threadpool_limits(limits=1, user_api="blas"):
        yield
