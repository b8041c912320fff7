"""What `armlab dmp fit` makes of logs: each kind of primitive, without the rest around the motion."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armlab import kinematics, log, robots
from armlab.cli import main
from armlab.cli.dmp.teaching import (
    KINDS,
    Demonstration,
    Window,
    check_options,
    numbers_of,
    read_demonstration,
    taught,
    text_of,
)
from armlab.errors import ConfigError, UnknownName
from armlab.log import Column, Table
from armlab.motion import PeriodicDmp, PoseDmp, ProMP, profiles

ROBOT = robots.load("yumi_left")
T = np.arange(0, 2.0, 0.01)
WAY = np.deg2rad([10, -5, 8, -10, 5, 5, 20])


def shown(folder: Path, share: float = 1.0) -> Path:
    """A log: rest, a motion of a second, rest."""
    q = profiles.minimum_jerk(ROBOT.q_home, ROBOT.q_home + share * WAY, 1.0).at(T - 0.5)[0]
    return log.write(Table(T, {"q": q}), folder / f"shown{share}.csv")


def fitted(folder: Path, capsys, *words: str) -> tuple[Path, dict]:
    path = folder / "motion.toml"
    assert main(["dmp", "fit", *words, "-o", str(path), "--json"]) == 0
    return path, json.loads(capsys.readouterr().out)


def test_poses_come_from_kinematics_or_from_the_log(tmp_path: Path, capsys) -> None:
    words = ["--kind", "pose", "--frame", "goal", "--basis", "20"]
    path, said = fitted(tmp_path, capsys, str(shown(tmp_path)), *words, "--robot", "yumi_left")
    value = PoseDmp.load(path)
    assert value.frame == "goal"
    assert said["kernels"] == 20
    np.testing.assert_allclose(value.T_goal, kinematics.forward(ROBOT, ROBOT.q_home + WAY), atol=1e-9)
    assert max(said["rms"]) < 1e-3
    poses = kinematics.forward(ROBOT, log.read(shown(tmp_path))["q"])
    table = log.write(Table(T, {"T_base_tool": poses}), tmp_path / "poses.csv")
    found = read_demonstration(table, "pose", (), None, Window())
    assert found.y.shape[1:] == (4, 4)
    assert "sha256" in found.sources[0]


def test_a_rhythm(tmp_path: Path, capsys) -> None:
    y = np.stack([np.sin(np.pi * T), 0.5 * np.cos(np.pi * T)], axis=1)
    table = Table(T, {"a": y[:, 0], "b": y[:, 1]}, {"a": Column(unit="m"), "b": Column(unit="m")})
    columns = ("--column", "a", "--column", "b")
    logs = log.write(table, tmp_path / "rhythm.csv")
    path, said = fitted(tmp_path, capsys, str(logs), "--kind", "periodic", "--period", "2", *columns)
    value = PeriodicDmp.load(path)
    assert (said["period"], value.n) == (2.0, 2)
    assert max(said["rms"]) < 1e-6


def test_a_distribution_over_motions(tmp_path: Path, capsys) -> None:
    logs = [str(shown(tmp_path, share)) for share in (0.8, 1.0, 1.3)]
    path, said = fitted(tmp_path, capsys, *logs, "--kind", "promp", "--basis", "8")
    value = ProMP.load(path)
    assert (said["demonstrations"], said["kernels"], value.n) == (3, 8, 7)
    spread = np.std([0.8, 1.0, 1.3], ddof=1) * np.abs(WAY)
    np.testing.assert_allclose(said["goal_sd"], spread, rtol=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_told_in_words(kind: str) -> None:
    y = np.outer(np.sin(np.pi * T), [1.0, 0.5])
    T_base_tool = np.tile(np.eye(4), (len(T), 1, 1))
    T_base_tool[:, 0, 3] = T
    demos = [Demonstration(T, T_base_tool if kind == "pose" else k * y, ()) for k in (1.0, 1.5)]
    demos = demos if kind in ("joints", "promp") else demos[:1]
    options = check_options(kind, {"basis": 9, "period": 2.0 if kind == "periodic" else None})
    found = taught(kind, demos, options)
    said = text_of(kind, found, len(demos))
    assert said.startswith(kind)
    assert "9 kernels" in said
    assert len(said.splitlines()) == 2 + (6 if kind == "pose" else 2)
    assert numbers_of(kind, found, len(demos))["demonstrations"] == len(demos)


def test_rest_is_left_out_and_windows_are_kept(tmp_path: Path) -> None:
    path = shown(tmp_path)
    assert read_demonstration(path, "joints", (), None, Window()).t[[0, -1]] == pytest.approx([0.42, 1.58], abs=0.04)
    assert len(read_demonstration(path, "joints", (), None, Window(whole=True)).t) == 200
    assert read_demonstration(path, "joints", ("q",), None, Window(0.6, 1.2)).t[[0, -1]] == pytest.approx([0.6, 1.19])
    with pytest.raises(ConfigError, match="got rest"):
        read_demonstration(path, "joints", (), None, Window(end=0.3))


def test_options_belong_to_kinds(tmp_path: Path) -> None:
    assert check_options("pose", {"frame": "goal", "period": None}) == {"frame": "goal"}
    with pytest.raises(ConfigError, match="--kind pose"):
        check_options("joints", {"frame": "goal"})
    with pytest.raises(ConfigError, match="--period"):
        check_options("periodic", {"period": None})
    with pytest.raises(UnknownName, match="periodic"):
        check_options("rhythm", {})
    demo = read_demonstration(shown(tmp_path), "joints", (), None, Window())
    with pytest.raises(ConfigError, match="Expected one log"):
        taught("periodic", [demo, demo], {"period": 1.0})


def test_poses_of_a_bag_are_those_of_the_robot(ur5e_bag: Path) -> None:
    """In the order of their driver its joints would be another posture."""
    found = read_demonstration(ur5e_bag, "pose", (), "ur5e", Window(whole=True))
    np.testing.assert_allclose(found.y[0], kinematics.forward(robots.load("ur5e"), np.arange(6.0)))


@pytest.mark.parametrize("kind", ["joints", "periodic", "promp"])
def test_joints_of_a_bag_need_their_robot(ur5e_bag: Path, kind: str) -> None:
    """In the order of their driver they would be played by the wrong joints."""
    found = read_demonstration(ur5e_bag, kind, (), "ur5e", Window(whole=True))
    np.testing.assert_array_equal(found.y[0], np.arange(6.0))
    assert "robot" in check_options(kind, {"robot": "ur5e", "period": 1.0 if kind == "periodic" else None})
    with pytest.raises(ConfigError, match="Expected --robot NAME with"):
        read_demonstration(ur5e_bag, kind, (), None, Window(whole=True))
