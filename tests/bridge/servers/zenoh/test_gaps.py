"""Rows that did not come are counted from their numbers."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.bridge.servers.zenoh import Gaps
from armlab.log import Tick
from armlab.state import State

ARMS = [robots.load(name) for name in ("yumi_left", "yumi_right")]
SCHEMA = RowSchema.of(ARMS)


def rows(count: int) -> list[bytes]:
    """Rows of the left arm, of a cell whose arms take turns."""
    writer, found = RowWriter(SCHEMA), []
    for number in range(count):
        for arm in ARMS:
            nothing: Any = np.full(7, np.nan)
            state = State(0.0, 0.004, np.array(arm.q_home), nothing, nothing, robot=arm.name)
            data = writer.row(state, None, Tick(number, -1, 0, 0, -1, 0), 0)
            if arm is ARMS[0]:
                found.append(data)
    return found


ROWS = rows(60)


@given(st.sets(st.integers(0, 59), min_size=1))
def test_what_is_missing_is_counted(kept: set[int]) -> None:
    gaps = Gaps(SCHEMA, "yumi_left")
    order = sorted(kept)
    missing = [gaps.take(ROWS[k]) for k in order]
    assert missing == [0, *(b - a - 1 for a, b in itertools.pairwise(order))]
    assert (gaps.rows, gaps.lost, gaps.starts) == (len(order), order[-1] - order[0] + 1 - len(order), 1)


def test_a_bridge_that_starts_again_is_no_loss() -> None:
    gaps = Gaps(SCHEMA, "yumi_left")
    for k in (10, 11, 13, 0, 1, 4):
        gaps.take(ROWS[k])
    assert (gaps.rows, gaps.lost, gaps.starts) == (6, 3, 2)


def test_an_arm_that_is_not_in_the_rows() -> None:
    with pytest.raises(KeyError):
        Gaps(SCHEMA, "irb2400")
