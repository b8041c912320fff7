"""``armlab log export`` and ``cut`` to bags that drive robot_state_publisher."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import cli, robots
from armlab.log import Recorder, Tick, read
from armlab.state import State

NAMES = [f"yumi_robr_joint_{k}" for k in range(1, 8)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with Recorder(tmp_path / "run.mcap", robots.load("yumi_right")) as recorder:
        for i in range(100):
            q = np.full(7, 0.01 * i)
            stamp = 1_700_000_000_000_000_000 + i * 4_000_000
            state = State(i * 0.004, 0.004, q, q, q, seq=i, robot_ns=stamp)
            recorder.row(state, None, Tick(i, i, stamp, stamp, stamp + 1000, 10))
    return recorder.path


def names_in(bag: Path) -> set[tuple[str, ...]]:
    from rosbags.highlevel import AnyReader

    with AnyReader([bag]) as reader:
        states = [one for one in reader.connections if one.topic == "/joint_states"]
        messages: list[Any] = [reader.deserialize(raw, one.msgtype) for one, _, raw in reader.messages(states)]
    return {tuple(message.name) for message in messages}


def test_a_bag_of_a_recording_has_the_joint_names_of_the_urdf(path: Path, tmp_path: Path) -> None:
    whole, part = tmp_path / "whole.rosbag2", tmp_path / "part.rosbag2"
    assert cli.main(["log", "export", str(path), str(whole)]) == 0
    assert cli.main(["log", "cut", str(path), "--to", "0.1", "-o", str(part)]) == 0
    for bag in (whole, part):
        assert names_in(bag) == {tuple(NAMES)}
        assert read(bag).columns["q"].labels == read(path).columns["q"].labels, "our own reader gives the same table"


def test_of_a_log_without_a_description_the_robot_is_named(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    csv, bag = tmp_path / "run.csv", tmp_path / "run.rosbag2"
    assert cli.main(["log", "export", str(path), str(csv)]) == 0
    assert cli.main(["log", "export", str(csv), str(bag)]) == 0
    assert names_in(bag) == {robots.load("yumi_right").joint_names}, "labels of the columns"
    assert cli.main(["log", "export", str(csv), str(bag), "--robot", "yumi_right", "--force"]) == 0
    assert names_in(bag) == {tuple(NAMES)}
    capsys.readouterr()
    assert cli.main(["log", "export", str(csv), str(bag), "--robot", "irb120", "--force"]) == 1
    assert "(100, 6) for robot 'irb120' of 6 joints, got (100, 7). Name the robot" in capsys.readouterr().err
    assert names_in(bag) == {tuple(NAMES)}, "the bag from before stays"
