"""Basics of the command line: exit codes, one-line errors, `--debug`."""

from __future__ import annotations

import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from armlab import cli
from armlab._interrupts import deferred
from armlab.errors import LogError


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (LogError("Expected a log, got a cat."), 1, "armlab: Expected a log, got a cat.\n"),
        (FileNotFoundError(2, "No such file or directory", "a.mcap"), 1, "No such file or directory: a.mcap."),
        (OSError(28, "No space left on device"), 1, "armlab: No space left on device.\n"),
        (ZeroDivisionError("division by zero"), 1, "internal error, ZeroDivisionError: division by zero"),
        (KeyboardInterrupt(), 130, "armlab: interrupted.\n"),
    ],
)
def test_errors_become_sentences(
    error: BaseException, code: int, said: str, monkeypatch: pytest.MonkeyPatch, command
) -> None:
    def fail(_words: list[str]) -> int:
        raise error

    monkeypatch.setattr(cli, "_run", fail)
    captured = command(["demo"], code).err
    assert said in captured
    assert "Traceback" not in captured
    assert ("Traceback" in command(["demo", "--debug"], code).err) is not isinstance(error, KeyboardInterrupt)


def test_an_interrupt_while_a_compiled_module_loads(monkeypatch: pytest.MonkeyPatch, command) -> None:
    def fail(_words: list[str]) -> int:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise ImportError("initialization failed")

    monkeypatch.setattr(cli, "_run", fail)
    assert command(["sim"], cli.INTERRUPTED).err == "armlab: interrupted.\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_deferred_interrupts_act_when_the_block_has_ended(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached: list[str] = []

    def busy(_words: list[str]) -> int:
        with deferred():
            signal.raise_signal(number)
            reached.append("end of the block")
        reached.append("behind it")
        return 0

    monkeypatch.setattr(cli, "_run", busy)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    assert cli.main([]) == cli.INTERRUPTED
    assert reached == ["end of the block"]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_termination_is_an_interrupt(number: signal.Signals, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "_run", lambda _words: signal.raise_signal(number))
    before = signal.getsignal(number)
    assert cli.main([]) == cli.INTERRUPTED
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("columns", [60, 160])
def test_help_fills_the_terminal(columns: int, command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = command(["run", "--help"]).out.splitlines()
    assert max(map(len, lines)) <= columns
    first = next(line for line in lines if line.startswith("The file defines"))
    assert len(first) > columns - 15


@pytest.mark.parametrize(("verb", "of_a_robot"), [
    ("demo", True), ("robot show", True), ("fleet identify", True), ("plot robot", True), ("sim", True),
    ("dmp play", True), ("monitor", False), ("log show", False),
])  # fmt: skip
def test_the_help_of_a_verb_that_takes_a_robot_names_the_options_of_a_urdf(
    verb: str, of_a_robot: bool, command
) -> None:
    said = command([*verb.split(), "--help"]).out
    assert all((option in said) == of_a_robot for option in ("--tip LINK", "--base LINK", "--lock JOINT=VALUE"))


def completed(script: Path, *words: str) -> list[str]:
    typed = " ".join(f"'{word}'" for word in words)
    code = (
        f"source {script}; COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}; "
        "_armlab armlab; printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.split()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash on this computer")
def test_bash_completes_verbs_subcommands_options_and_values(command, tmp_path: Path) -> None:
    script = tmp_path / "armlab"
    script.write_text(command(["completion", "bash"]).out)
    subprocess.run(["bash", "-n", str(script)], check=True, timeout=60)
    assert completed(script, "armlab", "i") == ["identify"]
    assert set(completed(script, "armlab", "robot", "")) >= {"list", "show", "convert"}
    assert completed(script, "armlab", "identify", "--grav") == ["--gravity-only"]
    assert completed(script, "armlab", "identify", "--method", "w") == ["wls"]


@pytest.mark.slow  # 2 s
@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells(shell: str, command, tmp_path: Path) -> None:
    text = command(["completion", shell]).out
    assert "armlab" in text
    assert "identify" in text
    if program := shutil.which(shell):
        (tmp_path / "script").write_text(text)
        subprocess.run([program, "-n", str(tmp_path / "script")], check=True, timeout=60)
