"""armlab config show: every value with where it came from; nothing is written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from armlab.cli import main

CELL = """
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
speed = 0.3
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    Path("cell.toml").write_text(CELL)
    return tmp_path


def test_settings_and_cell_with_their_origins(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("armlab.toml").write_text("speed = 0.2\n")
    monkeypatch.setenv("ARMLAB_WAIT", "block")
    before = {path: path.read_bytes() for path in Path().iterdir()}
    assert main(["config", "show", "--origin", "--config", "cell.toml"]) == 0
    rows = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()[1:]}
    assert rows["speed"] == ["0.2", "armlab.toml"]
    assert rows["wait"] == ['"block"', "$ARMLAB_WAIT"]
    assert rows["logs"] == ['"."', "default"]
    assert rows["cell"] == ['"cell.toml"', "--config"]
    assert rows["cell.robots[0].speed"] == ["0.3", "cell.toml"]
    assert rows["cell.robots[0].extension"] == ["false", "default"]
    assert rows["cell.name"] == ['"cell"', "default"]
    assert {path: path.read_bytes() for path in Path().iterdir()} == before


def test_json_holds_the_same(command) -> None:
    Path("armlab.toml").write_text('cell = "cell.toml"\n')
    found = {
        one["name"]: (one["value"], one["origin"]) for one in json.loads(command(["config", "show", "--json"]).out)
    }
    assert found["cell"] == ("cell.toml", "armlab.toml")
    assert found["cell.robots[0].link"] == ("sim://yumi_left", "cell.toml")
    assert "speed                     1.0\n" in command(["config", "show"]).out
