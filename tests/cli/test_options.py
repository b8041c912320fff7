"""What was given to options: above zero and finite, or a sentence that names the option."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from armlab import log, robots
from armlab.bridge.urls import addresses
from armlab.cli import main
from armlab.cli.support.options import as_given, known_ports, links_to, ports_in, simulated
from armlab.errors import ConfigError, LogError, ShapeError, UnknownName
from armlab.sim.arm.arm import scara


def test_what_the_library_refuses_of_the_words_is_wrong_use() -> None:
    with pytest.raises(ConfigError, match=r"^Expected a goal\.$"), as_given():
        raise ShapeError("Expected a goal.")
    with pytest.raises(LogError), as_given():
        raise LogError("Expected a log.")


@pytest.fixture
def changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> robots.Robot:
    """An arm that has the name of another one, in "my arm?.toml" here."""
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
    with pytest.raises(ConfigError, match="one url per robot"):
        links_to("my arm?.toml", [changed], "egm://0.0.0.0,egm://0.0.0.0")
    assert links_to("scara", [scara()], "sim://scara?lockstep=true")
    assert links_to("a+b", [scara(), scara()], "egm://h:1,egm://h:2") == ["egm://h:1", "egm://h:2"]


def test_commands_simulate_the_file(changed: robots.Robot, capsys: Any) -> None:
    words = ["--link", "sim://my%20arm%3f.toml?lockstep=true", "--log", "home", "--seconds", "0.1"]
    assert main(["run", "my arm?.toml", *words]) == 0
    (path,) = Path().glob("home-*.mcap")
    assert log.read(path)["q"][0] == pytest.approx(changed.q_home, abs=1e-6)
    capsys.readouterr()
    for command, option in (("run", "--link"), ("excite", "--run")):
        assert main([command, "my arm?.toml", option, "sim://irb120"]) == 2
        assert "another arm" in capsys.readouterr().err


def test_typed_ports() -> None:
    assert ports_in("6511, 6512") == [6511, 6512]
    for wrong in ("", "egm", "6511,", "0", "65536", "-1", "6511.0", "\u0661"):
        with pytest.raises(ConfigError, match="--port 6511,6512, got"):
            ports_in(wrong)


def test_ports_of_the_settings_belong_to_robots(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    left, right = robots.load("yumi_left"), robots.load("yumi_right")
    assert known_ports([left]) == [6510]
    assert known_ports([left, right]) == [6511, 6512]
    Path("armlab.toml").write_text("[ports]\nyumi_right = 7000\n")
    assert known_ports([right]) == [7000]
    assert known_ports([left, right]) == [6511, 7000]
