"""`cut` and `merge`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from armlab import log, robots
from armlab.errors import ConfigError, LogError, UnknownName
from armlab.log import Column, Recorder, cut, inspect, merge, read
from armlab.robots import Robot

ROWS = 300


@pytest.fixture
def record(tmp_path: Path, rows: Callable, extra: dict[str, Column]) -> Callable[..., Path]:
    """Record rows [first, last) of the synthetic run of an arm, with events and parameters between them."""

    def recorded(name: str, first: int = 0, last: int = ROWS, robot: str = "yumi_right") -> Path:
        arm = robots.load(robot)
        with Recorder(tmp_path / name, arm, extra=extra, attachments={"robot.toml": robot.encode()}, note=name) as to:
            for i in range(first, last):
                state, command, tick = rows(i)
                state = replace(state, tau=np.full(7, np.nan)) if i < 10 else state
                assert to.row(state, command, tick._replace(number=i - first))
                if i % 60 == 30:
                    to.event(f"event {i}", tick.stamp_ns)
                if i % 150 == 0:
                    to.parameter(i, "gain", float(i), "me", tick.stamp_ns)
        return to.path

    return recorded


def texts(path: Path) -> list[str]:
    return [event.text for event in inspect(path).events]


@pytest.mark.parametrize(("start", "stop"), [(0.5, 0.8), (-np.inf, 0.3), (0.9, np.inf)])
def test_the_rows_are_those_of_between_to_the_last_bit(
    record: Callable[..., Path], tmp_path: Path, start: float, stop: float
) -> None:
    path = record("run.mcap")
    part, table = read(cut(path, tmp_path / "part.mcap", start, stop)), read(path).between(start, stop)
    assert (part.sha256, part.t0_ns, part.clock) == (table.sha256, table.t0_ns, table.clock)
    assert part.source[1:] == table.source
    assert part.t[0] == table.t[0] >= start


def test_a_cut_is_a_whole_recording_with_all_that_belongs_to_it(record: Callable[..., Path], tmp_path: Path) -> None:
    path = record("run.mcap")
    told: list[tuple[int, int, str]] = []
    part = cut(path, tmp_path / "part.mcap", 0.6, 1.1, progress=lambda *step: told.append(step))
    held, original = inspect(part), inspect(path)
    assert (held.finished, held.metadata) == (True, original.metadata)
    assert held.attachments["robot.toml"] == b"yumi_right"
    assert texts(part) == ["event 150", "event 210", "event 270"]
    assert [one.value for one in held.parameters] == [0.0, 150.0]  # the value in effect, and the change
    assert (held.summary["rows"], held.summary["originals"]) == (len(read(part)), {"run.mcap": original.summary})
    assert 0 < told[-1][0] <= told[-1][1]
    with AnyReader([part]) as reader:
        states = [c for c in reader.connections if c.topic == "/yumi_right/joint_states"]
        q = [reader.deserialize(raw, c.msgtype).position for c, _, raw in reader.messages(states)]
    assert np.array_equal(q, read(part)["q"])


def test_pieces_put_together_are_the_whole_again(record: Callable[..., Path], tmp_path: Path) -> None:
    path = record("run.mcap")
    pieces = [cut(path, tmp_path / f"{k}.mcap", 0.5 * k, 0.5 * k + 0.5) for k in range(3)]
    whole = merge([pieces[2], pieces[0], pieces[1]], tmp_path / "whole.mcap")
    assert (read(whole).sha256, read(whole).t0_ns) == (read(path).sha256, read(path).t0_ns)
    assert texts(whole) == texts(path)
    again = cut(cut(path, tmp_path / "part.mcap", 0.3, 1.1), tmp_path / "again.mcap", 0.6, 0.9)
    assert read(again).sha256 == read(path).between(0.6, 0.9).sha256
    chain = (*read(path).between(0.3, 1.1).source, "between(0.6, 0.9)")
    assert read(again).source[2:] == chain


def test_runs_of_one_robot_keep_the_gap_between_them(record: Callable[..., Path], tmp_path: Path) -> None:
    """Their ticks begin at the same number, and the first rows lack torques."""
    first, second = record("first.mcap", 0, 100), record("second.mcap", 200, 300)
    assert read(first)["tick"][0] == read(second)["tick"][0] == 0
    whole = merge([second, first], tmp_path / "whole.mcap")
    expected = log.concat(read(first), read(second))
    assert (read(whole).sha256, read(whole).source[1:]) == (expected.sha256, expected.source)
    assert np.diff(read(whole).t).max() > 0.4
    held = inspect(whole)
    assert [pairs["note"] for pairs in held.metadata.values()] == ["first.mcap", "second.mcap"]
    assert [name for name in held.attachments if "robot" in name] == ["robot.toml"]
    assert read(cut(whole, tmp_path / "cut.mcap", 0.2, 1.0)).sha256 == expected.between(0.2, 1.0).sha256


def test_both_arms_of_a_bridge_stand_side_by_side(record: Callable[..., Path], tmp_path: Path) -> None:
    right, left = record("right.mcap", 0, 150), record("left.mcap", 50, 200, "yumi_left")
    both = merge([left, right], tmp_path / "both.mcap")
    assert inspect(both).robots == ("yumi_right", "yumi_left")
    for name, path in (("yumi_right", right), ("yumi_left", left)):
        assert read(both, robot=name).sha256 == read(path).sha256
    chain = (*read(right).source, *read(left).source, "merge(right.mcap, left.mcap)")
    assert read(both, robot="yumi_left").source[1:] == chain
    assert inspect(both).attachments["robot-2.toml"] == b"yumi_left"
    assert len(texts(both)) == len(texts(right)) + len(texts(left))
    with AnyReader([both]) as reader:
        times = [time for _, time, _ in reader.messages()]
    assert len(times) == sum(one.messages for path in (left, right) for one in inspect(path).topics) + 300  # and t
    part = cut(both, tmp_path / "part.mcap", 0.2, 0.4)
    assert read(part, robot="yumi_left").sha256 == read(left).between(0.2, 0.4).sha256
    assert read(part, robot="yumi_right").sha256 == read(right).between(0.2, 0.4).sha256
    alone = cut(both, tmp_path / "alone.mcap", 0.2, 0.5, robot="yumi_left")
    assert inspect(alone).robots == ("yumi_left",)
    assert {one.name.split("/")[1] for one in inspect(alone).topics} == {"yumi_left"}
    assert read(alone).sha256 == read(left).between(0.2, 0.5).sha256
    assert texts(alone) == texts(cut(left, tmp_path / "own.mcap", 0.2, 0.5))
    assert inspect(alone).summary["rows"] == len(read(alone))
    with pytest.raises(UnknownName, match="yumi_right"):
        cut(both, tmp_path / "none.mcap", robot="yumi_rihgt")
    assert not (tmp_path / "none.mcap").exists()


def test_a_recording_without_rows_sets_no_clock(record: Callable[..., Path], tmp_path: Path) -> None:
    empty, run = record("empty.mcap", 0, 0), record("run.mcap", 0, 50)
    other = record("other.mcap", 0, 0, "yumi_left")
    for number, paths in enumerate(([empty, run], [run, empty], [run, other], [empty, run, other])):
        whole = read(merge(paths, tmp_path / f"{number}.mcap"), robot="yumi_right")
        assert (whole.sha256, whole.t0_ns, whole.clock) == (read(run).sha256, read(run).t0_ns, read(run).clock)
    assert len(read(merge([empty, empty], tmp_path / "none.mcap"))) == 0


def test_what_does_not_fit_is_refused_in_a_sentence(
    record: Callable[..., Path], tmp_path: Path, robot: Robot, rows: Callable
) -> None:
    run, left = record("run.mcap", 0, 50), record("left.mcap", 300, 350, "yumi_left")
    with Recorder(tmp_path / "other.mcap", replace(robot, q_home=robot.q_home + 0.1)) as other:
        other.row(*rows(400))
    with Recorder(tmp_path / "units.mcap", robot, extra={"fext": Column(shape=(6,), unit="N m")}) as units:
        units.row(*rows(400))
    with Recorder(tmp_path / "twice.mcap", robot) as twice:
        for i in (0, 1):
            twice.row(*rows(i)[:2], rows(i)[2]._replace(number=3))
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"\x89MCAP0\r\n" + bytes(30))
    text = tmp_path / "run.csv"
    text.write_text("t [s],q1 [rad]\n0,1\n")
    to = tmp_path / "to.mcap"
    for error, words, work in (
        (
            LogError,
            r"between 5 s and 6 s in .*run\.mcap, got none. It contains rows from 0 s to 0\.19",
            (run, 5.0, 6.0),
        ),
        (ConfigError, "start < stop, got 2 s to 2 s", (run, 2.0, 2.0)),
        (ConfigError, "got nan s to 2 s", (run, np.nan, 2.0)),
        (LogError, "got a file of format text", (text, 0.0, 1.0)),
        (LogError, "got 1 repeated", (twice.path, 0.0, 1.0)),
        (LogError, r"empty\.mcap", (empty, 0.0, 1.0)),
        (LogError, "No such file", (tmp_path / "none.mcap", 0.0, 1.0)),
        (ConfigError, "at least two recordings to merge, got 1", [run]),
        (LogError, r"run\.mcap of yumi_right to begin after the end of .*run\.mcap at", [run, run]),
        (LogError, r"yumi_left, which began 1\..* s after", [run, left]),
        (LogError, "the same description of yumi_right, got a different one in .*other", [run, other.path]),
        (LogError, "joint names on /yumi_right/columns/fext in all recordings, but .*units", [run, units.path]),
    ):
        with pytest.raises(error, match=words):
            cut(work[0], to, *work[1:]) if isinstance(work, tuple) else merge(work, to)
    with pytest.raises(ConfigError, match=r"extension \.mcap"):
        merge([run, left], tmp_path / "to.csv")
    assert not to.exists()


def test_a_torn_recording_is_cut_and_becomes_whole(record: Callable[..., Path], tmp_path: Path) -> None:
    path = record("run.mcap")
    table = read(path)
    assert read(cut(path, path)).sha256 == table.sha256  # a file may be cut into itself
    path.write_bytes(path.read_bytes()[: int(0.7 * path.stat().st_size)])
    with pytest.warns(UserWarning, match="was not finished"):
        part, table = cut(path, tmp_path / "part.mcap", 0.5), read(path).between(0.5, np.inf)
    assert (inspect(part).finished, read(part).sha256) == (True, table.sha256)


@pytest.mark.filterwarnings("ignore")
def test_damaged_files_are_cut_or_refused_in_a_sentence(record: Callable[..., Path], tmp_path: Path) -> None:
    path, after, to = record("run.mcap", 0, 20), record("after.mcap", 50, 60), tmp_path / "to.mcap"
    data, rng = path.read_bytes(), np.random.default_rng(1)
    done = 0
    for place in rng.integers(8, len(data), 3):
        for spoilt in (data[:place], data[:place] + bytes([data[place] ^ 64]) + data[place + 1 :]):
            path.write_bytes(spoilt)
            with contextlib.suppress(LogError):
                done += len(read(cut(path, to, 0.0, 0.05))) > 0
            with contextlib.suppress(LogError):
                done += len(read(merge([path, after], to))) > 0
    assert done > 2
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["after.mcap", "run.mcap", "to.mcap"]


def test_rows_out_of_order_stay_reachable(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    with Recorder(tmp_path / "run.mcap", robot) as to:
        for i, place in enumerate([0, 1, 2, 2, 1, 3, 4, 5, 5]):
            state, command, tick = rows(place)
            to.row(state, command, tick._replace(number=i))
    with pytest.warns(UserWarning, match="does not increase"):
        table = read(to.path)
    cut(to.path, tmp_path / "part.mcap", table.t[2], table.t[4])
    with pytest.warns(UserWarning, match="does not increase"):
        part = read(tmp_path / "part.mcap")
    assert part.sha256 == table.between(table.t[2], table.t[4]).sha256
    assert len(read(tmp_path / "part.mcap", raw=True)) == len(part) + 2


def test_a_full_disk_and_ctrl_c_leave_nothing_behind(
    record: Callable[..., Path], tmp_path: Path, full_disk: Callable
) -> None:
    path, to = record("run.mcap"), tmp_path / "to.mcap"
    to.write_bytes(b"mine")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cut(path, to, 0.1, progress=interrupt)
    with full_disk(), pytest.raises(LogError, match=rf"Expected to write {to}, got: File too large\."):
        cut(path, to, 0.1)
    assert to.read_bytes() == b"mine"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["run.mcap", "to.mcap"]


@pytest.fixture
def holed(tmp_path: Path, rows: Callable) -> Callable[..., Path]:
    """Record 60 rows of an arm from tick 0 on, some of them lost."""

    def recorded(name: str, lost: tuple[int, ...], robot: str = "yumi_right", first: int = 0) -> Path:
        with Recorder(tmp_path / name, robots.load(robot)) as recorder:
            for i in range(60):
                state, command, tick = rows(first + i)
                recorder.row(None if i in lost else state, command, tick._replace(number=i))  # type: ignore[arg-type]
        return recorder.path

    return recorded


def test_holes_stay_with_the_recording_and_the_arm_that_have_them(holed: Callable[..., Path], tmp_path: Path) -> None:
    both = merge([holed("a.mcap", ()), holed("b.mcap", (20, 21), first=60)], tmp_path / "both.mcap")
    t = read(both).t
    of_a = inspect(cut(both, tmp_path / "of_a.mcap", stop=t[59])).summary
    of_b = inspect(cut(both, tmp_path / "of_b.mcap", start=t[61])).summary
    assert (of_a["dropped"], of_a["holes"]) == (0, [])
    assert (of_b["dropped"], of_b["holes"]) == (2, [[20, 21, 2, 80, "yumi_right"]])
    left, right = holed("left.mcap", (20, 21), "yumi_left"), holed("right.mcap", (40,))
    arms = merge([right, left], tmp_path / "arms.mcap")
    for path in (arms, cut(arms, tmp_path / "again.mcap")):
        assert "2 rows were dropped while recording: ticks 20 to 21" in read(path, robot="yumi_left").notes
        assert "1 rows were dropped while recording: ticks 40 to 40" in read(path, robot="yumi_right").notes
