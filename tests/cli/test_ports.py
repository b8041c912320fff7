"""UDP ports: typed, or those of the settings."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab import robots
from armlab.cli.support.options import known_ports, ports_in
from armlab.errors import ConfigError


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
