"""Help is wrapped to the terminal, whatever the line breaks of a docstring are."""

from __future__ import annotations

import pytest

from armlab.cli import main
from armlab.cli.shell import WrappedHelp, unwrapped


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("one\ntwo", "one two"),
        ("one\n\ntwo\nthree", "one\n\ntwo three"),
        ("steps:\n- a\n- b\nand c", "steps:\n- a\n- b and c"),
        ("code:\n    x = 1\n", "code:\n    x = 1 "),
        ("", ""),
    ],
)
def test_paragraphs_are_one_line(text: str, expected: str) -> None:
    assert unwrapped(text) == expected


@pytest.mark.parametrize("columns", [60, 160])
def test_help_fills_the_terminal(
    columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    assert main(["run", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= columns
    first = next(line for line in lines if line.startswith("The file needs"))
    assert len(first) > columns - 15


def test_the_look_is_that_of_cyclopts() -> None:
    assert all(hasattr(WrappedHelp, name) for name in ("render_usage", "render_description", "__call__"))
