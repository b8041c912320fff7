"""``armlab log show`` and ``armlab log recover``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armlab import cli, robots
from armlab.cli.log import log, recover, show
from armlab.log import Recorder, Tick, read
from armlab.state import Command, State


@pytest.fixture
def path(tmp_path: Path) -> Path:
    robot, rng = robots.load("yumi_right"), np.random.default_rng(1)
    with Recorder(tmp_path / "run.mcap", robot, attachments={"model.toml": b"12345"}, note="a test") as recorder:
        for i in range(300):
            q, qd, tau = rng.normal(size=(3, 7))
            tau = np.full(7, np.nan) if i < 4 else tau
            state = State(i * 0.004, 0.004, q, qd, tau, seq=i, robot_ns=10**18 + i * 4_000_000)
            stamp = 1_700_000_000_000_000_000 + i * 4_000_000
            recorder.row(state, Command(q), Tick(i, i, stamp, stamp, stamp + 1000, 10, q_sent=q))
        recorder.event("the operator pressed", stamp)
    return recorder.path


def test_the_history_of_the_parameters(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["log", "show", "--parameters", str(path)]) == 0
    assert capsys.readouterr().out == "This log has no parameters.\n"
    with Recorder(tmp_path / "set.mcap", robots.load("yumi_right")) as recorder:
        start = 1_700_000_000_000_000_000
        recorder.parameter(0, "gain", 2.0, "in force at the start", start)
        recorder.parameter(1, "gain", 3.0, "local 1", start + 2)
        recorder.event("A setting of local 1 was refused: too large.", start + 1)
        recorder.event("Something else.", start)
        recorder.close({"parameters": {"gain": 3.0}})
    assert cli.main(["log", "show", "--parameters", str(recorder.path)]) == 0
    first, second, third, last = capsys.readouterr().out.splitlines()
    assert first == "2023-11-14 22:13:20.000000 UTC  gain = 2.0, in force at the start"
    assert second.endswith("A setting of local 1 was refused: too large.")
    assert third.endswith("gain = 3.0, set by local 1 (1)")
    assert last == "At the end: gain = 3.0."


def test_show_says_what_the_log_holds(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["log", "show", str(path)]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    text = captured.out
    for words in (
        "finished, began 2023-11-14 22:13:20 UTC",
        "300 rows, 1.196 s at 250 Hz on the robot clock",
        "robot       yumi_right",
        "note        a test",
        "the operator pressed",
        "model.toml",
    ):
        assert words in text, words
    (line,) = [line for line in text.splitlines() if line.startswith("tau ")]
    table = read(path)
    low, high = f"{np.nanmin(table['tau']):.6g}", f"{np.nanmax(table['tau']):.6g}"
    assert line.split() == ["tau", "7", "N", "m", "joint", "4", low, high]


def test_json_for_scripts(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show(path, json=True)
    data = json.loads(capsys.readouterr().out)
    table = read(path)
    assert (data["rows"], data["finished"], data["sha256"]) == (300, True, table.sha256)
    assert data["columns"]["tau"]["missing"] == 4
    assert data["columns"]["tau"]["unit"] == "N m"
    assert data["columns"]["q"]["min"] == pytest.approx(table["q"].min(axis=0))
    assert data["metadata"]["armlab"]["robot"] == "yumi_right"
    assert data["events"][-1]["text"] == "the operator pressed"
    assert data["summary"]["rows"] == 300
    assert {"name": "/yumi_right/tick", "type": "armlab_msgs/msg/Tick", "messages": 300} in data["topics"]


def test_a_torn_log_is_shown_and_repaired(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[: int(0.8 * path.stat().st_size)])
    show(torn)
    text = capsys.readouterr().out
    assert "not finished" in text
    assert "note: torn.mcap was not finished: recovered 250 rows" in text
    recover(torn)
    captured = capsys.readouterr()
    assert captured.out == f"{tmp_path / 'torn.recovered.mcap'}\n"
    assert "bytes at the end" in captured.err
    assert len(read(tmp_path / "torn.recovered.mcap")) == 250
    assert log.name == ("log",)


def test_wrong_files_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("hello")
    for file, words in ((tmp_path / "none.mcap", "No such file"), (text, "format text"), (tmp_path, "Is a directory")):
        assert cli.main(["log", "show", str(file)]) == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert words in captured.err
    assert cli.main(["log", "show"]) == 2
