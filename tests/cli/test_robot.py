"""``armlab robot list`` and ``armlab robot show``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from armlab import robots
from armlab.cli.robot import list_robots, robot, show
from armlab.errors import ConfigError


def test_list_names_every_robot_of_the_library(capsys: pytest.CaptureFixture[str]) -> None:
    assert robot.name == ("robot",)
    list_robots()
    text = capsys.readouterr().out
    list_robots(json=True)
    data = json.loads(capsys.readouterr().out)
    assert [entry["name"] for entry in data] == list(robots.names())
    for name in robots.names():
        assert name in text
        assert len([line for line in text.splitlines() if line.startswith(f"{name} ")]) == 1
    assert max(len(line) for line in text.splitlines()) <= 100


def test_show_prints_torques_and_what_a_motor_moves_besides(capsys: pytest.CaptureFixture[str]) -> None:
    show("irb2400")
    assert capsys.readouterr().out.endswith("the motor of axis_2 also moves axis_3: -1 rad/rad\n")
    show("ur5e")
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "_joint " in line]
    assert [row[7] for row in rows] == ["150", "150", "150", "28", "28", "28"]


def test_show_prints_the_joints(capsys: pytest.CaptureFixture[str]) -> None:
    arm = robots.load("yumi_right")
    show("yumi_right")
    text = capsys.readouterr().out
    for name in arm.joint_names:
        assert f"\n{name} " in text
    show("yumi_right", json=True)
    data = json.loads(capsys.readouterr().out)
    assert data["q_max"] == pytest.approx(arm.q_max)
    assert data["hash"] == arm.hash


def test_show_draws_the_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "arm.png"
    show("irb2400", figure=picture)
    assert f"figure: {picture}" in capsys.readouterr().err
    assert picture.stat().st_size > 10_000
    with pytest.raises(ConfigError, match="--force"):
        show("irb2400", figure=picture)
    with pytest.raises(ConfigError, match="ends in"):
        show("irb2400", figure=tmp_path / "arm.txt")
