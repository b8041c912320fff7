"""Cells: the file and its errors. Whole bridges are in `test_cell_runs`."""

from __future__ import annotations

import contextlib
import os
import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import models, robots
from armlab.bridge.cell import Cell, parse_cell, run_cell
from armlab.bridge.servers.labcomm import LabCommSource
from armlab.bridge.servers.local import socket_path
from armlab.bridge.servers.local_server import _listen
from armlab.errors import ConfigError, LinkError
from armlab.models import ForceSensor

HOME = np.array(robots.load("yumi_left").q_home)


def test_a_cell(cell_text: str) -> None:
    cell = parse_cell(cell_text)
    assert cell.text == cell_text
    assert isinstance(cell, Cell)
    assert (cell.name, cell.commands, cell.links) == ("yumi", ("local",), ("sim://yumi_left?lockstep=true",))
    assert [one.name for one in cell.parameters] == ["gain", "gentle"]
    assert list(cell.servers) == ["local", "labcomm"]
    assert cell.servers["labcomm"]["arms"] == {"yumi_left": {"port": 0, "axes": [1, 2, 7, 3, 4, 5, 6]}}
    np.testing.assert_allclose(cell.limits[0].qd_max, 0.5 * cell.robots[0].qd_max)


def test_two_arms_have_the_ports_of_the_ancestor() -> None:
    cell = parse_cell(
        'pace = "yumi_right"\n[[robots]]\nname="yumi_left"\nlink="egm://127.0.0.1:6511"\n'
        '[[robots]]\nname="yumi_right"\nlink="egm://127.0.0.1:6512"\n[servers.labcomm]\n'
        "types='sample struct { double pos[7]; } state;'\n"
        "[sources.force]\nperiod=0.004\nport=0\n[sources.force.fields.wrench_raw]\nshape=[6]\n"
        "[sources.far]\nkind='labcomm'\nsample='robot_row'\nperiod=0.004\nport=7511\n"
        "[sources.far.fields.trq]\nshape=[7]\nunit='N m'"
    )
    labcomm = cell.servers["labcomm"]
    assert [arm["port"] for arm in labcomm["arms"].values()] == [7511, 7512]
    assert (labcomm["parameters"], labcomm["fused"], cell.pace) == (7513, 7514, "yumi_right")
    assert "state" in labcomm["types"]
    force, far = cell.sources()
    assert (force.name, force.fields["wrench_raw"].unit) == ("force", "N, N m")
    assert isinstance(far, LabCommSource)


