"""A fit runs on one thread of BLAS and leaves the setting as it was."""

from __future__ import annotations

import pytest
import scipy.linalg  # noqa: F401  its BLAS is one of those that count
from threadpoolctl import threadpool_info, threadpool_limits

from armlab import identify
from armlab.identify.threads import one_thread
from armlab.log import Table
from armlab.robots import Robot


def threads() -> dict[str, int]:
    """Threads of each BLAS that is loaded; one that was built for a single thread always has one."""
    return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


class Stopped(Exception):
    """Ends a fit that has told what it was run for."""


def test_one_thread_inside_and_as_many_as_before_after() -> None:
    with threadpool_limits(2, "blas"):
        before = threads()
        assert 2 in before.values()
        with one_thread():
            assert set(threads().values()) == {1}
        assert threads() == before


@pytest.mark.parametrize("fit", [identify.fit_dynamics, identify.fit_gravity])
def test_a_fit_has_one_thread(fit, excited: Table, truth) -> None:
    robot: Robot = truth.robot
    seen: list[dict[str, int]] = []

    def look(done: int, total: int, what: str) -> None:
        seen.append(threads())
        raise Stopped

    with threadpool_limits(2, "blas"):
        before = threads()
        with pytest.raises(Stopped):
            fit(excited, robot, progress=look)
        assert [set(one.values()) for one in seen] == [{1}]
        assert threads() == before


def test_the_last_of_two_that_overlap_gives_the_threads_back() -> None:
    """As in threads of a pool: the first to begin is the first to end."""
    with threadpool_limits(2, "blas"):
        before = threads()
        first, second = one_thread(), one_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert set(threads().values()) == {1}
        second.__exit__(None, None, None)
        assert threads() == before
