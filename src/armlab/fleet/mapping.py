"""`map_logs`: one piece of work per log on any executor, with results in order, failures by name, and no log lost.

A killed worker of a process pool breaks the pool and every job in it. What was finished is kept, the rest starts again
in a new pool; then the jobs that were under way are tried one by one, and one that ends its worker again is skipped.
Dask starts its workers anew by itself, and blames every job that waited at workers that died: those are tried one by
one in the same way.

`workers`: processes of this computer or a Dask cluster to run it on.
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

_AHEAD = 4  # jobs that wait per worker: thousands of pickled jobs are memory for nothing
_WORKERS = 64  # assumed of executors that do not tell
_REPORT_PERIOD = 0.5  # s between two reports without a job that ends
_SENTENCE_PERIOD = 1.0  # s between two sentences: a line each where nobody watches
MAX_CRASHES = 2  # worker crashes before a job is skipped
_KILLED = "Expected a worker to survive this {}, but it was killed again. Look at the memory it takes, and at its logs."
_KILLED_BY_DASK = "KilledWorker"  # its name, since Dask need not be there: it has tried several workers by then


@dataclass(frozen=True)
class Done(Generic[Result]):
    """What became of all jobs.

    Attributes
    ----------
    results : by name, in the order of the jobs, of those that gave one.
    skipped : sentence by name of the others.
    """

    results: Mapping[str, Result]
    skipped: Mapping[str, str]

    def some(self) -> Done[Result]:
        """Return self; raise LogError with the first reason when every log was skipped."""
        if not self.results:
            count, reasons = len(self.skipped), list(self.skipped.values())
            raise LogError(f"Expected a log that can be used among {count}, got none. {' '.join(reasons[:1])}".rstrip())
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
    """Call ``work(job, *shared)`` for every job; skip one that raises an `ArmlabError` or ends its worker.

    `work` is a function of a module, so that it can be pickled. Without an executor jobs run here, one after the other.
    `progress` is called with (done, total, what) as jobs end; `rows` counts the rows of a result; `kind` names a job in
    sentences.
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
    """What is done so far."""

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
        """Keep what a job gave, or why it gave nothing."""
        worked, value = outcome
        (self.results if worked else self.skipped)[name] = value
        self._rows += self._count(value) if worked and self._count else 0
        self.report()

    def on(self, executor: Executor) -> None:
        """Run all jobs on an executor, on new ones after a worker was killed; each round settles a suspect."""
        suspects: list[str] = []
        if not getattr(executor, "_broken", False):  # what it was given before has ended its workers
            ahead = _AHEAD * getattr(executor, "_max_workers", _WORKERS)
            suspects = self._pass(executor, list(self._jobs), ahead)
        if self._blamed and not suspects:
            blamed, self._blamed = self._blamed, []
            suspects = self._pass(executor, blamed, ahead=1)
            for name in self._blamed:
                self.keep(name, (False, self._killed))
        while left := self._left(self._jobs):
            if not isinstance(executor, ProcessPoolExecutor):
                raise ConfigError("Expected an executor that goes on, but it broke. Start it anew and call again.")
            self._alone(executor, suspects)
            if left := self._left(left):
                with _another(executor, None) as again:
                    suspects = self._pass(again, left, ahead=_AHEAD * again._max_workers)  # pyright: ignore

    def _alone(self, executor: ProcessPoolExecutor, suspects: Sequence[str]) -> None:
        """Run jobs one after the other, so that nobody else can be blamed; skip one that ends its worker twice."""
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
        """Run jobs until they are done or the executor breaks; return those that were under way then, at least one."""
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
        """Keep what was finished before the executor broke; return the names of the rest."""
        lost = []
        for future, name in running.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                self.keep(name, future.result())
            else:
                lost.append(name)
        return lost

    def report(self) -> None:
        """Tell how far it is; the sentence once a second."""
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
    """Return a new pool like one that broke."""
    about: Any = executor
    return ProcessPoolExecutor(
        workers or about._max_workers,
        mp_context=about._mp_context,
        initializer=about._initializer,
        initargs=about._initargs,
        max_tasks_per_child=about._max_tasks_per_child,
    )


def _guarded(work: Callable[..., Result], job: Any, *shared: Any) -> tuple[bool, Result | str]:
    """Return (True, result), or (False, sentence) of a job whose log cannot be used."""
    try:
        return True, work(job, *shared)
    except (ArmlabError, OSError, MemoryError) as error:
        return False, str(error) or type(error).__name__


_PATIENCE = "10s"  # for a scheduler that is there


@contextmanager
def workers(count: int = 1, dask: str | None = None) -> Iterator[Executor | None]:
    """Yield an executor: `count` processes of this computer, None for one, or the Dask scheduler at an address."""
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
