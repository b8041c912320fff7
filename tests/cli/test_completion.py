"""armlab completion: scripts that shells take, and that complete verbs, subcommands and options."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from armlab.cli import main


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The script for bash, in a file."""
    import contextlib

    path = tmp_path_factory.mktemp("completion") / "armlab"
    with path.open("w") as file, contextlib.redirect_stdout(file):
        assert main(["completion", "bash"]) == 0
    return path


def completed(script: Path, *words: str) -> list[str]:
    """Return what bash offers for the last word."""
    typed = " ".join(f"'{word}'" for word in words)
    code = (
        f"source {script}; COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}; "
        "_armlab armlab; printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash on this computer")
def test_bash_completes_verbs_subcommands_options_and_values(script: Path) -> None:
    subprocess.run(["bash", "-n", str(script)], check=True, timeout=60)
    assert completed(script, "armlab", "i") == ["identify"]
    assert set(completed(script, "armlab", "")) >= {"demo", "sim", "run", "record", "bridge", "robot", "config"}
    assert set(completed(script, "armlab", "robot", "")) >= {"list", "show", "convert"}
    assert completed(script, "armlab", "identify", "--grav") == ["--gravity-only"]
    assert completed(script, "armlab", "identify", "--method", "w") == ["wls"]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells(shell: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert "armlab" in text
    assert "identify" in text
    program = shutil.which(shell)
    if program:
        (tmp_path / "script").write_text(text)
        subprocess.run([program, "-n", str(tmp_path / "script")], check=True, timeout=60)


def test_another_shell_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "cmd"]) == 2
    assert "bash" in capsys.readouterr().err
