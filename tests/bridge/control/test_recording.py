"""Rows and events of a run, in memory and in a file."""

from __future__ import annotations

import errno
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import bridge, log, robots
from armlab.bridge.control.recording import Feed, Recording, paths
from armlab.bridge.inputs.parameters import Change
from armlab.log import Column, Tick
from armlab.log.inspection import Setting
from armlab.robots import Robot
from armlab.state import Command, State


def row(robot: Robot, k: int) -> tuple[State, Tick]:
    q = robot.q_home + 0.001 * k
    state = State(0.02 * k, 0.02, q, 0 * q, 0 * q, seq=k, robot_ns=10**18 + 20_000_000 * k)
    return state, Tick(k, k, 10**18 + 20_000_000 * k, 1, 2, 3)


def keep(recording: Recording, state: State, command: Command | None, tick: Tick) -> None:
    """Do what the loop does with a row."""
    recording.pass_on(state, recording.keep(state, command, tick), tick)


@pytest.mark.parametrize("in_file", [False, True])
def test_rows_and_events(robot: Robot, tmp_path: Path, in_file: bool) -> None:
    path = tmp_path / "run.mcap" if in_file else None
    recording = Recording(robot, path, {"grip": Column(unit="N")}, wait=True, clock=lambda: 5)
    for k in range(1000):
        state, tick = row(robot, k)
        keep(recording, state, Command(state.q, record={"grip": float(k)}), tick)
    recording.event("Something happened.")
    tail = recording.tail()
    assert recording.close({"rows asked": 1000}) == []
    table = recording.table()
    assert len(table) == 1000
    np.testing.assert_array_equal(table["grip"], np.arange(1000.0))
    assert len(tail) == 501
    np.testing.assert_array_equal(tail["seq"], np.arange(499, 1000))
    assert list(recording.events) == [(5, "Something happened.")]
    assert recording.path == path
    if path is not None:
        assert len(log.read(path)) == 1000


def test_parameters(robot: Robot, tmp_path: Path) -> None:
    for path in (None, tmp_path / "run.mcap"):
        recording = Recording(robot, path, None, wait=True, clock=lambda: 5)
        recording.parameter(Change(1, "gain", 3.0, "local 1"))
        recording.close({})
    assert log.inspect(tmp_path / "run.mcap").parameters == (Setting(5, 1, "gain", 3.0, "local 1"),)


def test_the_robot_is_described_in_the_file(robot: Robot, tmp_path: Path) -> None:
    recording = Recording(robot, tmp_path / "run.mcap", None, wait=True, clock=lambda: 5)
    recording.close({})
    text = log.inspect(tmp_path / "run.mcap").attachments["robot.toml"].decode()
    assert robots.from_toml(text, "run.mcap") == robot


def test_a_command_of_any_shape_does_not_stop_the_rows(robot: Robot) -> None:
    recording = Recording(robot, None, None, wait=False, clock=lambda: 0)
    odd: list[Any] = [Command(np.zeros(3)), Command(q="up"), "no command", None]  # type: ignore[arg-type]
    for k, command in enumerate(odd):
        state, tick = row(robot, k)
        keep(recording, state, command, tick)
    assert len(recording.table()) == len(odd)
    assert not recording.events  # the bridge refuses such commands, by a sentence of its own


def test_a_command_stays_when_what_the_controller_records_does_not_fit(robot: Robot) -> None:
    recording = Recording(robot, None, {"grip": Column((2,), "N")}, wait=False, clock=lambda: 0)
    for k in range(3):
        state, tick = row(robot, k)
        keep(recording, state, Command(state.q + 1.0, record={"grip": np.zeros(3)}), tick)
    table = recording.table()
    np.testing.assert_array_equal(table["q_ref"], table["q"] + 1.0)
    assert "grip" not in table
    ((_, told),) = recording.events
    assert told.startswith("A row was kept without what the controller recorded: Expected")
    assert "grip" in told


