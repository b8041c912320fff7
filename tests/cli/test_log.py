"""``armlab log show``, ``armlab log export`` and ``armlab log recover``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armlab import cli, robots
from armlab.cli.log import export, log, recover, show
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
    for file, words in (
        (tmp_path / "none.mcap", "No such file"),
        (text, "a header and rows of numbers"),
        (tmp_path, "Is a directory"),
    ):
        assert cli.main(["log", "show", str(file)]) == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert words in captured.err
    assert cli.main(["log", "show"]) == 2


@pytest.mark.parametrize("ending", [".csv", ".mat", ".parquet", ".h5", ".rosbag2"])
def test_export_and_back(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], ending: str) -> None:
    output = tmp_path / f"run{ending}"
    assert cli.main(["log", "export", str(path), str(output)]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{output}\n"
    assert captured.err == f"export: reading run.mcap\nexport: writing run{ending}\n"
    table, again = read(path), read(output)
    assert again.sha256 == table.sha256
    assert again.source[1:] == table.source
    assert cli.main(["log", "export", str(path), str(output)]) == 1
    assert "which exists. Choose another name or add --force." in capsys.readouterr().err
    assert cli.main(["log", "export", str(path), str(output), "--force"]) == 0
    back = tmp_path / "back.mcap"
    assert cli.main(["log", "export", str(output), str(back), "--robot", "yumi_right"]) == 0
    np.testing.assert_array_equal(read(back)["q"], table["q"])


def test_export_refuses_in_one_sentence(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "kept.csv.toml").write_text("mine")
    for output, words in (
        ("run.xls", "ends in .mcap or .csv or .mat"),
        ("none/run.csv", "Make the folder first"),
        ("kept.csv", "kept.csv.toml, which exists"),
        ("other.mcap", "the robot of the table"),
    ):
        assert cli.main(["log", "export", str(path), str(tmp_path / output)]) == 1
        assert words in capsys.readouterr().err.splitlines()[-1]
    assert cli.main(["log", "export", str(path), str(tmp_path / "run.rosbag2"), "--storage", "zip"]) == 2
    assert cli.main(["log", "export", str(path)]) == 2
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["kept.csv.toml", "run.mcap"]
    assert export.__doc__


def test_export_names_what_matlab_calls_otherwise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "orca.csv").write_text("t [s],robot[0].pos\n0,1\n1,2\n")
    assert cli.main(["log", "export", str(tmp_path / "orca.csv"), str(tmp_path / "orca.mat")]) == 0
    assert "robot[0].pos is robot_0__pos." in capsys.readouterr().err


@pytest.mark.parametrize("ending", [".csv", ".h5", ".rosbag2"])
def test_show_of_other_formats(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], ending: str) -> None:
    output = tmp_path / f"run{ending}"
    assert cli.main(["log", "export", str(path), str(output)]) == 0
    capsys.readouterr()
    assert cli.main(["log", "show", str(output)]) == 0
    text = capsys.readouterr().out
    for words in ("began 2023-11-14 22:13:20 UTC", "300 rows, 1.196 s at 250 Hz", "source: run.mcap sha256", "tau  "):
        assert words in text, words
    assert cli.main(["log", "show", str(output), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert (data["rows"], data["sha256"]) == (300, read(path).sha256)
    assert data["format"] == {".csv": "text", ".h5": "HDF5", ".rosbag2": "rosbag2"}[ending]
    assert cli.main(["log", "show", str(output), "--parameters"]) == 0
    assert capsys.readouterr().out == "This log has no parameters.\n"
