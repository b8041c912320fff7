"""The log of one arm: with torques, in its order of joints, of no other robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab import identify, log, robots
from armlab.errors import LogError, ModelMismatchError


def test_columns_are_those_of_the_arm(truth, tmp_path: Path) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 1.0), seed=5)
    told: list[tuple[int, int, str]] = []
    for name in ("one.mcap", "one.csv"):
        path = log.write(table, tmp_path / name, truth.robot)
        found = log.read_arm(str(path), truth.robot, lambda *step: told.append(step))
        np.testing.assert_array_equal(found["tau"], table["tau"])
        assert found["q"].shape == (len(table), 7)
    assert told


def test_joints_of_another_program_are_put_in_order(ur5e_bag: Path) -> None:
    table = log.read_arm(ur5e_bag, robots.load("ur5e"))
    np.testing.assert_array_equal(table["q"][0], np.arange(6.0))


def test_logs_that_are_not_of_the_arm_are_refused(truth, tmp_path: Path) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 1.0), seed=5)
    path = log.write(table, tmp_path / "left.mcap", truth.robot)
    with pytest.raises(ModelMismatchError, match=r"of 'yumi_right', got one of 'yumi_left' in .*left\.mcap"):
        log.read_arm(path, robots.load("yumi_right"))
    bare = log.write(table, tmp_path / "left.csv")
    with pytest.raises(ModelMismatchError, match="of 'ur5e' with 6 joints"):
        log.read_arm(bare, robots.load("ur5e"))
    joints = "log of the joints"
    for names, missing, advice in (
        (("q",), "tau", "research extension"),
        (("qd",), "q and tau", joints),
        (("qd", "tau"), "q", joints),
    ):
        mute = log.write(table.select(*names), tmp_path / "mute.csv")
        with pytest.raises(LogError, match=f"got none for {missing} among .*{advice}"):
            log.read_arm(mute, truth.robot)
    with pytest.raises(LogError, match=r"no\.mcap"):
        log.read_arm(tmp_path / "no.mcap", truth.robot)
