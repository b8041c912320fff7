"""The explained survivors of mutation testing still match the sources. `make mutants` runs it."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
SURVIVORS = tomllib.loads((ROOT / "mutation" / "survivors.toml").read_text(encoding="utf-8"))["survivor"]


def functions(node: ast.AST, above: str = "") -> list[str]:
    """Return the qualified names of classes and functions, and "" for the module."""
    found = [above]
    for one in ast.iter_child_nodes(node):
        if isinstance(one, ast.ClassDef | ast.FunctionDef):
            found += functions(one, f"{above}.{one.name}".lstrip("."))
    return found


def test_each_survivor_points_at_lines_that_stand_once_in_its_file() -> None:
    """Fails when an explained line is edited, because its mutants change and need another review."""
    assert SURVIVORS
    for one in SURVIVORS:
        source = (ROOT / one["file"]).read_text(encoding="utf-8")
        lines = " ".join(line.strip() for line in source.splitlines())
        assert lines.count(one["before"]) == 1, one
        is_python = one["file"].endswith(".py")
        assert one["where"] in (functions(ast.parse(source)) if is_python else source), one
        assert one["after"] != one["before"], one
        assert one["why"], one
    assert len({(one["file"], one["where"], one["before"], one["after"]) for one in SURVIVORS}) == len(SURVIVORS)
