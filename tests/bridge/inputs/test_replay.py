"""A source as a recording holds it."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.bridge import ReplaySource
from armlab.errors import UnknownName
from armlab.log import Column, Table

MS = 1_000_000


def recording() -> Table:
    """Five ticks, 4 ms apart; the tracker's first reading came before the second tick, its next before the fifth."""
    nan = np.nan
    numbers = {
        "age": [nan, 0.001, 0.005, 0.009, 0.002],
        "gaps": [nan, 0.0, 0.0, 0.0, 3.0],
        "seq": [nan, 7.0, 7.0, 7.0, 11.0],
        "source_time": [nan, 0.5, 0.5, 0.5, nan],
        "delay": [nan, 0.0, 0.0, 0.0, nan],
        "p": [nan, 1.0, 1.0, 1.0, 2.0],
    }
    values: dict[str, np.ndarray] = {f"tracker.{name}": np.array(column) for name, column in numbers.items()}
    columns = {name: Column(unit="1") for name in values} | {"tracker.p": Column(unit="m")}
    values["receive_ns"] = 10**18 + 4 * MS * np.arange(5)
    return Table(0.004 * np.arange(5), values, columns)


def test_readings_come_when_they_came() -> None:
    source = ReplaySource("tracker", recording(), 1 / 30)
    assert (source.fields["p"].unit, [*source.fields]) == ("m", ["p"])
    start, got = 10**12, []
    for tick in range(7):
        source.now_ns = start + 4 * MS * tick
        got.append(source.newest())
    assert got[0] is None
    assert [None if one is None else (one.values["p"], one.seq, one.gaps, one.source_ns) for one in got[1:5]] == [
        (1.0, 7, 0, 500 * MS),
        (1.0, 7, 0, 500 * MS),
        (1.0, 7, 0, 500 * MS),
        (2.0, 11, 3, 0),
    ]
    assert {one.receive_ns for one in got[1:4] if one is not None} == {start + 3 * MS}
    assert got[4] is got[6]


def test_a_source_without_a_clock() -> None:
    source = ReplaySource("tracker", recording().without("tracker.source_time", "tracker.delay"), 1 / 30)
    source.now_ns = 0
    source.newest()
    source.now_ns = 5 * MS
    reading = source.newest()
    assert reading is not None
    assert (reading.seq, reading.source_ns) == (7, 0)


@pytest.mark.parametrize("absent", ["seq", "gaps"])
def test_a_source_without_numbers(absent: str) -> None:
    """As another program's recording may be."""
    source = ReplaySource("tracker", recording().without(f"tracker.{absent}"), 1 / 30)
    source.now_ns = 0
    assert source.newest() is None
    source.now_ns = 16 * MS
    reading = source.newest()
    assert reading is not None
    assert (reading.values["p"], reading.seq, reading.gaps) == (2.0, *((0, 3) if absent == "seq" else (11, 0)))


def test_a_source_that_was_not_recorded() -> None:
    with pytest.raises(UnknownName, match=r"source in this recording.*tracker"):
        ReplaySource("force", recording(), 0.001)
