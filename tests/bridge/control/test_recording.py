"""Rows and events of a run, in memory and in a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log, robots
from armlab.bridge import Run
from armlab.bridge.control.recording import Feed, Recording, paths
from armlab.bridge.control.run import served, together
from armlab.bridge.inputs.parameters import Change
from armlab.log import Column, Table, Tick
from armlab.log.recording.metadata import Setting
from armlab.robots import Robot
from armlab.state import Command, State


def row(robot: Robot, k: int) -> tuple[State, Tick]:
    q = robot.q_home + 0.001 * k
    state = State(0.02 * k, 0.02, q, 0 * q, 0 * q, seq=k, robot_ns=10**18 + 20_000_000 * k)
    return state, Tick(k, k, 10**18 + 20_000_000 * k, 1, 2, 3)


def keep(recording: Recording, state: State, command: Command | None, tick: Tick) -> None:
    recording.publish(state, recording.keep(state, command, tick), tick)


@pytest.mark.parametrize("in_file", [False, True])
def test_rows_and_events(robot: Robot, tmp_path: Path, in_file: bool) -> None:
    path = tmp_path / "run.mcap" if in_file else None
    recording = Recording(robot, path, {"grip": Column(unit="N")}, wait=True, clock=lambda: 5)
    for k in range(1000):
        state, tick = row(robot, k)
        keep(recording, state, Command(state.q, record={"grip": float(k)}), tick)
    recording.event("Something happened.")
    recording.parameter(Change(1, "gain", 3.0, "local 1"))
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
        assert log.inspect(path).parameters == (Setting(5, 1, "gain", 3.0, "local 1"),)


def test_a_command_of_any_shape_does_not_stop_the_rows(robot: Robot) -> None:
    recording = Recording(robot, None, None, wait=False, clock=lambda: 0)
    odd: list[Any] = [Command(np.zeros(3)), Command(q="up"), "no command", None]  # type: ignore[arg-type]
    for k, command in enumerate(odd):
        state, tick = row(robot, k)
        keep(recording, state, command, tick)
    assert len(recording.table()) == len(odd)
    assert not recording.events  # the bridge refuses such commands with its own message


def test_a_command_stays_when_what_the_controller_records_does_not_fit(robot: Robot) -> None:
    recording = Recording(robot, None, {"grip": Column((2,), "N")}, wait=False, clock=lambda: 0)
    for k in range(3):
        state, tick = row(robot, k)
        keep(recording, state, Command(state.q + 1.0, record={"grip": np.zeros(3)}), tick)
    table = recording.table()
    np.testing.assert_array_equal(table["q_ref"], table["q"] + 1.0)
    assert "grip" not in table
    ((_, told),) = recording.events
    assert told.startswith("A row was stored without the controller's record: Expected")
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
    recording.catch_up()
    assert not feeds
    assert next(text for _, text in recording.events).startswith("arm: A feed was dropped: it raised ValueError: full")
    assert len(recording.table()) == 1


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


def rush(state: State) -> Command:
    return Command(qd=np.array([100.0, 0, 0, 0, 0, 0, 0]) * (state.t < 0.1))


@pytest.mark.parametrize("in_file", [False, True])
def test_report_and_table(play: Any, tmp_path: Path, in_file: bool) -> None:
    path = tmp_path / "run.mcap" if in_file else None
    run = play(lambda peer: peer.rest(), rush, seconds=0.3, record=path)
    assert isinstance(run, Run)
    assert (run.reason, run.path, run.table) == ("the time is up", path, run.table)
    for words in (
        "Ended: the time is up.",
        "yumi_right, RobotWare 6.10, 1 sessions, period 4.000 ms",
        f"replies {run.statistics['replies']}",
        "p99.9",
        "Clamped by velocity",
        "worst ratio 0.03",
        "Dropped datagrams: none",
    ):
        assert words in run.report()
    assert "Left out" not in run.report()
    other = replace(run, statistics={**run.statistics, "left_out": 3, "replies": 0}).report()
    assert "Skipped 3 replies because the robot's receive queue was full." in other
    assert "Arrival to reply" not in other
    assert len(run.table) == run.statistics["packets"]
    assert run.table.clock == "robot"
    np.testing.assert_allclose(np.diff(run.table.t), 0.004, atol=1e-9)
    clamped = run.table["clamped"].astype(int)
    for bit, name in ((1, "position"), (2, "velocity"), (4, "acceleration"), (8, "braking")):
        assert ((clamped[:, 0] & bit) != 0).sum() == run.statistics["clamps"][name][0]
    assert run.statistics["clamps"]["velocity"][0] > 5
    assert run.events[0][1].startswith("Session 1 began")
    assert run.events[-1][1] == "Stopping: the time is up."
    assert path is None or log.read(path).sha256 == run.table.sha256


def test_who_was_served() -> None:
    servers = {
        "labcomm": {"rows": 9, "lost": 2, "clients": {"left 127.0.0.1:7": (8, 0), "fused 127.0.0.1:8": [5, 4]}},
        "local": {"rows": 9, "lost": 0, "clients": {}},
        "other": {"rows": 1, "lost": 0, "clients": None},
    }
    commands: dict[str, dict[str, int]] = {"yumi_left": {"labcomm 127.0.0.1:7": 6}, "yumi_right": {}}
    counted = {
        "servers": servers, "commands": commands, "commands_refused": {"local 1": 3}, "parameters": {"gain": 2.0},
    }  # fmt: skip
    assert served(counted) == [
        "Rows to the server labcomm: 9 (2 lost). Rows from this server to its clients: left 127.0.0.1:7 8, "
        "fused 127.0.0.1:8 5 (4 dropped).",
        "Rows to the server local: 9. Rows from this server to its clients: none.",
        "Rows to the server other: 1. Rows from this server to its clients: unknown (the server did not answer).",
        "Commands to yumi_left: labcomm 127.0.0.1:7 6.",
        "Commands to yumi_right: none.",
        "Refused client commands: local 1 3.",
        "Parameter values: gain = 2.0.",
    ]
    assert served({}) == []


def test_tables_together() -> None:
    def table(rows: int, start_ns: int) -> Table:
        t = 0.004 * np.arange(rows)
        q = Column(shape=(2,), unit="rad")
        return Table(t, {"q": np.stack((t, -t), axis=1)}, {"q": q}, t0_ns=start_ns)

    both = together({"a": table(10, 10**18), "b": table(5, 10**18 + 2_000_000)})
    assert set(both.names) == {"a.q", "b.q", "b.age"}
    assert np.isnan(both["b.q"][0]).all()
    np.testing.assert_allclose(both["b.age"][1:5], 0.002)
    np.testing.assert_allclose(both["b.q"][1:5, 0], 0.004 * np.arange(4))
    assert len(together({"a": table(10, 1), "b": table(0, 1)})) == 10
