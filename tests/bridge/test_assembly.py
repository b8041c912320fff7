"""The arms of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge import Limits
from armlab.bridge.control.arm import ArmSession
from armlab.bridge.control.run import End, assemble, checked_limits, finished
from armlab.bridge.control.supervision import Settings
from armlab.bridge.net.sockets import Port
from armlab.errors import ConfigError, LogError
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec

RIGHT = robots.load("yumi_right")


def test_limits_of_each() -> None:
    own = Limits.of(RIGHT, speed=0.5)
    assert checked_limits(own, [RIGHT]) == [own]
    np.testing.assert_array_equal(checked_limits(None, [RIGHT] * 2)[1].qd_max, RIGHT.qd_max)
    with pytest.raises(ConfigError, match="Limits for each"):
        checked_limits([own], [RIGHT, RIGHT])
    with pytest.raises(ConfigError, match="7 joints of yumi_right, got 6"):
        checked_limits(Limits(*np.stack([-np.ones(6), *[np.ones(6)] * 5])), [RIGHT])


def test_a_robot_without_limits_of_speed_is_not_commanded() -> None:
    """Any jump would pass the limits, since it may be as large as the speed allows."""
    robot = robots.load("dh_test")
    with pytest.raises(ConfigError, match=r"speed and acceleration.* of dh_test.*qd_max"):
        checked_limits(None, [robot])
    with pytest.raises(ConfigError, match="of dh_test"):
        checked_limits(Limits.of(robot), [robot])
    assert len(checked_limits(None, [robot], commands=False)) == 1
    ones = np.ones(robot.n)
    slow = Limits(-np.inf * ones, np.inf * ones, ones, ones, ones, ones)
    assert checked_limits(slow, [robot]) == [slow]


def ends(*arms: Robot) -> list[End]:
    return [End(arm, Port("127.0.0.1", 0), EgmCodec(arm)) for arm in arms]


OPTIONS: dict[str, Any] = {
    "commands": True,
    "answer_stream": True,
    "extra": None,
    "attachments": {},
    "feeds": (),
    "sources": (),
}


def test_one_clock_and_a_run_at_the_end(tmp_path: Path) -> None:
    made = ends(robots.load("yumi_left"), RIGHT)
    limits = checked_limits(None, [end.robot for end in made])
    arms = assemble(made, limits, Settings(), record=tmp_path / "run.mcap", **OPTIONS)
    assert all(isinstance(arm, ArmSession) for arm in arms)
    assert abs(arms[0].stamp_ns - arms[1].stamp_ns) < 10**9
    run = finished(arms, "the test is over")
    assert [arm.path for arm in run.arms] == [tmp_path / "runleft.mcap", tmp_path / "runright.mcap"]
    assert (run.reason, run.statistics["problems"]) == ("the test is over", [])
    for end in made:
        end.port.close()


def test_a_file_that_cannot_be_written_is_an_error_before_anything_moves(tmp_path: Path) -> None:
    made = ends(RIGHT)
    (tmp_path / "file").touch()
    with pytest.raises(LogError):
        assemble(made, [Limits.of(RIGHT)], Settings(), record=tmp_path / "file" / "run.mcap", **OPTIONS)
    made[0].port.close()
