"""armlab play: trajectories in JSON, CSV and recordings, on the simulated arm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log, robots

ROBOT = robots.load("yumi_left")
LINK = ["--link", "sim://yumi_left?lockstep=true"]


def message(path: Path, seconds: float = 1.0, **more: Any) -> Path:
    """Write a 0.1 rad motion of every joint as a ROS message, with the joints in a different order."""
    names, q = ROBOT.ros_joint_names[::-1], ROBOT.q_home[::-1]
    points = [
        {"positions": (q + d).tolist(), "velocities": [0.0] * 7, "time_from_start": {"sec": int(t), "nanosec": 0}}
        for t, d in ((0.0, 0.05), (seconds, 0.15))
    ]
    path.write_text(json.dumps({"trajectory": {"joint_names": names, "points": points} | more}))
    return path


def test_a_message_and_its_recording_are_played(tmp_path: Path, command) -> None:
    said = command(["play", message(tmp_path / "a.json"), "yumi_left", *LINK, "--log", tmp_path / "run.mcap", "--json"])
    found = json.loads(said.out)
    assert (found["reason"], found["seconds"]) == ("arrived", 1.0)
    assert found["goal_error"] < 0.01
    first = log.read(found["log"]).dropna("q_sent")["q_sent"]
    np.testing.assert_allclose(first[[0, -1]], ROBOT.q_home + np.array([[0.05], [0.15]]), atol=1e-3)
    again = command(["play", found["log"], "yumi_left", *LINK, "--log", tmp_path / "again.mcap"])
    assert "rad from the goal: arrived" in again.out
    second = log.read(tmp_path / "again.mcap").dropna("q_sent")["q_sent"]
    np.testing.assert_allclose(second[-1], first[-1], atol=1e-4)


def test_a_table_of_positions_is_played(tmp_path: Path, command) -> None:
    t = np.arange(0.0, 1.0, 0.02)
    q, moving = ROBOT.q_home + 0.05 * (1.0 - np.cos(np.pi * t))[:, None], np.full((len(t), 7), 0.1)
    log.write(log.Table(t, {"q": q, "qd": moving}), tmp_path / "q.csv", ROBOT)
    said = command(["play", tmp_path / "q.csv", "yumi_left", *LINK, "--log", tmp_path / "run.mcap"])
    assert "arrived" in said.out
    assert "qd: ignored, because the last row is not at rest" in said.err


@pytest.mark.parametrize(
    ("more", "options", "words"),
    [
        ({"points": []}, [], "with points, got none"),
        ({"joint_names": ["a"]}, [], "Expected 1 positions in every point"),
        ({"joint_names": list("abcdefg")}, [], "name of a joint, got 'a'"),
        ({"points": [{"positions": "up"}]}, [], "Expected `array`, got `str` - at `$.points[0].positions`"),
        ({}, ["--speed", "0.01"], "Expected speeds up to 0.03142"),
    ],
)
def test_refused(tmp_path: Path, command, more: dict[str, Any], options: list[str], words: str) -> None:
    assert words in command(["play", message(tmp_path / "a.json", **more), "yumi_left", *LINK, *options], code=2).err


def test_refused_files(tmp_path: Path, command) -> None:
    (tmp_path / "a.json").write_text("{")
    log.write(log.Table(np.zeros(1), {"q": ROBOT.q_home[None]}), tmp_path / "q.csv", ROBOT)
    for name, words in (("a.json", "Expected JSON"), ("q.csv", "got 1 rows with q")):
        assert words in command(["play", tmp_path / name, "yumi_left"], code=2).err
