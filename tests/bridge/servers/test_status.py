"""Counting rows."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.row import RowSchema, RowWriter, read_row
from armlab.bridge.servers.status import Status, Watch
from armlab.errors import UnknownName
from armlab.log import Column, Tick
from armlab.state import Command, State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def test_counts() -> None:
    schema = RowSchema.of([LEFT, RIGHT])
    writer, status = RowWriter(schema), Status(schema)
    for k in range(250):
        q = np.zeros(7)
        state = State(0.004 * k, 0.004, q, q, q, robot="yumi_left", session=2, missed=k == 10)
        clamped = np.array([1, 2, 0, 0, 0, 0, 12], dtype=np.uint8) if k < 3 else None
        tick = Tick(k, k, 10**18, 10**18, 10**18 + 1000 * (100 + k), 0, late=k == 20, drops=4, clamped=clamped)
        data = writer.row(state, None, tick, 4_000_000 * k)
        if k != 100:
            status.add(data)
    found = status.summary()
    assert (found["rows"], found["lost"]) == (249, 1)
    left = found["arms"]["yumi_left"]
    assert left["rate"] == pytest.approx(249.0, rel=0.01)
    assert left["p50"] == pytest.approx(225.0, abs=2.0)
    assert left["longest"] == pytest.approx(349.0)
    assert (left["missed"], left["late"], left["drops"], left["session"]) == (1, 1, 4, 2)
    assert left["clamps"]["position"][0] == left["clamps"]["velocity"][1] == left["clamps"]["braking"][6] == 3
    assert math.isnan(found["arms"]["yumi_right"]["p50"])
    assert found["arms"]["yumi_right"]["rows"] == 0


SCHEMA = RowSchema.of([LEFT, RIGHT])
NOW = 10**18


def row(command: Command | None = None, **fields: Any) -> Any:
    q = np.zeros(7)
    state = State(0.0, 0.004, q, q, q, robot="yumi_left", **{"motors": 1, "rapid": 2, "mci": 3, **fields})
    return read_row(SCHEMA, RowWriter(SCHEMA).row(state, command, Tick(1, 1, NOW, NOW, NOW + 1000, 0), 0, "labcomm a"))


def left(watch: Watch, now: int = NOW) -> dict[str, str]:
    return watch.arms(now)[0]


def test_states_in_words() -> None:
    watch = Watch("yumi_left")
    assert watch.arms(NOW) == []
    for expected, message in {
        "holding": row(),
        "running": row(Command(np.zeros(7))),
        "the motors are off": row(motors=2),
        "guidance has not begun (EGMRunJoint)": row(mci=2),
    }.items():
        watch.take(message)
        assert left(watch)["state"] == expected
    assert left(watch, NOW + 2 * 10**9)["state"] == "no packet for 2.0 s"
    assert left(watch)["commander"] == "labcomm a"
    assert left(watch)["force [N]"] == left(watch)["rate [Hz]"] == "-"


def test_numbers() -> None:
    watch = Watch()
    watch.take(row(wrench=np.arange(6.0)))
    arm = {"rate": 249.94, "p50": 99.6, "p99": 200.0, "longest": None, "missed": 3, "late": 1, "drops": 2}
    clamps = {"position": [0] * 7, "velocity": [0, 5, 0, 0, 0, 0, 0]}
    watch.take({"kind": "status", "rows": 1, "lost": 4, "arms": {"yumi_left": {**arm, "clamps": clamps}}})
    shown = left(watch)
    assert (shown["rate [Hz]"], shown["p50 / p99 / max [us]"]) == ("249.9", "100 / 200 / -")
    assert (shown["force [N]"], shown["moment [N m]"]) == ("0.0 1.0 2.0", "3.00 4.00 5.00")
    assert shown["clamps per joint"] == "velocity 0 5 0 0 0 0 0"
    assert len(watch.arms(NOW)) == 2
    assert watch.lines(NOW)[0].startswith("yumi_left, state holding, rate [Hz] 249.9")


def test_what_there_is_beside_the_arms(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    file.write_bytes(bytes(2_000_000))
    watch = Watch()
    assert watch.notes() == ["Recording: none"]
    watch.take({"kind": "about", "cell": "yumi"})
    watch.take({"kind": "recording", "files": [str(file), str(tmp_path / "none.mcap")]})
    watch.take({"kind": "event", "stamp_ns": NOW, "text": "The robot is ready."})
    watch.take({"kind": "status", "rows": 1, "lost": 4, "arms": {}})
    watch.take({"kind": "parameters", "parameters": []})
    assert (watch.cell, watch.told, watch.lost) == ("yumi", 1, 4)
    recording, lost, event = watch.notes()
    assert "2.0 MB" in recording
    assert recording == f"Recording: {watch.recording()}"
    assert lost == "Rows lost by this feed: 4"
    assert event.endswith("The robot is ready.")
    assert watch.lines(NOW) == ["No rows yet, because no robot packet has arrived."]


def test_files_of_another_computer_and_a_source_with_a_commander(tmp_path: Path) -> None:
    watch = Watch()
    (tmp_path / "file").touch()
    watch.take({"kind": "recording", "files": ["/" + 300 * "x", "a\0b", str(tmp_path / "file" / "a.mcap")]})
    assert watch.recording() == "none"
    schema, q = RowSchema.of([LEFT], {"hand": {"commander": Column(unit="1")}}), np.zeros(7)
    writer = RowWriter(schema)
    watch.take(
        read_row(schema, writer.row(State(0.0, 0.004, q, q, q, robot=LEFT.name), None, Tick(1, 1, NOW, NOW, NOW, 0), 0))
    )
    assert [arm["arm"] for arm in watch.arms(NOW)] == [LEFT.name]


def test_an_arm_that_is_not_there() -> None:
    with pytest.raises(UnknownName, match="yumi_left"):
        Watch("ur5e").take(row())
