"""Logs of commands: what is refused, and what is doubted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import identify, log, robots
from armlab.cli.support.log_input import doubts, gaps, left_out, read_log, reading_bar
from armlab.errors import LogError, ModelMismatchError


def test_a_log_without_torques_or_of_another_robot_is_refused(truth, tmp_path: Path) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 1.0), seed=5).select("q", "tau")
    path = log.write(table, tmp_path / "swayed.mcap", truth.robot)
    assert "qd" in read_log(path, truth.robot)
    with pytest.raises(ModelMismatchError, match="recording of 'yumi_right', got one of 'yumi_left'"):
        read_log(path, robots.load("yumi_right"))
    mute = log.write(table.select("q"), tmp_path / "mute.mcap", truth.robot)
    with pytest.raises(LogError, match=r"got none for tau among .*research extension"):
        read_log(mute, truth.robot)


def test_of_a_recording_of_both_arms_the_rows_of_the_arm_are_read(truth, tmp_path: Path) -> None:
    left, right = truth.robot, replace(robots.load("yumi_right"), name="yumi-right")
    table = truth.log(identify.dither(left.q_home, 1.0), seed=5).select("q", "qd", "tau")
    other = table.with_column("q", -table["q"])
    pieces = [log.write(one, tmp_path / f"{arm.name}.mcap", arm) for one, arm in ((table, left), (other, right))]
    both = log.merge(pieces, tmp_path / "both.mcap")
    for arm, one in ((left, table), (right, other)):
        np.testing.assert_array_equal(read_log(both, arm)["q"], one["q"])
    with pytest.raises(ModelMismatchError, match="of 'irb120', got one of 'yumi_left' and 'yumi_right'"):
        read_log(both, robots.load("irb120"))


def test_what_cannot_be_true_is_doubted(truth) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    assert doubts(table, truth.robot) == ()
    backwards, motors = table.with_column("qd", -table["qd"]), table.with_column("tau", table["tau"] / 100)
    assert ["derivative of q" in sentence for sentence in doubts(backwards, truth.robot)] == [True]
    assert ["motors'" in sentence for sentence in doubts(motors, truth.robot)] == [True]


def test_a_torque_that_the_model_does_not_know_is_not_doubted(truth, model) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    dead = table.with_column("tau", np.where(np.arange(7) == 6, 0.0, table["tau"]))
    (said,) = doubts(dead, truth.robot, model)
    assert "got a constant for axis_6" in said
    partly = replace(model.quality, rms_cv=np.where(np.arange(7) == 6, np.nan, model.quality.rms_cv))
    assert doubts(dead, truth.robot, replace(model, quality=partly)) == ()
    bare = replace(model, quality=replace(model.quality, rms_cv=np.full(7, np.nan)))
    assert doubts(dead, truth.robot, bare) == (said,)


def test_gaps_missing_rows_and_rest_are_no_reason_to_doubt(truth) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    torn = table.rows(np.r_[0:300, 600 : len(table)])
    tau = torn["tau"].copy()
    tau[350] = np.nan
    assert doubts(torn.with_column("tau", tau), truth.robot) == ()
    still = truth.log(identify.dither(truth.robot.q_home, 2.0, amplitude=1e-6), seed=5)
    assert doubts(still, truth.robot) == ()
    assert doubts(table.rows(slice(0, 0)), truth.robot) == ()


def test_gaps_and_rows_without_an_estimate_are_counted(truth) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 2.0), seed=5)
    assert gaps(table) == []
    assert gaps(table.rows(slice(0, 1))) == []
    torn = table.rows((table.t < 0.5) | ((table.t >= 0.6) & (np.arange(len(table)) != 300)))
    (first, second) = gaps(torn)
    assert first == pytest.approx((0.496, 0.104))
    assert second == pytest.approx((1.196, 0.008))
    flags = np.where(np.arange(len(table)) < 7, 1 + 4, 4)
    assert left_out(table.with_column("wrench_flags", flags, unit="1", kind="count")) == 7


def test_a_bag_of_another_program_gives_the_joints_of_the_robot(ur5e_bag: Path) -> None:
    with reading_bar(ur5e_bag) as tell:
        assert tell is None  # no terminal, no large file
    table = read_log(ur5e_bag, robots.load("ur5e"))
    np.testing.assert_array_equal(table["q"][0], np.arange(6.0))
    assert table["qd"].shape == (5, 6)
    with pytest.raises(LogError, match="Only in the robot: panda_joint1"):
        read_log(ur5e_bag, robots.load("panda"))
