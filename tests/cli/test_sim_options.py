"""Groups of options of `armlab sim`."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from armlab import robots
from armlab.cli.sim import Around, Content, FaultOptions, pair
from armlab.errors import ConfigError, UnknownName
from armlab.sim.fault_rates import FaultRates

ROBOT = robots.load("yumi_right")


def test_faults() -> None:
    rates = FaultOptions(loss=0.1, delay="0.01, 0.002", pause="5,0.5", burst=3).rates()
    assert (rates.loss, rates.delay, rates.pause, rates.burst) == (0.1, (0.01, 0.002), (5.0, 0.5), 3)
    assert not FaultOptions().rates().any


@pytest.mark.parametrize("text", ["1", "1,2,3", "a,b", ""])
def test_pairs_that_are_none(text: str) -> None:
    with pytest.raises(ConfigError, match="--delay"):
        pair("delay", text)
    with pytest.raises(ConfigError, match="--delay"):
        FaultOptions(delay=text).rates()


def test_names_or_axes() -> None:
    assert Content().names(["a", "b"], 2) == ("a", "b")
    assert Content(axes="7").names([], 2) == ("yumi_right", "yumi_right")
    assert Content(fields=" time,planned ").left_out == ["time", "planned"]
    with pytest.raises(ConfigError, match="both"):
        Content(axes="6").names(["yumi_left"], 1)


def test_values_that_rapid_sends_back() -> None:
    assert Content(rapid_data=40, robotware="7").rapid_data == 40
    for content in ({"rapid_data": 1}, {"rapid_data": 41, "robotware": "7"}, {"rapid_data": -1, "robotware": "7"}):
        with pytest.raises(ConfigError, match="--rapid-data from 0 to 40"):
            Content(**content)


def test_around_the_arms(tmp_path: Path) -> None:
    push = tmp_path / "push.csv"
    push.write_text("t,fx,fy,fz,mx,my,mz\n0,1,0,0,0,0,0\n9,1,0,0,0,0,0\n", encoding="utf-8")
    around = Around(operator=push, motors="0:on,2:off", rapid="undefined")
    first, second = (around.scene(ROBOT, index, [0, index], 1) for index in (0, 1))
    assert first.operator.at(1.0) is not None
    assert second.operator.at(1.0) is None, "the files are for the first robot"
    assert first.hand is not None
    assert (first.motors.at(3.0), first.rapid.at(3.0), first.external) == (2, 0, 1)
    with pytest.raises(UnknownName, match="off"):
        Around(motors="aus").scene(ROBOT, 0, [0], 0)


def test_the_help_of_faults_is_that_of_the_rates() -> None:
    """Written once, with the same defaults."""
    assert FaultOptions().rates() == FaultRates()
    assert [field.name for field in fields(FaultOptions)] == [field.name for field in fields(FaultRates)]
    text = FaultOptions.__doc__ or ""
    for field in fields(FaultRates):
        assert f"    {field.name} : " in text
    assert "Raises" not in text


def test_a_grip_holds_the_first_robot_only() -> None:
    robot = robots.load("yumi_right")
    first, second = (Around(grip="1,3").scene(robot, index, [0, index], 0) for index in (0, 1))
    assert first.grip is not None
    assert second.grip is None
    with pytest.raises(ConfigError, match="--grip"):
        Around(grip="soon").scene(robot, 0, [0, 0], 0)
