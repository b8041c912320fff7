"""armlab dmp: a primitive from a log, played on the simulated arm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import bridge, kinematics, log, robots
from armlab.cli import main
from armlab.cli.dmp.playing import OPTIONS, PlannedMotion, distance, motion_of, rehearsed, resolved, rolled_out
from armlab.cli.dmp.teaching import KINDS, Demonstration, check_options, numbers_of, read_demonstration, taught, text_of
from armlab.cli.dmp.teaching import MotionWindow as Window
from armlab.errors import ConfigError
from armlab.log import Column, Table
from armlab.motion import (
    Dmp,
    PeriodicDmp,
    PoseDmp,
    TwoDofDmp,
    fit_dmp,
    fit_periodic_dmp,
    fit_pose_dmp,
    fit_promp,
    profiles,
)

ROBOT = robots.load("yumi_left")
LIMITS = bridge.Limits.of(ROBOT)
T = np.linspace(0.0, 1.0, 101)
T_TAUGHT = np.arange(0, 2.0, 0.01)
WAY = np.deg2rad([10, -5, 8, -10, 5, 5, 20])


def path(share: float = 1.0, t: np.ndarray = T) -> np.ndarray:
    return profiles.minimum_jerk(ROBOT.q_home, ROBOT.q_home + share * WAY, 1.0).at(t)[0]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    table = Table(T_TAUGHT, {"q": path(t=T_TAUGHT - 0.5)})
    return log.write(table, tmp_path_factory.mktemp("taught") / "shown.csv")


@pytest.fixture(scope="module")
def primitive(shown: Path) -> Path:
    target = shown.with_name("motion.toml")
    assert main(["dmp", "fit", str(shown), "-o", str(target), "--basis", "15"]) == 0
    return target


def test_a_motion_is_fitted_without_the_rest_around_it(shown: Path, primitive: Path, tmp_path: Path, command) -> None:
    value = Dmp.load(primitive)
    assert value.n == 7
    assert 0.9 < value.duration < 1.25
    assert "sha256" in primitive.read_text()
    words = ["dmp", "fit", shown, shown, "-o", tmp_path / "two.toml", "--whole", "--basis", "30", "--json"]
    said = json.loads(command(words).out)
    assert said["duration"] == pytest.approx(1.99)
    assert max(said["rms"]) < 1e-3


def test_the_motion_is_written_to_a_file(primitive: Path, tmp_path: Path, command) -> None:
    path, words = tmp_path / "motion.csv", ["dmp", "play", str(primitive), "--json", "-o"]
    goal = Dmp.load(primitive).g + 0.01
    said = json.loads(command([*words, path, "--duration", "2", "--goal", ",".join(map(str, goal))]).out)
    assert said["seconds"] == pytest.approx(2.0, abs=0.004)
    table = log.read(path)
    np.testing.assert_allclose(table["y"][-1], goal, rtol=0, atol=1e-3)
    assert main([*words, str(path), "--force", "--robot", "yumi_left", "--speed", "0.1"]) == 0
    table, robot = log.read(path), robots.load("yumi_left")
    assert np.abs(table["qd"]).max() <= 0.1 * robot.qd_max.max() * (1 + 1e-9)
    np.testing.assert_allclose(table["q"][-1], goal - 0.01, rtol=0, atol=2e-3)


@pytest.mark.slow  # 3 s
def test_it_is_played_on_the_simulated_arm(primitive: Path, tmp_path: Path, command, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["dmp", "play", primitive, "--robot", "yumi_left", "--link", "sim://yumi_left?lockstep=true", "--json"]
    said = json.loads(command([*words, "--log", "first.mcap"]).out)
    assert said["goal_error"] < 0.01
    assert said["reason"] == "arrived"
    table = log.read(said["log"])
    np.testing.assert_allclose(table["q"][0], Dmp.load(primitive).y0, atol=0.01)
    monkeypatch.setattr("armlab.bridge.control.state_machine.entry_refusal", lambda *_: "Expected nearer.")
    refused = command([*words, "--log", "refused.mcap"], 1).err
    assert "The last command to yumi_left was refused. Expected nearer." in refused


@pytest.mark.slow  # 3 s
def test_poses_are_played_on_the_simulated_arm(shown: Path, tmp_path: Path, command, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["dmp", "fit", str(shown), "-o", "pose.toml", "--kind", "pose", "--robot", "yumi_left"]) == 0
    words = ["dmp", "play", "pose.toml", "--robot", "yumi_left", "--link", "sim://yumi_left?lockstep=true"]
    assert "of motion, ended" in command([*words, "--log", "pose.mcap"]).out
    tool = kinematics.forward(robots.load("yumi_left"), log.read("pose.mcap")["q"][[0, -1]])
    shown = PoseDmp.load("pose.toml")
    np.testing.assert_allclose(tool, [shown.T_start, shown.T_goal], rtol=0, atol=0.01)


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    dmp = fit_dmp(T, path(), n_basis=20).value
    round_and_round = ROBOT.q_home + 0.1 * np.outer(np.sin(2 * np.pi * T), np.ones(7))
    return {
        "dmp": dmp,
        "two_dof_dmp": TwoDofDmp(dmp),
        "promp": fit_promp(T, np.array([path(k) for k in (0.8, 1.0, 1.3)]), n_basis=8).value,
        "pose_dmp": fit_pose_dmp(T, kinematics.forward(ROBOT, path()), n_basis=20).value,
        "periodic_dmp": fit_periodic_dmp(T, round_and_round, period=1.0).value,
    }


@pytest.mark.parametrize("kind", OPTIONS)
def test_every_kind_leads_the_arm_and_makes_a_table(kind: str, made: dict[str, Any], tmp_path: Path) -> None:
    primitive, run = resolved(type(made[kind]).load(made[kind].save(tmp_path / "m.toml")), {"goal": None})
    table = rolled_out(primitive, run)
    assert table.names == (("T_base_tool",) if kind == "pose_dmp" else ("y", "yd", "ydd"))
    assert table.t[-1] == pytest.approx(4.0 if kind == "periodic_dmp" else 1.0, abs=0.005)
    motion = motion_of(primitive, run, ROBOT, LIMITS, firm=False)
    assert isinstance(motion, PlannedMotion)
    q = rehearsed(motion)["q"]
    assert np.abs(q[0] - motion.q_start).max() < 0.01
    assert np.abs(np.diff(q, axis=0)).max() / 0.004 <= LIMITS.qd_max.max() * (1 + 1e-9)
    end = ROBOT.q_home + (0.0 if kind == "periodic_dmp" else 31 / 30 if kind == "promp" else 1.0) * WAY
    if kind == "pose_dmp":
        assert max(distance(ROBOT, q[-1], kinematics.forward(ROBOT, end)).values()) < 1e-3
    else:
        np.testing.assert_allclose(q[-1], end, rtol=0, atol=2e-3)


@pytest.mark.parametrize("kind", ["two_dof_dmp", "promp"])
def test_points_on_the_way_are_passed(kind: str, made: dict[str, Any]) -> None:
    point = path(1.2 if kind == "promp" else 1.0)[50] + (0.0 if kind == "promp" else 0.02)
    primitive, run = resolved(made[kind], {"via": [f"0.5:{','.join(map(str, point))}"]})
    table = rolled_out(primitive, run)
    np.testing.assert_allclose(table["y"][125], point, rtol=0, atol=2e-3)


def test_a_motion_too_fast_is_stretched(made: dict[str, Any]) -> None:
    seconds = [motion_of(made["dmp"], {"duration": d}, ROBOT, LIMITS, firm=True).seconds for d in (2.0, 0.5, 1e-3)]
    assert seconds[:2] == [2.0, 0.5]
    fastest = np.abs(made["dmp"].rollout(1e-4, duration=seconds[2]).yd).max(axis=0) / LIMITS.qd_max
    assert fastest.max() == pytest.approx(1.0, rel=1e-3)
    slow = bridge.Limits.of(ROBOT, speed=0.05)
    for kind in ("dmp", "pose_dmp", "periodic_dmp"):
        primitive, run = resolved(made[kind], {"duration": 0.2})
        motion = motion_of(primitive, run, ROBOT, slow, firm=True)
        assert motion.seconds > 1.0
        assert np.all(np.abs(rehearsed(motion)["qd"]) <= slow.qd_max * (1 + 1e-9))


def test_a_goal_out_of_reach_is_refused(made: dict[str, Any]) -> None:
    far = {"goal": np.array([9.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])}
    with pytest.raises(ConfigError, match="unreachable"):
        motion_of(made["pose_dmp"], far, ROBOT, LIMITS, firm=False)


def test_poses_come_from_kinematics_or_from_the_log(shown: Path, tmp_path: Path, command) -> None:
    words = ["--kind", "pose", "--frame", "goal", "--basis", "20", "--robot", "yumi_left", "--json"]
    said = json.loads(command(["dmp", "fit", shown, "-o", tmp_path / "motion.toml", *words]).out)
    value = PoseDmp.load(tmp_path / "motion.toml")
    assert (value.frame, said["kernels"]) == ("goal", 20)
    np.testing.assert_allclose(value.T_goal, kinematics.forward(ROBOT, ROBOT.q_home + WAY), atol=1e-9)
    assert max(said["rms"]) < 1e-3
    poses = kinematics.forward(ROBOT, log.read(shown)["q"])
    table = log.write(Table(T_TAUGHT, {"T_base_tool": poses}), tmp_path / "poses.csv")
    found = read_demonstration(table, "pose", (), None, Window())
    assert found.y.shape[1:] == (4, 4)
    assert "sha256" in found.sources[0]


def test_a_rhythm(tmp_path: Path, command) -> None:
    y = np.stack([np.sin(np.pi * T_TAUGHT), 0.5 * np.cos(np.pi * T_TAUGHT)], axis=1)
    table = Table(T_TAUGHT, {"a": y[:, 0], "b": y[:, 1]}, {"a": Column(unit="m"), "b": Column(unit="m")})
    words = ["--kind", "periodic", "--period", "2", "--column", "a", "--column", "b", "-o", tmp_path / "motion.toml"]
    said = json.loads(command(["dmp", "fit", log.write(table, tmp_path / "rhythm.csv"), *words, "--json"]).out)
    assert (said["period"], PeriodicDmp.load(tmp_path / "motion.toml").n) == (2.0, 2)
    assert max(said["rms"]) < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_told_in_words(kind: str) -> None:
    y = np.outer(np.sin(np.pi * T_TAUGHT), [1.0, 0.5])
    T_base_tool = np.tile(np.eye(4), (len(T_TAUGHT), 1, 1))
    T_base_tool[:, 0, 3] = T_TAUGHT
    demos = [Demonstration(T_TAUGHT, T_base_tool if kind == "pose" else k * y, ()) for k in (1.0, 1.5)]
    demos = demos if kind in ("joints", "promp") else demos[:1]
    options = check_options(kind, {"basis": 9, "period": 2.0 if kind == "periodic" else None})
    found = taught(kind, demos, options)
    said = text_of(kind, found, len(demos))
    assert said.startswith(kind)
    assert "9 kernels" in said
    assert len(said.splitlines()) == 2 + (6 if kind == "pose" else 2)
    assert numbers_of(kind, found, len(demos))["demonstrations"] == len(demos)


def test_rest_is_left_out_and_windows_are_kept(shown: Path) -> None:
    path = shown
    assert read_demonstration(path, "joints", (), None, Window()).t[[0, -1]] == pytest.approx([0.42, 1.58], abs=0.04)
    assert len(read_demonstration(path, "joints", (), None, Window(whole=True)).t) == 200
    assert read_demonstration(path, "joints", ("q",), None, Window(0.6, 1.2)).t[[0, -1]] == pytest.approx([0.6, 1.19])
    with pytest.raises(ConfigError, match="an arm at rest"):
        read_demonstration(path, "joints", (), None, Window(end=0.3))


@pytest.mark.parametrize("kind", ["joints", "periodic"])
def test_joints_of_a_bag_need_their_robot(ur5e_bag: Path, kind: str) -> None:
    found = read_demonstration(ur5e_bag, kind, (), "ur5e", Window(whole=True))
    np.testing.assert_array_equal(found.y[0], np.arange(6.0))
    assert "robot" in check_options(kind, {"robot": "ur5e", "period": 1.0 if kind == "periodic" else None})
    with pytest.raises(ConfigError, match="Expected --robot NAME with"):
        read_demonstration(ur5e_bag, kind, (), None, Window(whole=True))
