"""The page of the ancestor's defects is true: every test that it names exists, and every row names one."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

TESTS = Path(__file__).parents[1]
PAGE = TESTS.parent / "docs" / "decisions" / "ancestor.md"
NAMED = re.compile(r"`([\w/]+\.py)::([\w:]+)`")


def rows(text: str) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the first cell of every row with the tests in its last."""
    lines = (line for line in text.splitlines() if line.startswith("|") and not line.startswith(("|---", "| defect")))
    cells = ([cell.strip() for cell in line.strip("|").split(" | ")] for line in lines)
    return [(row[0].strip("| "), NAMED.findall(row[-1])) for row in cells]


@cache
def statements(path: str) -> list[ast.stmt]:
    return ast.parse((TESTS / path).read_text(encoding="utf-8")).body


def exists(path: str, name: str) -> bool:
    """Return whether a file of tests has a function, or a class with a method."""
    if not (TESTS / path).is_file():
        return False
    body = statements(path)
    for part in name.split("::"):
        found = [node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == part]
        if not found:
            return False
        body = found[0].body
    return name.split("::")[-1].startswith("test_")


ROWS = rows(PAGE.read_text(encoding="utf-8"))


def test_all_ten_groups_are_there() -> None:
    assert len(ROWS) >= 45


def test_every_defect_has_a_test_that_exists() -> None:
    assert not [defect for defect, tests in ROWS if not tests], "a row names a test"
    assert not [f"{path}::{name}" for _, tests in ROWS for path, name in tests if not exists(path, name)]


def test_the_reader_sees_what_it_must_see() -> None:
    text = "| defect | here | tests |\n|---|---|---|\n| a | b | `x.py::test_y`, `z.py::C::test_w` |\n"
    assert rows(text) == [("a", [("x.py", "test_y"), ("z.py", "C::test_w")])]
    assert exists("style/test_defects.py", "test_all_ten_groups_are_there")
    assert not exists("style/test_defects.py", "test_that_does_not_exist")
    assert not exists("style/no_such_file.py", "test_x")
