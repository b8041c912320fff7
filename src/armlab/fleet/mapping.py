"""`map_logs` runs one job per log on any executor, with ordered results, failures reported by name, and crash recovery.

A killed worker breaks its process pool and all jobs in it. Finished results are kept. The interrupted jobs then run one
by one, and a job that crashes its worker again is skipped. The remaining jobs run in a new pool. Dask restarts its
workers itself, but reports every job queued on a crashed worker as failed; these jobs are also rerun one by one.

`workers` provides processes on this computer or a Dask cluster.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Generic, TypeVar

from armlab.errors import ArmlabError, ConfigError, LinkError, LogError, MissingExtra

Progress = Callable[[int, int, str], None]
Result = TypeVar("Result")

_AHEAD = 4  # queued jobs per worker; limited because every pickled job takes memory
_WORKERS = 64  # assumed for executors without a worker count
_REPORT_PERIOD = 0.5  # s between progress reports while no job ends
_SENTENCE_PERIOD = 1.0  # s between progress lines, for output to a file
MAX_CRASHES = 2  # worker crashes before a job is skipped
_KILLED = "Expected the worker to finish this {}, but it crashed again. Check the worker's memory use and logs."
_KILLED_BY_DASK = "KilledWorker"  # Dask's exception after several crashes, by name because Dask is optional


@dataclass(frozen=True)
class Done(Generic[Result]):
    """Results of all jobs.

    Attributes
    ----------
    results : results of the successful jobs by name, in job order.
    skipped : reasons for skipping the other jobs, by name.
    """

    results: Mapping[str, Result]
    skipped: Mapping[str, str]

    def some(self) -> Done[Result]:
        """Return self; raise a LogError with the first reason if every log was skipped."""
        if not self.results:
            count, reasons = len(self.skipped), list(self.skipped.values())
            raise LogError(f"Expected a usable log among {count}, got none. {' '.join(reasons[:1])}".rstrip())
        return self


def map_logs(
    work: Callable[..., Result],
    jobs: Mapping[str, Any],
    *shared: Any,
    executor: Executor | None = None,
    progress: Progress | None = None,
    rows: Callable[[Result], int] | None = None,
    kind: str = "log",
) -> Done[Result]:
    """Call ``work(job, *shared)`` for every job; skip jobs that raise an `ArmlabError` or crash their worker.

    `work` must be a module-level function, because it is pickled. Without an executor, jobs run one by one in this
    process. `progress` is called with (done, total, what) as jobs end. `rows` returns the number of rows of a result.
    `kind` names a job in messages.
    """
    run = _JobRun(work, jobs, shared, progress or (lambda done, total, what: None), rows, kind)
    run.report()
    if executor is None:
        for name in jobs:
            run.keep(name, _guarded(work, jobs[name], *shared))
    else:
        run.on(executor)
    order = list(jobs)
    return Done(
        {name: run.results[name] for name in order if name in run.results},
        {name: run.skipped[name] for name in order if name in run.skipped},
    )


class _JobRun:
    """Execution of all jobs, with their results and progress."""

    def __init__(
        self,
        work: Callable[..., Any],
        jobs: Mapping[str, Any],
        shared: Sequence[Any],
        tell: Progress,
        rows: Callable[[Any], int] | None,
        kind: str,
    ) -> None:
        self._work, self._jobs, self._shared, self._tell, self._count = work, jobs, shared, tell, rows
        self._kind, self._killed = f"{kind}s", _KILLED.format(kind)
        self._began = time.monotonic()
        self._said, self._what, self._rows = -_SENTENCE_PERIOD, "", 0
        self._blamed: list[str] = []
        self.results: dict[str, Any] = {}
        self.skipped: dict[str, str] = {}

    def keep(self, name: str, outcome: tuple[bool, Any]) -> None:
        worked, value = outcome
        (self.results if worked else self.skipped)[name] = value
        self._rows += self._count(value) if worked and self._count else 0
        self.report()

    def on(self, executor: Executor) -> None:
        """Run all jobs on an executor, with a new pool after each crash; each round completes at least one job."""
        suspects: list[str] = []
        if not getattr(executor, "_broken", False):  # broken by earlier jobs of the caller
            ahead = _AHEAD * getattr(executor, "_max_workers", _WORKERS)
            suspects = self._pass(executor, list(self._jobs), ahead)
        if self._blamed and not suspects:
            blamed, self._blamed = self._blamed, []
            suspects = self._pass(executor, blamed, ahead=1)
            for name in self._blamed:
                self.keep(name, (False, self._killed))
        while left := self._left(self._jobs):
            if not isinstance(executor, ProcessPoolExecutor):
                raise ConfigError("Expected a working executor, got a broken executor. Restart this executor.")
            self._alone(executor, suspects)
            if left := self._left(left):
                with _another(executor, None) as again:
                    suspects = self._pass(again, left, ahead=_AHEAD * again._max_workers)  # pyright: ignore

    def _alone(self, executor: ProcessPoolExecutor, suspects: Sequence[str]) -> None:
        """Run jobs one by one to attribute crashes; skip a job that crashes its worker twice."""
        killed: Counter[str] = Counter()
        while suspects := self._left(suspects):
            with _another(executor, 1) as alone:
                killed.update(self._pass(alone, suspects, ahead=1))
            for name in suspects:
                if killed[name] == MAX_CRASHES:
                    self.keep(name, (False, self._killed))

    def _left(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if name not in self.results and name not in self.skipped]

    def _pass(self, executor: Executor, names: Sequence[str], ahead: int) -> list[str]:
        """Run jobs until they are done or the executor breaks; return the interrupted jobs (at least one)."""
        waiting = list(reversed(names))
        running: dict[Future[tuple[bool, Any]], str] = {}
        try:
            while waiting or running:
                while waiting and len(running) < ahead:
                    try:
                        future = executor.submit(_guarded, self._work, self._jobs[waiting[-1]], *self._shared)
                    except BrokenExecutor:
                        return [*self._saved(running), waiting[-1]]
                    running[future] = waiting.pop()
                done, _ = wait(running, timeout=_REPORT_PERIOD, return_when=FIRST_COMPLETED)
                self.report()
                for future in done:
                    error = future.exception()
                    if isinstance(error, BrokenExecutor):
                        return self._saved(running)
                    if type(error).__name__ == _KILLED_BY_DASK:
                        self._blamed.append(running.pop(future))
                    else:
                        self.keep(running.pop(future), future.result())
        finally:
            for future in running:
                future.cancel()
        return []

    def _saved(self, running: Mapping[Future[tuple[bool, Any]], str]) -> list[str]:
        """Store the results of jobs that finished before the executor broke; return the names of the other jobs."""
        lost = []
        for future, name in running.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                self.keep(name, future.result())
            else:
                lost.append(name)
        return lost

    def report(self) -> None:
        """Report the progress, updating the text once per second."""
        done, total = len(self.results) + len(self.skipped), len(self._jobs)
        passed = time.monotonic() - self._began
        if done == total or passed - self._said >= _SENTENCE_PERIOD:
            self._said, parts = passed, [f"{done} of {total} {self._kind}"]
            if self._rows:
                parts.append(f"{self._rows / max(passed, 1e-3):.0f} rows/s")
            if self.skipped:
                parts.append(f"{len(self.skipped)} skipped")
            if 0 < done < total:
                parts.append(f"{passed / done * (total - done):.0f} s left")
            self._what = ", ".join(parts)
        self._tell(done, total, self._what)


def _another(executor: ProcessPoolExecutor, workers: int | None) -> ProcessPoolExecutor:
    about: Any = executor
    return ProcessPoolExecutor(
        workers or about._max_workers,
        mp_context=about._mp_context,
        initializer=about._initializer,
        initargs=about._initargs,
        max_tasks_per_child=about._max_tasks_per_child,
    )


def _guarded(work: Callable[..., Result], job: Any, *shared: Any) -> tuple[bool, Result | str]:
    """Return (True, result), or (False, reason) if the log is unusable."""
    try:
        return True, work(job, *shared)
    except (ArmlabError, OSError, MemoryError) as error:
        return False, str(error) or type(error).__name__


_PATIENCE = "10s"  # connection timeout of the scheduler


@contextmanager
def workers(count: int = 1, dask: str | None = None) -> Iterator[Executor | None]:
    """Yield an executor: `count` processes on this computer (None if `count` is 1), or the Dask scheduler at an
    address."""
    if count < 1:
        raise ConfigError(f"Expected at least one worker, got {count}.")
    if dask is None:
        if count == 1:
            yield None
            return
        # Workers are spawned: a fork would copy locks held by threads (such as BLAS threads), but not the threads.
        with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
            yield pool
        return
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtra(
            "Expected the package distributed (Dask) for workers on several computers, but it is not installed. "
            "Install it: pip install 'armlab[cluster]'."
        ) from None
    try:
        client = Client(dask, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise LinkError(
            f"Expected a Dask scheduler at {dask}, got: {error}. Start it with dask scheduler "
            "--host 127.0.0.1 --dashboard-address 127.0.0.1:8787."
        ) from None
    with client:
        yield client.get_executor(pure=False)
