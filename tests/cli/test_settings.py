"""Settings and option values: which source takes precedence, and the errors for invalid ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from armlab import robots
from armlab.bridge.urls import addresses
from armlab.cli.support.options import known_ports, links_to, ports_in, simulated
from armlab.cli.support.settings import PREFIX, UserSettings, load_settings, log_folder, read_text, user_file
from armlab.errors import ConfigError, UnknownName
from armlab.sim.arm.arm import scara


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "work").mkdir()
    (tmp_path / "own" / "armlab").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "own"))
    return tmp_path / "own" / "armlab"


def test_environment_before_folder_before_user(home: Path) -> None:
    (home / "armlab.toml").write_text('speed = 0.1\nwait = "block"\nlogs = "logs"\n')
    Path("armlab.toml").write_text('speed = 0.2\ncell = "cell.toml"\n[ports]\nyumi_left = 6511\n')
    variables = {
        "XDG_CONFIG_HOME": str(home.parent),
        f"{PREFIX}SPEED": "0.5",
        f"{PREFIX}PORTS": "yumi_left=7001, yumi_right=7002",
        "HOME": "/nowhere",
    }
    told = load_settings(variables)
    ports = {"yumi_left": 7001, "yumi_right": 7002}
    assert told.settings == UserSettings("cell.toml", str(home / "logs"), ports, 0.5, "block")
    user = str(user_file(variables))
    assert told.origins == {
        "cell": "armlab.toml", "logs": user, "ports": "$ARMLAB_PORTS", "speed": "$ARMLAB_SPEED", "wait": user,
    }  # fmt: skip
    assert load_settings({"XDG_CONFIG_HOME": str(home.parent)}).settings.speed == 0.2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('speed = "fast"', r"Expected `float`, got `str` - at `\$\.speed`"),
        ("speed = nan", r"> 0\.0 - at `\$\.speed`"),
        ("sped = 1", "unknown field `sped`.*Known: cell, logs, ports, speed, wait"),
        ('wait = "never"', r"Invalid enum value 'never' - at `\$\.wait`"),
        ("[ports]\na = 70000", r"at `\$\.ports"),
        ("speed = \n", "Expected valid TOML in armlab.toml.*line 1"),
        ("\udcff", "not UTF-8 text"),
    ],
)
def test_wrong_files_and_variables_get_one_line_with_the_place(text: str, said: str, home: Path) -> None:
    Path("armlab.toml").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ConfigError, match=said) as caught:
        load_settings({})
    assert "armlab.toml" in str(caught.value)
    assert "\n" not in str(caught.value)
    Path("armlab.toml").unlink()
    for name, value in (("SPEED", "fast"), ("SPED", "1"), ("PORTS", "6511"), ("PORTS", "a=b")):
        with pytest.raises(ConfigError, match=rf"in \$ARMLAB_{name}: "):
            load_settings({f"ARMLAB_{name}": value})


def test_the_folder_of_logs_is_made(home: Path, tmp_path: Path) -> None:
    assert log_folder() == Path()
    Path("armlab.toml").write_text('logs = "of/today"\n')
    assert log_folder().is_dir()
    assert (tmp_path / "work" / "of" / "today").is_dir()
    (tmp_path / "a").write_bytes("\ufeffspeed = 1 # µ".encode())
    assert read_text(tmp_path / "a", "settings") == "speed = 1 # µ", "without its byte order mark"


@pytest.fixture
def changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> robots.Robot:
    monkeypatch.chdir(tmp_path)
    irb120 = robots.load("irb120")
    arm = replace(irb120, q_home=irb120.q_home + 0.5)
    robots.save(arm, "my arm?.toml")
    return arm


def test_what_is_simulated_is_what_was_typed(changed: robots.Robot, tmp_path: Path) -> None:
    for typed in ("my arm?.toml", "./my arm?.toml", str(tmp_path / "my arm?.toml")):
        urls = links_to(typed, [changed], None)
        (address,) = addresses(urls, 1)
        assert simulated(address.robot) == changed
        assert links_to(typed, [changed], f"{urls[0]}?seed=1") == [f"{urls[0]}?seed=1"]
    assert links_to("yumi_left+yumi_right", [scara(), scara()], None) == ["sim://yumi_left+yumi_right"]


def test_another_arm_is_refused_also_of_the_same_name(changed: robots.Robot) -> None:
    with pytest.raises(ConfigError, match=r"to my arm\?.toml, got sim://irb120, .*sim://my%20arm"):
        links_to("my arm?.toml", [changed], "sim://irb120")
    with pytest.raises(UnknownName, match="yumi_right"):
        links_to("my arm?.toml", [changed], "sim://nobody")
    with pytest.raises(ConfigError, match="one URL per robot"):
        links_to("my arm?.toml", [changed], "egm://0.0.0.0,egm://0.0.0.0")
    assert links_to("scara", [scara()], "sim://scara?lockstep=true")
    assert links_to("a+b", [scara(), scara()], "egm://h:1,egm://h:2") == ["egm://h:1", "egm://h:2"]


def test_typed_ports() -> None:
    assert ports_in("6511, 6512") == [6511, 6512]
    for wrong in ("", "egm", "6511,", "0", "65536", "-1", "6511.0", "\u0661"):
        with pytest.raises(ConfigError, match="--port 6511,6512, got"):
            ports_in(wrong)


def test_ports_of_the_settings_belong_to_robots(home: Path) -> None:
    left, right = robots.load("yumi_left"), robots.load("yumi_right")
    assert known_ports([left]) == [6510]
    assert known_ports([left, right]) == [6511, 6512]
    Path("armlab.toml").write_text("[ports]\nyumi_right = 7000\n")
    assert known_ports([right]) == [7000]
    assert known_ports([left, right]) == [6511, 7000]


CELL = """
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
speed = 0.3
"""


def test_settings_and_cell_with_their_origins(home: Path, command, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("cell.toml").write_text(CELL)
    Path("armlab.toml").write_text("speed = 0.2\n")
    monkeypatch.setenv("ARMLAB_WAIT", "block")
    before = {path: path.read_bytes() for path in Path().iterdir()}
    said = command(["config", "show", "--origin", "--config", "cell.toml"]).out
    rows = {line.split()[0]: line.split()[1:] for line in said.splitlines()[1:]}
    assert rows["speed"] == ["0.2", "armlab.toml"]
    assert rows["wait"] == ['"block"', "$ARMLAB_WAIT"]
    assert rows["logs"] == ['"."', "default"]
    assert rows["cell"] == ['"cell.toml"', "--config"]
    assert rows["cell.robots[0].speed"] == ["0.3", "cell.toml"]
    assert rows["cell.robots[0].extension"] == ["false", "default"]
    assert rows["cell.name"] == ['"cell"', "default"]
    assert {path: path.read_bytes() for path in Path().iterdir()} == before
    Path("armlab.toml").write_text('cell = "cell.toml"\n')
    told = json.loads(command(["config", "show", "--json"]).out)
    found = {one["name"]: (one["value"], one["origin"]) for one in told}
    assert found["cell"] == ("cell.toml", "armlab.toml")
    assert found["cell.robots[0].link"] == ("sim://yumi_left", "cell.toml")
    assert "speed                     1.0\n" in command(["config", "show"]).out
