"""Columns and rows in the file of a recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab import log, robots
from armlab.errors import LogError, UnknownName
from armlab.log.mcap.records import contents
from armlab.log.recording.columns import (
    CLOCK_COLUMNS,
    Rows,
    Source,
    clock_channel,
    clocks,
    columns_at,
    kept_clock,
    rows_of,
    sources_of,
)
from armlab.log.recording.ros_messages import T0_KEY


def test_the_rows_are_those_of_the_table(recording: Callable[..., Path]) -> None:
    path = recording(30)
    view, table = memoryview(path.read_bytes()), log.read(path)
    found = contents(view)
    rows = rows_of(view, found, path)
    assert isinstance(rows, Rows)
    assert rows.kept.all()
    assert np.array_equal(rows.t, table.t)
    assert (rows.t0_ns, rows.clock) == (table.t0_ns, table.clock)
    assert rows.sequence.tolist() == list(range(30))
    assert list(clocks(found).values()) == ["/yumi_right/tick"]
    with pytest.raises(UnknownName, match="yumi_right"):
        clock_channel(found, path, "yumi_left")


def test_single_columns(recording: Callable[..., Path]) -> None:
    path = recording(30)
    view = memoryview(path.read_bytes())
    found = contents(view)
    clock = clock_channel(found, path, None)
    sources = sources_of(found, clock)
    assert isinstance(sources["q"], Source)
    assert sources["q"].fields == ("position",)
    assert set(CLOCK_COLUMNS) - set(sources) == {"t"}
    values, rows, damage = columns_at(view, found, clock, {"q": sources["q"], "rapid_data": sources["rapid_data"]})
    assert list(values) == ["q"]
    assert np.array_equal(values["q"], log.read(path)["q"])
    assert (len(rows.sequence), damage) == (30, [])


def test_the_clock_that_is_written_beside_t(recording: Callable[..., Path], tmp_path: Path) -> None:
    table = log.read(recording(30)).shifted(5.0)
    path = log.write(table, tmp_path / "shifted.mcap", robots.load("yumi_right"))
    found = contents(memoryview(path.read_bytes()))
    sources = sources_of(found, clock_channel(found, path, None))
    assert kept_clock(found, sources, 0, "") == (table.t0_ns, "robot")
    assert kept_clock(found, {}, 3, "file") == (3, "file")
    found.channels[sources["t"].channel].metadata[T0_KEY] = "today"
    with pytest.raises(LogError, match="got 'today'"):
        kept_clock(found, sources, 0, "")
