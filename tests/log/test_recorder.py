"""`Recorder`: complete, never overwriting, never raising in the loop."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError, ShapeError, UnknownName
from armlab.log import Column, Recorder, inspect, read
from armlab.robots import Robot
from armlab.state import Command


def event_texts(path: Path) -> list[str]:
    return [event.text for event in inspect(path).events]


def test_metadata_attachments_and_summary(recording: Callable[..., Path], robot: Robot) -> None:
    held = inspect(recording(25))
    about = held.metadata["armlab"]
    assert (about["robot"], about["robot_hash"], about["note"]) == (robot.name, robot.hash, "test")
    assert about["version"]
    assert about["python"] == ".".join(map(str, sys.version_info[:3]))
    assert held.attachments["robot.toml"] == b"name = 'x'"
    assert held.summary == {"rows": 25, "dropped": 0, "holes": []}
    assert held.finished


def test_secrets_on_the_command_line_are_not_written(
    tmp_path: Path, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["armlab", "run", "--token", "abc123", "--api-key=xyz", "--seed", "3"])
    with Recorder(tmp_path / "run.mcap", robot) as recorder:
        pass
    assert inspect(recorder.path).metadata["armlab"]["command"] == "armlab run --token *** --api-key=*** --seed 3"


def test_an_existing_file_is_never_overwritten(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    paths = []
    for count in (1, 2, 3):
        with Recorder(tmp_path / "logs" / "run.mcap", robot) as recorder:
            for i in range(count):
                recorder.row(*rows(i))
        paths.append(recorder.path)
    assert [path.name for path in paths] == ["run.mcap", "run-2.mcap", "run-3.mcap"]
    assert [len(read(path)) for path in paths] == [1, 2, 3]


def test_a_folder_that_cannot_be_written_is_an_error_at_once(tmp_path: Path, robot: Robot) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="Expected to create the log"):
        Recorder(tmp_path / "file" / "run.mcap", robot)


def test_declared_columns_are_checked_at_once(tmp_path: Path, robot: Robot) -> None:
    for extra, message in (
        ({"mine": Column(shape=(3,))}, "unit"),
        ({"q": Column(shape=(7,))}, "new names"),
        ({"word": Column(unit="1", kind="text")}, "text"),
        ({"mine": Column(unit="1", kind="odd")}, "kind"),
    ):
        with pytest.raises((ShapeError, UnknownName), match=message):
            Recorder(tmp_path / "run.mcap", robot, extra=extra)
    assert not list(tmp_path.iterdir())


def test_row_never_raises_and_says_what_it_did_not_write(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    with Recorder(tmp_path / "run.mcap", robot) as recorder:
        state, _, tick = rows(0)
        assert recorder.row(state, Command(record={"undeclared": 1.0}), tick)
        assert not recorder.row(state, Command(q=np.zeros(6)), rows(1)[2])
        assert not recorder.row(state, Command(record={"wrench_hat": "force"}), rows(2)[2])
        assert not recorder.row(None, None, rows(3)[2])  # type: ignore[arg-type]
        assert recorder.row(rows(4)[0], Command(record={"undeclared": 1.0}), rows(4)[2])
        assert (recorder.rows, recorder.dropped) == (2, 3)
    texts = event_texts(recorder.path)
    assert len([text for text in texts if "undeclared" in text]) == 1
    assert any("Expected 7 values in q_ref, got 6." in text for text in texts)
    assert any("3 rows were dropped, ticks 1 to 3" in text for text in texts)
    assert len(read(recorder.path)) == 2


def test_text_that_is_no_utf8_does_not_end_the_recording(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    half = "caf\udce9"  # as Python reads the name of a file in Latin-1, and "\\udce9" in JSON
    monkeypatch.setattr(sys, "argv", ["armlab", "run", "--log", half])
    with Recorder(tmp_path / "run.mcap", robot, note=half, attachments={half: b"data"}) as recorder:
        state, command, tick = rows(0)
        assert recorder.row(state, replace(command, record={half: 1, 5: 2}), tick)
        recorder.event(f"{half} was refused", tick.stamp_ns)
        recorder.parameter(1, half, half, half, tick.stamp_ns)
        assert recorder.row(*rows(1))
    assert (recorder.failed, recorder.rows, recorder.dropped) == (None, 2, 0)
    held = inspect(recorder.path)
    assert len(read(recorder.path)) == 2
    assert held.metadata["armlab"]["command"] == r"armlab run --log caf\udce9"
    assert held.attachments[r"caf\udce9"] == b"data"
    assert [event.text for event in held.events][1:3] == [
        r"not written, as not declared with extra=: 5, caf\udce9",
        r"caf\udce9 was refused",
    ]


def test_values_are_copied_before_the_caller_can_change_them(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    q_ref = np.zeros(7)
    with Recorder(tmp_path / "run.mcap", robot) as recorder:
        for i in range(200):
            q_ref[:] = i
            state, _, tick = rows(i)
            recorder.row(state, Command(q_ref), tick)
        q_ref[:] = -1.0
    assert np.array_equal(read(recorder.path)["q_ref"][:, 0], np.arange(200))


def test_complaints_that_are_always_new_do_not_fill_the_disk(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    with Recorder(tmp_path / "run.mcap", robot) as recorder:
        state, _, tick = rows(0)
        for i in range(300):
            assert not recorder.row(state, Command(q=f"up {i}"), tick)  # type: ignore[arg-type]
    texts = event_texts(recorder.path)
    assert len([text for text in texts if "row not written" in text]) == 100
    assert any("300 rows were dropped" in text for text in texts)
