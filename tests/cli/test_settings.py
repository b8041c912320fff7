"""UserSettings: which of several sources counts, and what is said of wrong ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.cli.support.settings import PREFIX, UserSettings, load_settings, log_folder, read_text, user_file
from armlab.errors import ConfigError


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of work, and one of the user's own settings; returns the latter."""
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
    assert told.settings == UserSettings(
        "cell.toml", str(home / "logs"), {"yumi_left": 7001, "yumi_right": 7002}, 0.5, "block"
    )
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
        ("speed = 2", r"<= 1\.0 - at `\$\.speed`"),
        ("sped = 1", "unknown field `sped`.*Known: cell, logs, ports, speed, wait"),
        ('wait = "never"', r"Invalid enum value 'never' - at `\$\.wait`"),
        ("[ports]\na = 70000", r"at `\$\.ports"),
        ("speed = \n", "Expected TOML in armlab.toml.*line 1"),
        ("\udcff", "no text in UTF-8"),
    ],
)
def test_wrong_files_get_one_line_with_the_place(text: str, said: str, home: Path) -> None:
    Path("armlab.toml").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ConfigError, match=said) as caught:
        load_settings({})
    assert "armlab.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "value"), [("SPEED", "fast"), ("SPED", "1"), ("PORTS", "6511"), ("PORTS", "a=b")])
def test_wrong_variables_are_named(name: str, value: str, home: Path) -> None:
    with pytest.raises(ConfigError, match=rf"in \$ARMLAB_{name}: "):
        load_settings({f"ARMLAB_{name}": value})


def test_the_folder_of_logs_is_made(home: Path, tmp_path: Path) -> None:
    assert log_folder() == Path()
    Path("armlab.toml").write_text('logs = "of/today"\n')
    assert log_folder().is_dir()
    assert (tmp_path / "work" / "of" / "today").is_dir()


def test_text_with_or_without_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes("\ufeffspeed = 1 # µ".encode())
    assert read_text(tmp_path / "a", "settings") == "speed = 1 # µ"
