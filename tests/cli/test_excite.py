"""armlab excite: a motion within the limits, its predicted precision, and a log of it."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from armlab import identify, log, robots
from armlab.cli import main
from armlab.state import Command


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.cli.excite.ROUNDS", 3)


def columns(path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    return dict(zip(head, np.array(rows, dtype=float).T, strict=True))


@pytest.mark.slow
def test_the_motion_is_written_and_what_it_tells_is_printed(tmp_path, command) -> None:
    path, figure = tmp_path / "motion.csv", tmp_path / "motion.png"
    words = ["excite", "yumi_left", "-o", str(path), "--seconds", "10", "--seed", "3", "--figure", str(figure)]
    said = command(words)
    assert "first moments" in said.out
    assert "Coulomb" in said.out
    assert "excitation " in said.out
    for step in ("evaluating candidates", "refining the best candidate", "predicting parameter precision"):
        assert f"design: {step}" in said.err
    found = columns(path)
    robot = robots.load("yumi_left")
    assert found["t [s]"][:2].tolist() == [0.0, 0.004]
    assert found["t [s]"][-1] == 10.0
    for i in range(7):
        q, qd, qdd = (
            found[f"{name}{i + 1} [{unit}]"] for name, unit in (("q", "rad"), ("qd", "rad/s"), ("qdd", "rad/s^2"))
        )
        assert robot.q_min[i] <= q.min() < q.max() <= robot.q_max[i]
        assert np.abs(qd).max() <= 0.6 * robot.qd_max[i] * 1.001
        assert (qd[0], qd[-1]) == (0.0, 0.0)
        assert np.gradient(q, 0.004)[5:-5] == pytest.approx(qd[5:-5], abs=2e-3)
        assert np.gradient(qd, 0.004)[5:-5] == pytest.approx(qdd[5:-5], abs=0.1)
    assert figure.read_bytes().startswith(b"\x89PNG")
    again = tmp_path / "again.csv"
    assert command(["excite", "yumi_left", "--saved", path, "-o", again]).out == said.out
    for name, values in columns(again).items():
        assert values == pytest.approx(found[name], abs=1e-3 if "s^2" in name else 1e-6), name


def test_one_joint_at_constant_speeds(tmp_path, monkeypatch, command) -> None:
    asked: list[int | str] = []
    with monkeypatch.context() as patch:  # the real motion lasts for minutes and is slow to write
        short = identify.dither(robots.load("yumi_left").q_home, 2.0)
        patch.setattr("armlab.identify.friction_run", lambda robot, joint: asked.append(joint) or short)
        for joint in ("3", "axis_4"):
            words = ["excite", "yumi_left", "--joint", joint, "-o", str(tmp_path / "friction.csv"), "--force"]
            assert "2.0 s of motion" in command(words).out
    assert asked == [2, "axis_4"]
    for wrong, said in (("0", "from 1 to 7"), ("8", "from 1 to 7"), ("elbow", "joint")):
        assert said in command(["excite", "yumi_left", "--joint", wrong, "-o", tmp_path / "none.csv"], 2).err
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["friction.csv", "friction.csv.toml"]


def test_a_motion_is_within_the_setting_of_speed_unless_asked_for(tmp_path, monkeypatch, command) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ARMLAB_SPEED", "0.2")
    said = json.loads(command(["excite", "yumi_left", "--seconds", "10", "-o", "slow.csv", "--json"]).out)
    assert (said["speed"], said["seconds"]) == (0.2, 10)
    assert all(parameter["sd"] > 0 for parameter in said["parameters"])
    limit = robots.load("yumi_left").qd_max
    assert np.max(np.abs(log.read("slow.csv")["qd"]) / limit) < 0.2005  # exceeded slightly between design samples
    assert main(["excite", "yumi_left", "--seconds", "10", "-o", "fast.csv", "--speed", "0.5"]) == 0
    assert np.max(np.abs(log.read("fast.csv")["qd"]) / limit) > 0.2
    said = command(["excite", "yumi_left", "--saved", "fast.csv", "--run", "sim://yumi_left"], 2).err
    assert "within 0.2 of the speed limits" in said


def test_a_saved_motion_beyond_the_limits_is_refused_before_the_robot_moves(tmp_path, monkeypatch, command) -> None:
    monkeypatch.chdir(tmp_path)
    robot = robots.load("yumi_left")
    table = identify.dither(robot.q_home, 2.0).table()
    q = table["q"].copy()
    q[100, 3] = 57.3
    log.write(log.Table(table.t, {"q": q, "qd": table["qd"]}), "far.csv")
    words = ["excite", "yumi_left", "--saved", "far.csv", "--run", "sim://yumi_left?lockstep=true"]
    said = command(words, 2).err
    assert f"within the limits of yumi_left, got 57.3 rad at 0.400 s for joint 4 ({robot.joint_names[3]})" in said
    log.write(log.Table(table.t, {"q": q[:, :6], "qd": table["qd"][:, :6]}), "far.csv")
    assert "the 7 joints of yumi_left" in command([*words, "--joint", "3"], 2).err
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.slow
def test_a_run_that_was_refused_is_not_to_be_identified(tmp_path, monkeypatch, command) -> None:
    monkeypatch.chdir(tmp_path)
    robot = robots.load("yumi_left")
    log.write(identify.dither(robot.q_home, 0.5).table(), "motion.csv")
    monkeypatch.setattr(
        "armlab.identify.Trajectory.controller", lambda *_: lambda state: Command(np.full(7, 1.0) + state.q)
    )
    words = ["--saved", "motion.csv", "--run", "sim://yumi_left?lockstep=true", "--approach", "0.5"]
    said = command(["excite", "yumi_left", *words, "--log", "run.mcap"], 1).err
    assert "The last command to yumi_left was refused." in said
    assert "log: run.mcap" in said
    assert "next: armlab identify" not in said


@pytest.mark.slow
def test_it_runs_on_the_simulated_controller_and_the_log_can_be_identified(tmp_path, monkeypatch, command) -> None:
    """Takes about 15 s: 20 s of motion in lockstep, then identification from its log, with a report."""
    monkeypatch.chdir(tmp_path)
    words = ["--seconds", "20", "--run", "sim://yumi_left?lockstep=true&seed=1", "--log", "excite.mcap"]
    said = command(["excite", "yumi_left", *words, "--approach", "2"]).err
    assert "excite: moving" in said
    assert "armlab identify yumi_left" in said
    table = log.read("excite.mcap")
    assert 22.0 <= np.ptp(table["session_t"]) < 23.0
    assert np.isfinite(table["tau"]).all()
    assert main(["identify", "yumi_left", "excite.mcap", "-o", "model.toml", "--report", "model.html"]) == 0
    pictures = re.findall(r"data:image/png;base64,(\w{8})", Path("model.html").read_text(encoding="utf-8"))
    assert pictures == ["iVBORw0K"] * 9
