"""``armlab robot list``, ``armlab robot show`` and ``armlab robot convert``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models, robots
from armlab.cli.robot import convert, list_robots, robot, show


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


def test_show_prints_joints_and_torques_and_draws_the_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "arm.png"
    show("irb2400", figure=picture)
    said = capsys.readouterr()
    assert said.out.endswith("the motor of axis_2 also moves axis_3: -1 rad/rad\n")
    assert f"figure: {picture}" in said.err
    assert picture.stat().st_size > 10_000
    show("ur5e")
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "_joint " in line]
    assert [row[7] for row in rows] == ["150", "150", "150", "28", "28", "28"]
    arm = robots.load("yumi_right")
    show("yumi_right")
    text = capsys.readouterr().out
    assert all(f"\n{name} " in text for name in arm.joint_names)
    show("yumi_right", json=True)
    data = json.loads(capsys.readouterr().out)
    assert data["q_max"] == pytest.approx(arm.q_max)
    assert data["hash"] == arm.hash


GRIPPER = """<robot name="gripper">
  <link name="palm"/><link name="finger"/><link name="thumb"/>
  <joint name="close" type="prismatic"><parent link="palm"/><child link="finger"/><origin xyz="0.01 0 0"/>
    <limit lower="0" upper="0.04" effort="20" velocity="0.1"/></joint>
  <joint name="oppose" type="prismatic"><parent link="palm"/><child link="thumb"/>
    <limit lower="0" upper="0.04" effort="20" velocity="0.1"/><mimic joint="close" multiplier="-1"/></joint>
</robot>
"""


@pytest.fixture
def gripper(tmp_path: Path) -> Path:
    path = tmp_path / "gripper.urdf"
    path.write_text(GRIPPER, encoding="utf-8")
    return path


def test_show_prints_the_tree_of_a_urdf(gripper: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show(str(gripper))
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        "gripper: 3 links, 2 joints",
        "link      parent joint  kind       from    to  unit  follows",
        "palm",
        "  finger  close         prismatic     0  0.04  m",
        "  thumb   oppose        prismatic     0  0.04  m     -1 close +0",
    ]
    assert "--tip finger or thumb" in err
    show(str(gripper), json=True)
    data = json.loads(capsys.readouterr().out)
    assert (data["root"], data["tips"], data["links"]) == ("palm", ["finger", "thumb"], ["palm", "finger", "thumb"])
    assert data["joints"][1]["follows"] == {"joint": "close", "multiplier": -1.0, "offset": 0.0}


def test_convert_writes_what_it_read(gripper: Path, tmp_path: Path, command) -> None:
    target = tmp_path / "finger.toml"
    words = ["robot", "convert", gripper, target]
    assert f"robot: {target}, joints close" in command([*words, "--tip", "finger"]).err
    assert robots.load(target) == robots.load(gripper, tip="finger")
    several = command(["robot", "convert", gripper, tmp_path / "which.toml"], 1).err
    assert "got several: finger, thumb. Select the tip" in several
    assert not (tmp_path / "which.toml").exists()
    command([*words, "--base=finger", "--tip=thumb", "--force"])
    assert robots.load(target).joint_names == ("close", "oppose")
    convert("irb2400", tmp_path / "irb2400.urdf")
    assert robots.load(tmp_path / "irb2400.urdf").n == 6


@pytest.mark.slow  # a semidefinite programme, twice
def test_a_model_and_a_calibration_go_into_a_urdf(fitted, truth, tmp_path: Path, command) -> None:
    model, target = fitted.save(tmp_path / "model.toml"), tmp_path / "arm.urdf"
    said = command(["robot", "export", "yumi_left", target, "--model", model])
    assert "joints" in said.err
    read = robots.load(target)
    assert read.inertias is not None
    friction = fitted.value.friction
    text = target.read_text(encoding="utf-8")
    assert f'damping="{float(friction.viscous[0])!r}"' in text
    assert "rotor inertia on the joint side" in text
    arm, found, words = truth.robot, tmp_path / "kinematics.toml", ["robot", "export", "yumi_left"]
    moved = replace(arm, T_flange_tool=arm.T_flange_tool + np.pad([[0.001]], ((0, 3), (3, 0))))
    free = (), np.zeros((7, 0)), np.zeros(0), np.zeros((48, 48))
    models.save(models.KinematicCorrection(moved, arm.name, arm.hash, *free), found)
    command([*words, tmp_path / "new.toml", "--calibrated", found, "--model", model])
    new = robots.load(tmp_path / "new.toml")
    assert new.inertias is not None
    np.testing.assert_allclose(new.T_home[:3, 3] - arm.T_home[:3, 3], 0.001 * arm.T_home[:3, 0], rtol=0, atol=1e-9)
    assert "Expected --calibrated FILE, --model FILE" in command([*words, target, "--force"], 2).err
    assert "Expected a calibration of" in command([*words, target, "--calibrated", model, "--force"], 2).err
