"""armlab dmp: a primitive from a log, played on the simulated arm."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armlab import kinematics, log, robots
from armlab.cli import main
from armlab.cli.dmp import dmp, fit, play
from armlab.log import Table
from armlab.motion import Dmp, PoseDmp, profiles


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of rest, a motion of a second, and rest."""
    q0 = robots.load("yumi_left").q_home
    motion = profiles.minimum_jerk(q0, q0 + np.deg2rad([10, -5, 8, -10, 5, 5, 20]), 1.0)
    t = np.arange(0, 2.5, 0.004)
    q, qd, _ = motion.at(t - 0.5)
    path = tmp_path_factory.mktemp("taught") / "taught.csv"
    return log.write(Table(t, {"q": q, "qd": qd}), path)


@pytest.fixture(scope="module")
def primitive(taught: Path) -> Path:
    path = taught.with_name("motion.toml")
    assert main(["dmp", "fit", str(taught), "-o", str(path)]) == 0
    return path


def test_a_motion_is_fitted_without_the_rest_around_it(taught: Path, primitive: Path, tmp_path: Path, capsys) -> None:
    value = Dmp.load(primitive)
    assert value.n == 7
    assert 0.9 < value.duration < 1.25
    assert main(["dmp", "fit", str(taught), str(taught), "-o", str(tmp_path / "two.toml"), "--whole", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["duration"] == pytest.approx(2.496)
    assert max(said["rms"]) < 1e-3
    assert "sha256" in primitive.read_text()


def test_what_was_fitted_is_told(taught: Path, tmp_path: Path, capsys) -> None:
    words = ["dmp", "fit", str(taught), "-o", str(tmp_path / "m.toml"), "--start", "0.4", "--end", "1.6"]
    assert main([*words, "--basis", "20"]) == 0
    said = capsys.readouterr().out
    assert "1 demonstration with" in said
    assert "20 kernels" in said
    assert "RMS" in said


def test_the_motion_is_written_to_a_file(primitive: Path, tmp_path: Path, capsys) -> None:
    path, words = tmp_path / "motion.csv", ["dmp", "play", str(primitive), "--json", "-o"]
    goal = Dmp.load(primitive).g + 0.01
    assert main([*words, str(path), "--duration", "2", "--goal", ",".join(map(str, goal))]) == 0
    assert json.loads(capsys.readouterr().out)["seconds"] == pytest.approx(2.0, abs=0.004)
    table = log.read(path)
    np.testing.assert_allclose(table["y"][-1], goal, rtol=0, atol=1e-3)
    assert main([*words, str(path)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main([*words, str(path), "--force", "--robot", "yumi_left", "--speed", "0.1"]) == 0
    table, robot = log.read(path), robots.load("yumi_left")
    assert np.abs(table["qd"]).max() <= 0.1 * robot.qd_max.max() * (1 + 1e-9)
    np.testing.assert_allclose(table["q"][-1], goal - 0.01, rtol=0, atol=2e-3)


@pytest.mark.slow  # 3 s
def test_it_is_played_on_the_simulated_arm(primitive: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["dmp", "play", str(primitive), "--robot", "yumi_left", "--link", "sim://yumi_left?lockstep=true", "--json"]
    assert main([*words, "--log", "first.mcap"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["goal_error"] < 0.01
    assert said["reason"] == "arrived"
    table = log.read(said["log"])
    np.testing.assert_allclose(table["q"][0], Dmp.load(primitive).y0, atol=0.01)


@pytest.mark.slow  # 3 s
def test_poses_are_played_on_the_simulated_arm(taught: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    """Over EGM, by inverse kinematics, from and to where the tool was shown."""
    monkeypatch.chdir(tmp_path)
    assert main(["dmp", "fit", str(taught), "-o", "pose.toml", "--kind", "pose", "--robot", "yumi_left"]) == 0
    words = ["dmp", "play", "pose.toml", "--robot", "yumi_left", "--link", "sim://yumi_left?lockstep=true"]
    assert main([*words, "--log", "pose.mcap"]) == 0
    assert "of motion, ended" in capsys.readouterr().out
    tool = kinematics.forward(robots.load("yumi_left"), log.read("pose.mcap")["q"][[0, -1]])
    shown = PoseDmp.load("pose.toml")
    np.testing.assert_allclose(tool, [shown.T_start, shown.T_goal], rtol=0, atol=0.01)


def test_what_cannot_be_is_refused_before_anything_moves(taught: Path, primitive: Path, tmp_path: Path, capsys) -> None:
    new, play_it = ("-o", str(tmp_path / "x.toml")), ("play", str(primitive))
    for words, sentence in {
        ("fit", *new): "log of a motion",
        ("fit", str(taught), "-o", str(tmp_path / "x.csv")): ".toml",
        ("fit", str(taught), "-o", str(primitive)): "--force",
        ("fit", str(taught), *new, "--column", "speed"): "speed",
        ("fit", str(taught), *new, "--end", "0.2"): "rest",
        ("fit", str(taught), *new, "--period", "2"): "--kind periodic",
        ("fit", str(taught), *new, "--kind", "pose"): "--robot",
        play_it: "--robot NAME",
        (*play_it, "--robot", "ur5e"): "6 joints",
        (*play_it, "--robot", "yumi_left", "--goal", ",".join("9" * 7)): "within the limits",
        (*play_it, "--robot", "yumi_left", "--goal", "-9,0,0,0,0,0,0"): "got -9 for joint 1",
        (*play_it, "--robot", "yumi_left", "--duration", "-1"): "duration [s] above zero",
        (*play_it, "-o", str(tmp_path / "x.csv"), "--goal", "here"): "numbers with commas",
        ("play", str(tmp_path / "none.toml"), "-o", str(tmp_path / "x.csv")): "none.toml",
        ("play", str(taught), "-o", str(tmp_path / "x.csv")): "TOML",
    }.items():
        assert main(["dmp", *words]) == 2
        assert sentence in capsys.readouterr().err
    assert main(["dmp", "fit", str(taught)]) == 2
    assert not (tmp_path / "x.csv").exists()
    assert dmp.name == ("dmp",)
    assert fit.__doc__
    assert play.__doc__


@pytest.mark.slow  # 1 s
def test_a_motion_whose_last_command_was_refused_fails(primitive: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("armlab.bridge.control.state_machine.entry_refusal", lambda *_: "Expected nearer.")
    words = ["dmp", "play", str(primitive), "--robot", "yumi_left", "--link", "sim://yumi_left?lockstep=true"]
    assert main([*words, "--log", "refused.mcap"]) == 1
    assert "The last command to yumi_left was refused. Expected nearer." in capsys.readouterr().err
