"""Where the work is done: here, in processes, by Dask with a worker that is killed."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from armlab import fleet
from armlab.errors import ConfigError, LinkError
from armlab.fleet.workers import workers


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