def test_paths(robot: Robot) -> None:
    left, other = robots.load("yumi_left"), robots.load("ur5e")
    assert paths(None, [left, robot]) == [None, None]
    assert paths("run.mcap", [robot]) == [Path("run.mcap")]
    assert paths("logs/log", [left, robot]) == [Path("logs/logleft"), Path("logs/logright")]
    assert paths("run.mcap", [left, other]) == [Path("run-yumi_left.mcap"), Path("run-ur5e.mcap")]


def test_a_feed_that_raises_is_dropped(robot: Robot) -> None:
    class Broken:
        def row(self, state: State, command: Command | None, tick: Tick) -> None:
            raise ValueError("full")

        def event(self, text: str, warn: bool = False) -> None:
            raise ValueError("full too")

    feeds: list[Feed] = [Broken(), Broken()]
    recording = Recording(robot, None, None, wait=False, clock=lambda: 1, feeds=feeds, label="arm")
    state, tick = row(robot, 0)
    keep(recording, state, None, tick)
    assert not feeds
    assert next(text for _, text in recording.events).startswith("arm: A feed was dropped: it raised ValueError: full")
    assert len(recording.table()) == 1


def test_a_full_disk_is_told_at_once_and_once(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("armlab.log.recording_file.RecordingFile.write", full)
    recording = Recording(robot, tmp_path / "run.mcap", None, wait=False, clock=lambda: 0)
    deadline = time.monotonic() + 10.0
    asked = 0
    while not recording.events and time.monotonic() < deadline:
        state, tick = row(robot, asked)
        keep(recording, state, None, tick)
        asked += 1
        time.sleep(0.001)
    state, tick = row(robot, asked)
    keep(recording, state, None, tick)
    problems = recording.close({})
    ((_, told),) = recording.events
    assert told.startswith("The recording stopped: The log")
    assert told.endswith("stopped after 0 rows: No space left on device.")
    assert problems == [told, f"The recording lost {asked + 1} rows: they came after it stopped."]


def test_sentences_of_the_whole_run_have_no_label(robot: Robot) -> None:
    recording = Recording(robot, None, None, wait=False, clock=lambda: 7, label="yumi_left")
    recording.event("Late.")
    recording.note("Stopped.")
    assert list(recording.events) == [(7, "yumi_left: Late."), (7, "Stopped.")]


@pytest.mark.parametrize("in_file", [False, True])
def test_sentences_before_the_clock_is_known_get_the_stamp_of_the_first_row(
    robot: Robot, tmp_path: Path, in_file: bool
) -> None:
    now = [0]
    path = tmp_path / "run.mcap" if in_file else None
    recording = Recording(robot, path, None, wait=True, clock=lambda: now[0])
    recording.event("before")
    assert not recording.events
    state, tick = row(robot, 0)
    keep(recording, state, None, tick)
    now[0] = tick.stamp_ns + 5
    recording.event("after")
    recording.close({})
    assert list(recording.events) == [(tick.stamp_ns, "before"), (tick.stamp_ns + 5, "after")]
    if path is not None:
        told = [(one.stamp_ns, one.text) for one in log.inspect(path).events]
        assert told == [(tick.stamp_ns, f"recording {robot.name}"), *recording.events]


def test_a_run_in_lockstep_is_on_one_clock(robot: Robot, tmp_path: Path) -> None:
    """Also what was said before the first packet: the wall clock is years away from the simulated one."""
    with bridge.connect(f"sim://{robot.name}?lockstep=true", robot) as link:
        run = link.run(lambda state: Command(state.q_start), seconds=0.05, record=tmp_path / "run.mcap")
    events = log.inspect(tmp_path / "run.mcap").events
    assert len(events) > 1
    begin = run.table.t0_ns
    assert all(begin <= one.stamp_ns <= begin + 10**9 for one in events)
    assert all(begin <= stamp <= begin + 10**9 for stamp, _ in run.events)
