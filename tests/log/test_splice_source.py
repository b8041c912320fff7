"""A recording that goes into another: what it holds, and what is said of it there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from armlab import robots
from armlab.errors import LogError
from armlab.log import Recorder, cut, inspect, merge, read
from armlab.log.recording.splice import Source, attachments, metadata, opened_source, summary
from armlab.robots import Robot


def test_holes_of_the_recorder_are_told_where_they_are(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    with Recorder(tmp_path / "run.mcap", robot) as recorder:
        for i in range(60):
            state, command, tick = rows(i)
            recorder.row(None if i in (20, 21, 40) else state, command, tick)  # type: ignore[arg-type]
    assert inspect(recorder.path).summary["holes"] == [[20, 21, 2], [40, 40, 1]]
    with opened_source(recorder.path) as source:
        assert isinstance(source, Source)
        assert (summary([source], "all")["rows"], summary([source], "all")["dropped"]) == (57, 3)
        source.arms[0].cut(source.arms[0].rows.t[10], source.arms[0].rows.t[30])
        told = summary([source], "between")
    assert (told["rows"], told["dropped"], told["holes"]) == (20, 2, [[20, 21, 2, 20, "yumi_right"]])
    assert told["source"][-1] == "between"


def test_holes_stay_with_the_recording_that_has_them(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    """Both recordings begin with tick 0: in one file of both, a tick does not say whose it is."""
    for name, first, lost in (("a", 0, ()), ("b", 60, (80, 81))):
        with Recorder(tmp_path / f"{name}.mcap", robot) as recorder:
            for i in range(first, first + 60):
                state, command, tick = rows(i)
                tick = tick._replace(number=i - first)
                recorder.row(None if i in lost else state, command, tick)  # type: ignore[arg-type]
    both = merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "both.mcap")
    t = read(both).t
    of_a = inspect(cut(both, tmp_path / "of_a.mcap", stop=t[59])).summary
    of_b = inspect(cut(both, tmp_path / "of_b.mcap", start=t[61])).summary
    assert (of_a["dropped"], of_a["holes"]) == (0, [])
    assert (of_b["dropped"], of_b["holes"]) == (2, [[20, 21, 2, 80, "yumi_right"]])


def test_holes_stay_with_the_arm_that_has_them(tmp_path: Path, rows: Callable) -> None:
    """Both arms count the same ticks: in one file of both, a tick does not say whose it is."""
    for name, lost in (("yumi_left", (20, 21)), ("yumi_right", (40,))):
        with Recorder(tmp_path / f"{name}.mcap", robots.load(name)) as recorder:
            for i in range(60):
                state, command, tick = rows(i)
                recorder.row(None if i in lost else state, command, tick)  # type: ignore[arg-type]
    both = merge([tmp_path / "yumi_right.mcap", tmp_path / "yumi_left.mcap"], tmp_path / "both.mcap")
    again = cut(both, tmp_path / "again.mcap")
    for path in (both, again):
        assert "2 rows were dropped while recording: ticks 20 to 21" in read(path, robot="yumi_left").notes
        assert "1 rows were dropped while recording: ticks 40 to 40" in read(path, robot="yumi_right").notes


def test_what_several_have_under_one_name_gets_a_number(recording: Callable[..., Path]) -> None:
    first = recording(5, "a.mcap", attachments={"m.toml": b"1", "n": b"3"})
    second = recording(5, "b.mcap", attachments={"m.toml": b"2", "n": b"3"}, note="other")
    with opened_source(first) as a, opened_source(second) as b:
        named = {name: data for _, name, _, data in attachments([a, b, a])}
        assert {"m.toml": b"1", "m-2.toml": b"2", "n": b"3"}.items() <= named.items()
        assert [name for name, _ in metadata([a, b, a])] == ["armlab", "armlab-2"]
        assert a.start_ns == b.start_ns < a.end_ns


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(30))
    with pytest.raises(LogError), opened_source(path):
        pass
