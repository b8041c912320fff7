"""`workers`: where the work over many logs is done, in processes here or by a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

from armlab.errors import ConfigError, LinkError, MissingExtra

__all__ = ["workers"]

_PATIENCE = "10s"  # for a scheduler that is there


@contextmanager
def workers(count: int = 1, dask: str | None = None) -> Iterator[Executor | None]:
    """Yield an executor for the block; None where one process is enough.

    Parameters
    ----------
    count : processes on this computer. dask : address of a Dask scheduler, which is used instead.

    Raises
    ------
    ConfigError : less than one process. MissingExtra : Dask is not installed. LinkError : nobody answers there.
    """
    if count < 1:
        raise ConfigError(f"Expected at least one worker, got {count}.")
    if dask is None:
        if count == 1:
            yield None
            return
        # Not forked: threads of this process, of BLAS and of others, are not in a copy, but their locks are.
        with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
            yield pool
        return
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtra(
            "Expected Dask for workers on several computers, got no package distributed. "
            "Run pip install 'armlab[cluster]'."
        ) from None
    try:
        client = Client(dask, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise LinkError(
            f"Expected a Dask scheduler at {dask}, got: {error}. Start it by dask scheduler "
            "--host 127.0.0.1 --dashboard-address 127.0.0.1:8787."
        ) from None
    with client:
        yield client.get_executor(pure=False)
