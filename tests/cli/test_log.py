"""``armlab log`` and its verbs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import cli, robots
from armlab.log import Recorder, Table, Tick, inspect, read, write
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


def test_a_log_cut_off_before_its_first_message_says_what_recover_says(path: Path, tmp_path: Path, command) -> None:
    tiny = tmp_path / "tiny.mcap"
    tiny.write_bytes(path.read_bytes()[:2000])
    for words in (["show"], ["show", "--json"], ["show", "--parameters"], ["recover"]):
        said = command(["log", *words, tiny], 1)
        assert said.out == ""
        assert f"Expected messages in {tiny}, got no readable message in 2000 bytes." in said.err


def test_show_says_what_the_log_holds(path: Path, command) -> None:
    captured = command(["log", "show", path])
    assert captured.err == ""
    text = captured.out
    assert "finished, began 2023-11-14 22:13:20 UTC" in text
    assert "300 rows, 1.196 s at 250 Hz on the robot clock" in text
    for words in ("robot       yumi_right", "note        a test", "the operator pressed", "model.toml"):
        assert words in text, words
    (line,) = [line for line in text.splitlines() if line.startswith("tau ")]
    table = read(path)
    low, high = f"{np.nanmin(table['tau']):.6g}", f"{np.nanmax(table['tau']):.6g}"
    assert line.split() == ["tau", "7", "N", "m", "joint", "4", low, high]


def test_a_torn_log_is_shown_and_repaired(path: Path, tmp_path: Path, command) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[: int(0.8 * path.stat().st_size)])
    text = command(["log", "show", torn]).out
    assert "not finished" in text
    assert "note: torn.mcap was not finished: recovered 250 rows" in text
    said = command(["log", "recover", torn])
    assert said.out == f"{tmp_path / 'torn.recovered.mcap'}\n"
    assert "bytes at the end" in said.err
    assert len(read(tmp_path / "torn.recovered.mcap")) == 250


def test_a_recording_is_of_the_robot_that_it_describes(
    tmp_path: Path, command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    irb120 = robots.load("irb120")
    mine = replace(irb120, name="mine", q_home=irb120.q_home + 0.1)
    robots.save(mine, "mine.toml")
    write(Table(np.arange(3.0), {"q": np.zeros((3, 6))}), "run.mcap", mine)
    for words in ([], ["--robot", "mine"], ["--robot", "mine.toml"]):
        assert cli.main(["log", "export", "run.mcap", "copy.mcap", "--force", *words]) == 0
        held = inspect("copy.mcap")
        assert robots.from_toml(held.attachments["robot.toml"].decode(), "it") == mine
    assert "Known: mine." in command(["log", "export", "run.mcap", "copy.mcap", "--force", "--robot", "irb120"], 2).err
    assert cli.main(["log", "export", "run.mcap", "run.csv"]) == 0
    assert "Expected a robot for the table" in command(["log", "export", "run.csv", "copy.mcap", "--force"], 2).err


def test_the_original_stays(path: Path, tmp_path: Path, command) -> None:
    (tmp_path / "same.mcap").symlink_to(path)
    whole = path.read_bytes()
    for words in (["export", str(path)], ["cut", str(path), "--to", "0.1", "-o"], ["merge", str(path), "b.mcap", "-o"]):
        for output in (path, tmp_path / "same.mcap"):
            assert "which is or contains the input" in command(["log", *words, output, "--force"], 2).err
    assert path.read_bytes() == whole


@pytest.mark.parametrize("ending", [".csv", ".mat", ".rosbag2"])
def test_export_and_back(path: Path, tmp_path: Path, command, ending: str) -> None:
    output = tmp_path / f"run{ending}"
    captured = command(["log", "export", path, output])
    assert captured.out == f"{output}\n"
    assert captured.err == f"export: reading run.mcap\nexport: writing run{ending}\n"
    table, again = read(path), read(output)
    assert again.sha256 == table.sha256
    assert again.source[1:] == table.source
    assert "already exists. Choose another name or add --force." in command(["log", "export", path, output], 2).err
    assert cli.main(["log", "export", str(path), str(output), "--force"]) == 0
    back = tmp_path / "back.mcap"
    assert cli.main(["log", "export", str(output), str(back), "--robot", "yumi_right"]) == 0
    np.testing.assert_array_equal(read(back)["q"], table["q"])
    text = command(["log", "show", output]).out
    for words in ("began 2023-11-14 22:13:20 UTC", "300 rows, 1.196 s at 250 Hz", "source: run.mcap sha256", "tau  "):
        assert words in text, words
    data = json.loads(command(["log", "show", output, "--json"]).out)
    assert (data["rows"], data["sha256"]) == (300, table.sha256)
    assert data["format"] == {".csv": "text", ".mat": "MAT v5", ".rosbag2": "rosbag2"}[ending]
    assert command(["log", "show", output, "--parameters"]).out == "This log has no parameters.\n"


def test_export_names_what_matlab_calls_otherwise(tmp_path: Path, command) -> None:
    (tmp_path / "orca.csv").write_text("t [s],robot[0].pos\n0,1\n1,2\n")
    said = command(["log", "export", tmp_path / "orca.csv", tmp_path / "orca.mat"]).err
    assert "robot[0].pos to robot_0__pos." in said


def test_of_a_recording_without_rows_the_first_events_are_shown(tmp_path: Path, command) -> None:
    with Recorder(tmp_path / "run.mcap", robots.load("yumi_right")) as recorder:
        for i in range(30):
            recorder.event(f"event {i}", 10**18)
    text = command(["log", "show", recorder.path]).out
    assert "began -" in text
    assert "event 18" in text
    assert "event 19" not in text
    assert text.rstrip().endswith("and 11 more (--json shows all)")


def test_cut_and_merge(path: Path, tmp_path: Path, command) -> None:
    table = read(path)
    first, rest, whole = (str(tmp_path / name) for name in ("first.mcap", "rest.mcap", "whole.mcap"))
    assert cli.main(["log", "cut", str(path), "--to", "0.5", "-o", first]) == 0
    assert cli.main(["log", "cut", str(path), "--from", "0.5", "-o", rest]) == 0
    captured = command(["log", "merge", rest, first, "-o", whole])
    assert captured.out == f"{first}\n{rest}\n{whole}\n"
    assert captured.err == "cut: copied\ncut: copied\nmerge: copied\n"
    assert read(first).sha256 == table.between(-np.inf, 0.5).sha256
    assert read(whole).sha256 == table.sha256
    assert "add --force" in command(["log", "cut", path, "--to", "0.5", "-o", first], 2).err
    assert cli.main(["log", "cut", str(path), "--to", "0.1", "-o", first, "--force"]) == 0
    assert read(first).sha256 == table.between(-np.inf, 0.1).sha256
    csv, part = str(tmp_path / "run.csv"), str(tmp_path / "part.csv")
    assert cli.main(["log", "export", str(path), csv]) == 0
    assert cli.main(["log", "cut", csv, "--from", "0.2", "--to", "0.3", "-o", part]) == 0
    assert read(part).sha256 == table.between(0.2, 0.3).sha256


def test_resample_makes_the_rate_even_and_leaves_gaps_missing(path: Path, tmp_path: Path, command) -> None:
    table = read(path)
    gappy = write(table.rows(np.r_[0:100, 101:150, 200:300]), tmp_path / "gappy.mcap", robots.load("yumi_right"))
    said = command(["log", "resample", gappy, "--rate", 250, "-o", tmp_path / "even.mcap"])
    even = read(tmp_path / "even.mcap")
    assert np.ptp(np.diff(even.t)) < 1e-8
    assert f"249 rows resampled to {len(even)}" in said.err
    assert len(even) == len(table)
    np.testing.assert_allclose(even["q"][[10, 120]], table["q"][[10, 120]], atol=1e-6)
    np.testing.assert_allclose(even["q"][100], table["q"][[99, 101]].mean(axis=0), atol=1e-6)
    assert np.isnan(even["q"][175]).all()
    slow = ["log", "resample", path, "--rate", 10, "-o", tmp_path / "slow.csv"]
    assert "Expected a rate of at least 250" in command(slow, 1).err


def test_the_name_of_a_cell_stands_for_the_files_of_its_arms(tmp_path: Path, path: Path, command) -> None:
    table = read(path).select("q", "tau")
    for side in ("left", "right"):
        write(table, tmp_path / f"cell{side}.mcap", robots.load(f"yumi_{side}"))
    write(table, tmp_path / "cellar.mcap", robots.load("yumi_left"))
    said = command(["log", "show", tmp_path / "cell.mcap"]).out
    assert [f"cell{end}.mcap" in said for end in ("left", "right", "ar")] == [True, True, False]
    shown = json.loads(command(["log", "show", tmp_path / "cell.mcap", "--json"]).out)
    assert [one["metadata"]["armlab"]["robot"] for one in shown] == ["yumi_left", "yumi_right"]


def test_open_calls_an_installed_program(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    said = command(["log", "open", path], 1).err
    assert "Expected Foxglove, PlotJuggler or Rerun on the PATH, got none of these programs" in said
    assert "Install it: Foxglove: download the desktop program" in said
    for name in ("plotjuggler", "rerun"):
        program = tmp_path / name
        program.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/called\nexit {int(name == "rerun")}\n')
        program.chmod(0o755)
    assert "in PlotJuggler" in command(["log", "open", path]).err
    assert (tmp_path / "called").read_text() == f"-d {path}\n"
    command(["log", "open", path, "--rerun"], 1)
    assert (tmp_path / "called").read_text() == f"--bind 127.0.0.1 {path}\n"
    said = command(["log", "open", path, "--foxglove"], 1).err
    assert "Expected Foxglove on the PATH, got PlotJuggler, Rerun. Install it: Foxglove" in said
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[:-30])
    assert f"armlab log recover {torn}" in command(["log", "open", torn], 1).err


def test_a_bag_of_another_program(ur5e_bag: Path, tmp_path: Path, command) -> None:
    said = command(["log", "show", ur5e_bag])
    assert said.err == ""
    assert "/JointState: Table of 5 rows, 4.000 s at 1 Hz" in said.out
    assert "/Float64: Table of 5 rows, 0.400 s at 10 Hz" in said.out
    assert json.loads(command(["log", "show", "--json", ur5e_bag]).out)["tables"]["/Float64"]["rows"] == 5
    words = ["log", "export", ur5e_bag, tmp_path / "run.csv"]
    said = command(words, 1).err
    assert "Expected topics with the same rate" in said
    assert "/JointState 1 Hz" in said
    command([*words, "--robot", "ur5e", "--clock", "/JointState"])
    table = read(tmp_path / "run.csv")
    assert table.columns["q"].labels == robots.load("ur5e").joint_names
    np.testing.assert_array_equal(table["q"][0], np.arange(6.0))


def names_in(bag: Path) -> set[tuple[str, ...]]:
    from rosbags.highlevel import AnyReader

    with AnyReader([bag]) as reader:
        states = [one for one in reader.connections if one.topic == "/joint_states"]
        messages: list[Any] = [reader.deserialize(raw, one.msgtype) for one, _, raw in reader.messages(states)]
    return {tuple(message.name) for message in messages}


@pytest.mark.slow
def test_a_bag_has_the_joint_names_of_the_robot(path: Path, tmp_path: Path, command) -> None:
    csv, bag = tmp_path / "run.csv", tmp_path / "run.rosbag2"
    of_urdf = {tuple(f"yumi_robr_joint_{k}" for k in range(1, 8))}
    command(["log", "export", path, csv])
    for words, names in (
        (["export", path, bag], of_urdf),
        (["cut", path, "--to", "0.1", "-o", bag], of_urdf),
        (["export", csv, bag], {robots.load("yumi_right").joint_names}),
        (["export", csv, bag, "--robot", "yumi_right"], of_urdf),
    ):
        command(["log", *words, "--force"])
        assert names_in(bag) == names
        assert read(bag).columns["q"].labels == read(path).columns["q"].labels, "our own reader gives the same table"
    said = command(["log", "export", csv, bag, "--robot", "irb120", "--force"], 1).err
    assert "(300, 6) for robot 'irb120' with 6 joints, got (300, 7). Pass the robot" in said
    assert names_in(bag) == of_urdf, "the earlier bag is kept"


def test_both_arms_in_one_file(path: Path, tmp_path: Path, command) -> None:
    with Recorder(tmp_path / "left.mcap", robots.load("yumi_left")) as recorder:
        for i in range(20):
            stamp = 1_700_000_000_000_000_000 + i * 4_000_000
            state = State(i * 0.004, 0.004, np.full(7, i), np.zeros(7), np.zeros(7), seq=i, robot_ns=stamp)
            recorder.row(state, None, Tick(i, i, stamp, stamp, stamp, 10))
    both, left = tmp_path / "both.mcap", read(recorder.path)
    command(["log", "merge", path, recorder.path, "-o", both])
    text = command(["log", "show", both]).out
    for words in ("yumi_right: Table of 300 rows", "yumi_left: Table of 20 rows", "robot       yumi_left", "pressed"):
        assert words in text
    told = json.loads(command(["log", "show", both, "--json"]).out)["robots"]
    assert {name: data["rows"] for name, data in told.items()} == {"yumi_right": 300, "yumi_left": 20}
    assert "--robot" in command(["log", "cut", both, "--to", "0.04", "-o", tmp_path / "which.csv"], 1).err
    command(["log", "export", both, tmp_path / "left.csv", "--robot", "yumi_left"])
    assert read(tmp_path / "left.csv").sha256 == left.sha256
    parts = ((both, "part.csv", 0.04), (both, "part.mcap", 0.04), (both, "whole.mcap", np.inf))
    for source, name, end in (*parts, (tmp_path / "left.csv", "new.mcap", 0.04)):
        until = [] if end == np.inf else ["--to", end]
        command(["log", "cut", source, *until, "--robot", "yumi_left", "-o", tmp_path / name])
        assert read(tmp_path / name).sha256 == left.between(-np.inf, end).sha256


def test_the_history_of_the_parameters(path: Path, tmp_path: Path, command) -> None:
    assert command(["log", "show", "--parameters", path]).out == "This log has no parameters.\n"
    start = 1_700_000_000_000_000_000
    with Recorder(tmp_path / "set.mcap", robots.load("yumi_right")) as recorder:
        recorder.parameter(0, "gain", 2.0, "in effect at the start", start)
        recorder.parameter(1, "gain", 3.0, "local 1", start + 2)
        recorder.event("A setting of local 1 was refused: too large.", start + 1)
        recorder.event("Something else.", start)
        recorder.close({"parameters": {"gain": 3.0}})
    first, second, third, last = command(["log", "show", "--parameters", recorder.path]).out.splitlines()
    assert first == "2023-11-14 22:13:20.000000 UTC  gain = 2.0, in effect at the start"
    assert second.endswith("A setting of local 1 was refused: too large.")
    assert third.endswith("gain = 3.0, set by local 1 (1)")
    assert last == "At the end: gain = 3.0."
    told = json.loads(command(["log", "show", "--parameters", "--json", recorder.path]).out)
    history = [(one["value"], one["who"]) for one in told["parameters"]]
    assert history == [(2.0, "in effect at the start"), (3.0, "local 1")]
    assert told["parameters_at_end"] == {"gain": 3.0}
    assert told.items() <= json.loads(command(["log", "show", "--json", recorder.path]).out).items()
