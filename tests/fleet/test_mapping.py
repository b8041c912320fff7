"""Work over many logs: order, failures, killed workers, progress, Dask."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from operator import call
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import fleet
from armlab.errors import ConfigError, LinkError
from armlab.fleet.mapping import Done, Progress, map_logs, workers

DIES = partial(signal.raise_signal, signal.SIGKILL)
BAD = partial(Path.read_bytes, Path("/nowhere/at/all"))


class Shuffled(Executor):
    """Completes submitted jobs in random order, four at a time."""

    _max_workers = 2

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)
        self._held: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._held.append((future, partial(fn, *args, **kwargs)))
        if len(self._held) == 4:
            for k in self._rng.permutation(4):
                held, job = self._held[k]
                try:
                    held.set_result(job())
                except ValueError as error:
                    held.set_exception(error)
            self._held = []
        return future


class KilledWorker(Exception):
    """Dask's exception for a job whose workers died; recognised by this name."""


class Blaming(Executor):
    """Blames all but one job of the first pass for a crash, then only the deadly ones."""

    def __init__(self, jobs: int, deadly: set[int]) -> None:
        self._left, self._deadly = jobs, deadly

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._left -= 1
        if self._left > 0 or (self._left < 0 and args[1] in self._deadly):
            future.set_exception(KilledWorker())
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_whom_dask_blames_is_tried_alone_and_skipped_only_then() -> None:
    jobs, said = {f"joint {k}": k for k in range(6)}, []
    blaming = Blaming(len(jobs), {1, 4})
    done = map_logs(abs, jobs, executor=blaming, kind="joint", progress=lambda *told: said.append(told[2]))
    assert list(done.skipped) == ["joint 1", "joint 4"]
    assert all("this joint, but it crashed again" in reason for reason in done.skipped.values())
    assert done.results == {name: k for name, k in jobs.items() if k not in (1, 4)}
    assert said[-1].startswith("6 of 6 joints")


@pytest.fixture(params=["serial", "threads", "processes", "shuffled"])
def executor(request: pytest.FixtureRequest) -> Iterator[Executor | None]:
    if request.param in ("serial", "shuffled"):
        yield Shuffled() if request.param == "shuffled" else None
        return
    with {"threads": ThreadPoolExecutor, "processes": ProcessPoolExecutor}[request.param](2) as pool:
        yield pool


def roots(count: int) -> dict[str, Callable[[], float]]:
    return {str(k): partial(math.sqrt, k) for k in range(count)}


def test_results_are_in_the_order_of_the_jobs_and_what_is_foreseen_is_skipped(executor: Executor | None) -> None:
    told: list[tuple[int, int, str]] = []
    jobs = {**roots(39), "bad": BAD}
    done = map_logs(call, jobs, executor=executor, progress=lambda *step: told.append(step))
    assert list(done.results.items()) == [(str(k), math.sqrt(k)) for k in range(39)]
    assert isinstance(done, Done)
    assert list(done.skipped) == ["bad"]
    assert "/nowhere/at/all" in done.skipped["bad"]
    assert told[-1] == (40, 40, "40 of 40 logs, 1 skipped")
    assert [step[0] for step in told] == sorted(step[0] for step in told)
    assert map_logs(pow, {"a": 2, "b": 3, "c": 5, "d": 7}, 3, 10).results == {"a": 8, "b": 7, "c": 5, "d": 3}


def test_a_mistake_in_the_program_is_not_hidden(executor: Executor | None) -> None:
    with pytest.raises(ValueError, match="math domain"):
        map_logs(call, {**roots(3), "wrong": partial(math.sqrt, -1.0)}, executor=executor)


def test_jobs_that_always_kill_their_worker_are_skipped_and_the_rest_is_done() -> None:
    jobs = {"first": DIES, **roots(12), "middle": DIES, "beside": DIES, "more": partial(math.sqrt, 9), "last": DIES}
    with ProcessPoolExecutor(2) as pool:
        done = map_logs(call, jobs, executor=pool)
    assert list(done.skipped) == ["first", "middle", "beside", "last"]
    assert all("crashed again" in reason for reason in done.skipped.values())
    assert list(done.results) == [*map(str, range(12)), "more"]