def test_a_force_sensor_with_its_calibration(cell_text: str, tmp_path: Path) -> None:
    arm, path = robots.load("yumi_left"), tmp_path / "force.toml"
    sensor = ForceSensor(np.eye(3), 0.8, np.zeros(3), np.zeros(6), robot_name=arm.name, robot_hash=arm.hash)
    models.save(sensor, path)
    text = f"{cell_text}[sources.force]\nperiod=0.004\nport=0\ncalibration='{path}'\nfields.wrench_raw.shape=[6]\n"
    (source,) = parse_cell(text).sources()
    assert source.calibration is not None
    assert (source.calibration.mass, source.robot) == (0.8, "yumi_left")
    models.save(replace(sensor, robot_hash="other"), path)
    with pytest.raises(ConfigError, match=r"cell\.toml: .*to be of a robot of this run"):
        parse_cell(text)
    path.unlink()
    with pytest.raises(ConfigError, match=r"cell\.toml: .*force\.toml, got: No such file"):
        parse_cell(text)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "yumi"', "name = 3", r"Expected `str`, got `int` - at `\$.name`"),
        ('name = "yumi"', 'name = "../x"', r"regex.*\$.name"),
        ('name = "yumi"', "nam = 1", "unknown field `nam`"),
        ('name = "yumi"', "name =", "Expected TOML in cell.toml.*line 2"),
        ('"local"]', '"ros9"]', "Invalid enum value 'ros9'"),
        ('"local"]', '"labcomm", "local"]\npace = "ur5e"', "robot of this cell"),
        ('name = "yumi_left"', 'name = "yumi_lef"', "yumi_left"),
        ("speed = 0.5", "speed = 2.0", r"speed in \(0, 1\]"),
        ("speed = 0.5", "torque = true", r"got `bool` - at `\$.robots\[0\].torque`"),
        ("speed = 0.5", "torque = -1.0", "positive and within its limits, got -1.0"),
        ("speed = 0.5", "torque = [1.0, 2.0]", "one number or 7"),
        (
            'sim://yumi_left?lockstep=true"',
            'egm://127.0.0.1:6510"\ntorque = 5.0',
            "carries torques to yumi_left.*extension",
        ),
        ('sim://yumi_left?lockstep=true"', 'labcomm://h"\nextension = true\ntorque = 5.0', "carries torques"),
        ("speed = 0.5", 'speed = "fast"', r"Expected `float`, got `str` - at `\$.robots\[0\].speed`"),
        ("default = 2.0", "default = 20.0", "from 0 to 10"),
        ("{yumi_left = 0}", "{yumi_right = 0}", "robot of this cell"),
        ("parameters = 0", "parameters = 7514\nrows = 7514", "Cannot overwrite"),
        ("{yumi_left = 0}\nparameters = 0\nrows = 0", "{yumi_left = 7513}", "a LabComm port of its own"),
        ("{yumi_left = 0}", "{yumi_left = 70000}", "65535"),
        ("[servers.labcomm]", '[sources.a]\nperiod=0.0\nport=0\nfields.x.unit="1"\n[servers.labcomm]', "above 0 s"),
    ],
)
def test_errors_are_one_line_with_the_path(cell_text: str, old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        parse_cell(cell_text.replace(old, new))
    assert "\n" not in str(caught.value)
    assert "cell.toml" in str(caught.value)


def test_two_arms_are_commanded_under_a_name_that_neither_has() -> None:
    text = 'name = "yumi_left"\n[[robots]]\nname = "yumi_left"\nlink = "sim://yumi_left"\n'
    assert parse_cell(text).name == "yumi_left"
    with pytest.raises(ConfigError, match="that none of its robots has, got yumi_left"):
        parse_cell(f'{text}[[robots]]\nname = "yumi_right"\nlink = "sim://yumi_right"\n')


def test_a_server_that_commands_must_be_enabled() -> None:
    with pytest.raises(ConfigError, match=r"got labcomm. Add \[servers.labcomm\]"):
        parse_cell('commands=["labcomm"]\n[[robots]]\nname="ur5e"\nlink="egm://127.0.0.1:6510"')


def test_ros_2_in_a_domain() -> None:
    text = 'commands=["ros2"]\n[[robots]]\nname="ur5e"\nlink="egm://127.0.0.1:6510"\n[servers.ros2]\n'
    assert parse_cell(text).servers["ros2"] == {"domain": None}
    assert parse_cell(f"{text}domain = 7").servers["ros2"] == {"domain": 7}
    with pytest.raises(ConfigError, match=r"servers\.ros2\.domain"):
        parse_cell(f"{text}domain = 233")


def test_a_second_bridge_refuses_at_once(cell_text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says which port and who has it, and no robot has been connected by then."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("armlab.bridge.cell.connect", lambda *words, **options: pytest.fail("a robot was connected"))
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        cell = parse_cell(cell_text.replace("{yumi_left = 0}", f"{{yumi_left = {port}}}"))
        words = (
            rf"server labcomm to listen.* TCP port 127.0.0.1:{port} for yumi_left .* by process {os.getpid()} \(.*\)"
        )
        with pytest.raises(LinkError, match=words) as caught:
            run_cell(cell)
    assert "\n" not in str(caught.value)
    with contextlib.closing(_listen(socket_path("yumi"))):
        words = rf"server local to listen.*yumi.sock, but one runs: process {os.getpid()} \("
        with pytest.raises(LinkError, match=words):
            run_cell(parse_cell(cell_text))


def test_torque_is_allowed_arm_by_arm_with_a_bound(cell_text: str) -> None:
    cell = parse_cell(cell_text)
    assert (cell.torque, cell.limits[0].tau_max) == ((), None)
    cell = parse_cell(cell_text.replace("speed = 0.5", "speed = 0.5\ntorque = 5.0"))
    assert cell.torque == ("yumi_left",)
    np.testing.assert_array_equal(cell.limits[0].tau_max, np.full(7, 5.0))  # type: ignore[arg-type]
    each = "extension = true\ntorque = [8, 8, 8, 4, 2, 2, 2]"
    cell = parse_cell(
        cell_text.replace("sim://yumi_left?lockstep=true", "egm://127.0.0.1:6510").replace("speed = 0.5", each)
    )
    assert cell.extension
    np.testing.assert_array_equal(cell.limits[0].tau_max, [8, 8, 8, 4, 2, 2, 2])  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="positive and within its limits, got 200"):
        parse_cell('[[robots]]\nname = "ur5e"\nlink = "sim://ur5e"\ntorque = 200.0')
