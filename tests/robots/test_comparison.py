"""Differences between two descriptions of an arm, in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ModelMismatchError, RobotError
from armlab.lie import se3
from armlab.robots.comparison import check_same

LEFT = robots.load("yumi_left")


def test_each_part_of_a_description_is_named_with_both_values() -> None:
    assert robots.differences(LEFT, robots.from_toml(robots.to_toml(LEFT), "copy")) == ()
    names = (*LEFT.joint_names[:-1], "wrist")
    for other, words in (
        (LEFT.with_tool(se3.from_rp(np.eye(3), [0.0, 0.12, 0.0])), "tool moved by 0.12 m"),
        (replace(LEFT, q_max=LEFT.q_max + 0.1), "upper position limit of joint 1 2.9409 rad, not 3.0409 rad"),
        (replace(LEFT, gravity=[0.0, 9.81, 0.0]), "gravity [m/s^2]: 0 0 -9.807, not 0 9.81 0"),
        (replace(LEFT, abb_axes=range(1, 8)), "ABB's axis numbers: 1 2 7 3 4 5 6, not 1 2 3 4 5 6 7"),
        (replace(LEFT, joint_names=names), "joint 7: named 'axis_6', not 'wrist'"),
        (replace(LEFT, inertias=np.tile([1.0, *np.zeros(9)], (7, 1))), "inertias: missing, not present"),
        (replace(LEFT, prismatic=[0, 0, 1, 0, 0, 0, 0]), "joint 3: revolute, not prismatic"),
        (replace(LEFT, name="mine"), "named 'yumi_left', not 'mine'"),
    ):
        assert robots.differences(LEFT, other)[0].startswith(words)
    assert robots.differences(robots.load("ur5e"), LEFT) == ("6 joints, not 7",)
    with pytest.raises(RobotError):
        robots.differences(LEFT, "yumi_left")  # type: ignore[arg-type]


def test_a_robot_with_the_same_numbers_passes_and_another_is_told_with_its_first_differences() -> None:
    check_same(replace(LEFT, name="mine"), "the log", "yumi_left", LEFT.hash, LEFT, "Do.")
    with pytest.raises(ModelMismatchError, match=r"robot of the log, 'yumi_left' .*differs: .*; and \d+ more\. Do\."):
        check_same(robots.load("yumi_left_urdf"), "the log", "yumi_left", LEFT.hash, LEFT, "Do.")
