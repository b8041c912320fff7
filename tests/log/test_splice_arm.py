"""The rows of one robot on their way into another file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log.recording.columns import Rows
from armlab.log.recording.splice import SplicedRows, seconds_channel


def arm(numbers: list[int], t: list[float], t0_ns: int = 10**18) -> SplicedRows:
    kept = np.diff(t, prepend=-1.0) > 0
    stamps = t0_ns + np.zeros(len(t), dtype=int)
    return SplicedRows(
        Path("run.mcap"), "/a/", "hash", Rows(1, np.array(numbers), np.array(t), kept, stamps, t0_ns, "robot"), None
    )


def test_rows_are_taken_between_the_first_and_the_last_of_the_cut() -> None:
    one = arm([5, 6, 7, 8, 9], [0.0, 1.0, 1.0, 2.0, 3.0])
    one.cut(1.0, 2.5)
    assert (one.rows_left, one.ticks, one.inside) == (2, (6, 8), False)
    taken = [one.arrive(number, 0) is not None for number in (5, 6, 7, 8, 9, 77)]
    assert taken == [False, True, True, True, False, False]
    assert one.is_over
    one.cut(7.0, 8.0)
    assert (one.rows_left, one.ticks) == (0, (0, -1))


def test_a_following_recording_is_on_the_clock_of_the_first_and_numbered_on() -> None:
    first, second = arm([0, 1, 2], [0.0, 1.0, 2.0]), arm([1, 2], [0.0, 1.0], 10**18 + 5 * 10**9)
    second.follow(first, first)
    assert second.t.tolist() == [5.0, 6.0]
    assert [second.number(sequence) for sequence in (1, 2)] == [3, 4]
    assert first.number(2) == 2
    assert second.start_ns - first.end_ns == 3 * 10**9
    with pytest.raises(LogError, match=r"to begin after run\.mcap has ended at 2 s, got 1 s"):
        arm([7], [0.0], 10**18 + 10**9).follow(first, first)


def test_numbers_that_come_again_are_refused() -> None:
    with pytest.raises(LogError, match="got 1 that come again"):
        arm([3, 3], [0.0, 1.0])


def test_the_channel_of_the_seconds() -> None:
    channel = seconds_channel("/a/", {"armlab.t0_ns": "5"})
    assert (channel.topic, channel.type) == ("/a/columns/t", "armlab_msgs/msg/Column")
    assert set(channel.metadata) == {"column.t", "armlab.t0_ns"}
    one = arm([4], [0.25])
    message = one.arrive(4, 10**9)
    assert message is not None
    assert np.frombuffer(message[-8:], "<f8")[0] == 0.25
