"""armlab model show: the same pose in the formats of ROS, URDF, easy_handeye and MoveIt."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from armlab import models
from armlab.lie import euler, quaternion, se3

T_TOOL_MARKER, T_BASE_CAM = se3.exp([0.1, 0.2, 0.3, 0.4, 0.5, -0.6]), se3.exp([1.0, -0.2, 0.3, 2.4, -1.5, 0.6])


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    return models.save(models.HandEye("eye_to_hand", T_TOOL_MARKER, T_BASE_CAM), tmp_path / "camera.toml")


def pose(p, wxyz) -> np.ndarray:
    return se3.from_rp(quaternion.to_matrix(np.array(wxyz, dtype=float)), np.array(p, dtype=float))


def test_every_form_holds_the_pose(camera: Path, command) -> None:
    words = ["model", "show", camera, "--frame", "base=base_link", "--frame", "cam=optical", "--as"]
    told = json.loads(command([*words, "json"]).out)["poses"]
    assert [(one["parent"], one["child"]) for one in told] == [("tool", "marker"), ("base_link", "optical")]
    np.testing.assert_allclose(told[1]["matrix"], T_BASE_CAM)
    np.testing.assert_allclose(pose(told[1]["position"], told[1]["quaternion_wxyz"]), T_BASE_CAM, rtol=0, atol=1e-12)

    line = command([*words, "tf"]).out.splitlines()[1]
    found = dict(re.findall(r"--(\S+) (\S+)", line))
    assert (found["frame-id"], found["child-frame-id"]) == ("base_link", "optical")
    wxyz = [found[f"q{axis}"] for axis in "wxyz"]
    np.testing.assert_allclose(pose([found[axis] for axis in "xyz"], wxyz), T_BASE_CAM, rtol=0, atol=1e-10)

    joint = ET.fromstring(f"<robot>{command([*words, 'urdf']).out}</robot>")[1]
    origin = joint.find("origin")
    roll, pitch, yaw = map(float, origin.get("rpy").split())
    np.testing.assert_allclose(euler.from_rpy([yaw, pitch, roll], "zyx"), T_BASE_CAM[:3, :3], rtol=0, atol=1e-10)
    assert joint.find("parent").get("link") == "base_link"

    easy = YAML(typ="safe").load(command([*words, "easy_handeye"]).out)
    assert easy["parameters"]["eye_on_hand"] is False
    assert easy["parameters"]["tracking_base_frame"] == "optical"
    numbers = easy["transformation"]
    found = pose([numbers[axis] for axis in "xyz"], [numbers[f"q{axis}"] for axis in "wxyz"])
    np.testing.assert_allclose(found, T_BASE_CAM, rtol=0, atol=1e-10)

    launch = YAML(typ="safe").load(command([*words, "moveit"]).out)["launch"][0]["node"]
    assert launch["exec"] == "static_transform_publisher"
    assert launch["args"] == line.partition("static_transform_publisher ")[2]
    assert "quaternion w" in command(["model", "show", camera]).out


def test_results_without_poses_and_unknown_frames_are_refused(camera: Path, tmp_path: Path, command) -> None:
    said = command(["model", "show", camera, "--frame", "hand=tool0"], 2).err
    assert "Expected --frame with frames of" in said
    assert "got hand" in said
    load = models.save(models.Accelerometer(np.eye(3), np.zeros(3)), tmp_path / "accelerometer.toml")
    assert "which contains no poses" in command(["model", "show", load, "--as", "tf"], 2).err
    assert "FRAME=NAME" in command(["model", "show", camera, "--frame", "cam"], 2).err
