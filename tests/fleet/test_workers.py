"""Where the work is done: here, in processes, by Dask with a worker that is killed."""

from __future__ import annotations

import os
import signal
from functools import partial
from operator import call
from pathlib import Path

import pytest

from armlab import fleet
from armlab.errors import ConfigError, LinkError
from armlab.fleet.mapping import map_logs, workers
from armlab.identify.many import fit_draft, log_sums


def test_one_process_is_this_one_and_none_is_refused() -> None:
    with workers() as executor:
        assert executor is None
    with workers(2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()
    with pytest.raises(ConfigError, match="at least one worker, got 0"), workers(0):
        pass


def test_a_scheduler_of_which_the_address_is_none() -> None:
    pytest.importorskip("distributed", reason="extra cluster")
    with pytest.raises(LinkError, match="scheduler at nonsense://x"), workers(dask="nonsense://x"):
        pass


@pytest.mark.slow  # 15 s: Dask starts its workers as new processes
@pytest.mark.filterwarnings("ignore")  # of Dask, of the worker that it lost
def test_a_cluster_that_loses_a_worker_gives_the_same_bits(
    folder: Path, short_arm, early: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="extra cluster")
    here = fleet.identify(folder, short_arm.robot).fit
    killed: list[int] = []
    options = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, workers(dask=cluster.scheduler_address) as executor:

        def kill(done: int, total: int, what: str) -> None:
            if total == 6 and done >= 2 and not killed:
                killed.append(next(iter(cluster.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        found = fleet.identify(folder, short_arm.robot, executor, kill)
    assert killed
    assert found.skipped == {}
    assert found.fit.parameters.tobytes() == here.parameters.tobytes()
    assert found.fit.cov.tobytes() == here.cov.tobytes()


@pytest.mark.slow  # 20 s: Dask starts a worker anew each time
@pytest.mark.filterwarnings("ignore")  # of Dask, of the workers that it lost
def test_a_log_that_kills_every_worker_of_a_cluster_is_skipped_and_the_rest_is_bit_equal(short_arm) -> None:
    distributed = pytest.importorskip("distributed", reason="extra cluster")
    tables = {f"log {k}": short_arm.log(k, 1000) for k in range(6)}
    _, pattern = fit_draft(list(tables.values())[:2], short_arm.robot, 6)
    jobs = {name: partial(log_sums, table, pattern) for name, table in tables.items()}
    here = map_logs(call, jobs).results
    deadly = {**dict(list(jobs.items())[:3]), "deadly": partial(signal.raise_signal, signal.SIGKILL), **jobs}
    options = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, workers(dask=cluster.scheduler_address) as executor:
        cluster.scheduler.allowed_failures = 1
        done = map_logs(call, deadly, executor=executor)
    assert list(done.skipped) == ["deadly"]  # not one that waited at the same workers
    assert "killed again" in done.skipped["deadly"]
    assert set(done.results) == set(here)
    for name, sums in here.items():
        for one, other in zip(sums.factors.R, done.results[name].factors.R, strict=True):
            assert one.tobytes() == other.tobytes()