def test_a_worker_killed_from_outside_while_its_job_is_tried_alone_does_not_cost_the_job(tmp_path: Path) -> None:
    marks = " || ".join(f"mkdir {tmp_path / name} 2>/dev/null" for name in "ab")
    job = partial(subprocess.check_output, ["sh", "-c", f"({marks}) && kill -9 $PPID; echo alive"])
    with ProcessPoolExecutor(2) as pool:
        done = map_logs(call, {"twice": job, **roots(3)}, executor=pool)
    assert done.skipped == {}
    assert done.results["twice"] == b"alive\n"


def test_workers_that_cannot_start_or_were_broken_before() -> None:
    with ProcessPoolExecutor(1, initializer=DIES) as pool:
        assert list(map_logs(call, roots(3), executor=pool).skipped) == ["0", "1", "2"]
    with ProcessPoolExecutor(1) as pool:
        assert pool.submit(DIES).exception() is not None
        assert map_logs(call, roots(3), executor=pool).results == {"0": 0.0, "1": 1.0, "2": math.sqrt(2)}
    threads = ThreadPoolExecutor(1, initializer=partial(math.sqrt, -1.0))
    with threads, pytest.raises(ConfigError, match="got a broken executor"):
        map_logs(call, roots(3), executor=threads)


def test_an_interrupt_leaves_no_job_waiting() -> None:
    def stop(done: int, total: int, what: str) -> None:
        if done:
            raise KeyboardInterrupt

    made: list[int] = []
    tell: Progress = stop
    with ThreadPoolExecutor(1) as pool, pytest.raises(KeyboardInterrupt):
        map_logs(call, {str(k): partial(made.append, k) for k in range(1000)}, executor=pool, progress=tell)
    assert len(made) < 10


def test_progress_tells_logs_rows_skipped_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.fleet.mapping._SENTENCE_PERIOD", 0.0)
    told: list[tuple[int, int, str]] = []
    jobs = {"a": partial(int, 100), "bad": BAD, "b": partial(int, 200)}
    map_logs(call, jobs, progress=lambda *step: told.append(step), rows=lambda rows: rows)
    assert told[0] == (0, 3, "0 of 3 logs")
    assert re.fullmatch(r"1 of 3 logs, \d+ rows/s, \d+ s left", told[1][2])
    assert re.fullmatch(r"2 of 3 logs, \d+ rows/s, 1 skipped, \d+ s left", told[2][2])
    assert re.fullmatch(r"3 of 3 logs, \d+ rows/s, 1 skipped", told[3][2])


def test_one_process_is_this_one_and_what_cannot_be_a_worker_is_refused() -> None:
    with workers() as executor:
        assert executor is None
    with workers(2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()
    with pytest.raises(ConfigError, match="at least one worker, got 0"), workers(0):
        pass
    pytest.importorskip("distributed", reason="extra cluster")
    with pytest.raises(LinkError, match="scheduler at nonsense://x"), workers(dask="nonsense://x"):
        pass


@pytest.mark.slow  # 20 s: Dask starts its workers as new processes
@pytest.mark.filterwarnings("ignore")  # Dask warns about the lost worker
def test_a_cluster_that_loses_a_worker_beside_a_slow_one_gives_the_same_bits(
    folder: Path, short_arm, early: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="extra cluster")
    here = fleet.identify(folder, short_arm.robot)
    killed: list[int] = []
    options = {"n_workers": 4, "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, workers(dask=cluster.scheduler_address) as executor:
        lost, slow, *_ = (worker.pid for worker in cluster.workers.values())

        def kill(done: int, total: int, what: str) -> None:
            if total == 6 and done >= 2 and not killed:
                killed.append(lost)
                os.kill(lost, signal.SIGKILL)

        with slowed(slow):
            found = fleet.identify(folder, short_arm.robot, executor, kill)
    assert killed
    assert (found.used, found.skipped, found.fit.n) == (here.used, {}, here.fit.n)
    for name in ("parameters", "cov"):
        assert getattr(found.fit, name).tobytes() == getattr(here.fit, name).tobytes()


@contextmanager
def slowed(process: int) -> Iterator[None]:
    """Let a process run only a tenth of the time."""
    over = threading.Event()

    def drag() -> None:
        while not over.is_set():
            os.kill(process, signal.SIGSTOP)
            over.wait(0.09)
            os.kill(process, signal.SIGCONT)
            over.wait(0.01)

    thread = threading.Thread(target=drag)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
