"""A fit runs on one thread of BLAS and leaves the setting as it was."""

from __future__ import annotations

import pytest
import scipy.linalg  # noqa: F401  its BLAS is one of those that count
from threadpoolctl import threadpool_info, threadpool_limits

from armlab import identify
from armlab.identify.threads import one_thread
from armlab.log import Table
from armlab.robots import Robot


def threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


class Stopped(Exception):
    """Ends a fit that has told what it was run for."""


def test_one_thread_inside_and_as_many_as_before_after() -> None:
    with threadpool_limits(2, "blas"):
        with one_thread():
            assert threads() == {1}
        assert threads() == {2}


@pytest.mark.parametrize("fit", [identify.fit_dynamics, identify.fit_gravity])
def test_a_fit_has_one_thread(fit, excited: Table, truth) -> None:
    robot: Robot = truth.robot
    seen: list[set[int]] = []

    def look(done: int, total: int, what: str) -> None:
        seen.append(threads())
        raise Stopped

    with threadpool_limits(2, "blas"):
        with pytest.raises(Stopped):
            fit(excited, robot, progress=look)
        assert seen == [{1}]
        assert threads() == {2}
