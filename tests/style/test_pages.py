"""Pages that name files, functions and tests are correct: parity, defects of the ancestors, architecture, security."""

from __future__ import annotations

import ast
import re
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pytest

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent
DOCS = ROOT / "docs"
STATES = ("done", "planned", "–")
NAMED = re.compile(r"`([\w/]+\.py)::([\w:]+)`")


def table(page: Path | str, head: str) -> list[list[str]]:
    """Return the cells of all tables of a page, without separator rows and header rows (which start with `head`)."""
    text = page if isinstance(page, str) else page.read_text(encoding="utf-8")
    lines = (line for line in text.splitlines() if line.startswith("|") and not line.startswith(("|---", f"| {head}")))
    return [[cell.strip("| ") for cell in line.strip("|").split(" | ")] for line in lines]


def test_architecture_and_security_name_files_that_exist() -> None:
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:src/armlab|tests|native|docs|soak|benchmarks)/[\w./]+)`", text))
    named |= {f"src/armlab/{path}" for path in re.findall(r"`((?:bridge|log|wire)/[\w./]+\.py)`", text)}
    assert len(named) > 30
    of_security = re.findall(r"`(tests/[^`]+)`", (DOCS / "security.md").read_text(encoding="utf-8"))
    assert len(of_security) > 10
    assert not [path for path in [*sorted(named), *of_security] if not (ROOT / path).exists()]


@cache
def statements(path: str) -> list[ast.stmt]:
    return ast.parse((TESTS / path).read_text(encoding="utf-8")).body


def exists(path: str, name: str) -> bool:
    """Return whether a test file has a function, or a class with a method."""
    if not (TESTS / path).is_file():
        return False
    body = statements(path)
    for part in name.split("::"):
        found = [node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == part]
        if not found:
            return False
        body = found[0].body
    return name.split("::")[-1].startswith("test_")


def test_every_defect_of_the_ancestors_has_a_test_that_exists() -> None:
    rows = [(cells[0], NAMED.findall(cells[-1])) for cells in table(DOCS / "decisions" / "ancestor.md", "defect")]
    assert len(rows) >= 45
    assert not [defect for defect, tests in rows if not tests], "a row names a test"
    assert not [f"{path}::{name}" for _, tests in rows for path, name in tests if not exists(path, name)]


class Row(NamedTuple):
    """One line of the parity table."""

    original: str
    names: tuple[str, ...]
    state: str
    tests: tuple[str, ...]


def parity(page: Path | str) -> list[Row]:
    found = []
    for cells in table(page, "original"):
        original, armlab, state, test = cells
        names = tuple(name for name in re.findall(r"`([^`]+)`", armlab) if re.fullmatch(r"armlab(\.\w+)+", name))
        found.append(Row(original, names, state, tuple(re.findall(r"`([^`]+)`", test))))
    return found


def resolve(name: str) -> Any:
    """Import a dotted name: the longest module of it, then attributes."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            thing = import_module(".".join(parts[:end]))
        except ModuleNotFoundError as error:
            if not name.startswith(str(error.name)):
                raise
            continue
        for part in parts[end:]:
            thing = getattr(thing, part)
        return thing
    raise ModuleNotFoundError(name)


ROWS = parity(DOCS / "parity.md")


def test_what_is_done_exists() -> None:
    assert len(ROWS) > 80
    assert not [row.original for row in ROWS if row.state not in STATES]
    for row in ROWS:
        if row.state != "done":
            continue
        assert row.names, f"{row.original}: a row that is done names its place"
        assert row.tests, f"{row.original}: a row that is done names its test"
        assert not [test for test in row.tests if not (TESTS / test).is_file()], row.original
        tested = "".join((TESTS / test).read_text(encoding="utf-8") for test in row.tests)
        for name in row.names:
            assert resolve(name) is not None
            last = name.rpartition(".")[2]
            assert re.search(rf"\b{last}\b", tested), f"{last} does not appear in {', '.join(row.tests)}"


def test_what_is_planned_does_not_exist_yet() -> None:
    """A function that has been written is marked done in the same commit."""
    for row in ROWS:
        if row.state == "planned" and row.names:
            with pytest.raises((ModuleNotFoundError, AttributeError)):
                [resolve(name) for name in row.names]


def test_the_readers_see_what_they_must_see() -> None:
    text = "| original | armlab | state | test |\n|---|---|---|---|\n| a, b | `armlab.x.y`, word | done | `x.py` |\n"
    assert parity(text) == [Row("a, b", ("armlab.x.y",), "done", ("x.py",))]
    for name in ("armlab.lie.so3.no_such_name", "armlab.no_such_package.name"):
        with pytest.raises((ModuleNotFoundError, AttributeError)):
            resolve(name)
    [[*_, tests]] = table("| defect | here |\n|---|---|\n| a | `x.py::test_y`, `z.py::C::test_w` |\n", "defect")
    assert NAMED.findall(tests) == [("x.py", "test_y"), ("z.py", "C::test_w")]
    assert exists("style/test_pages.py", "test_what_is_done_exists")
    assert not exists("style/test_pages.py", "test_that_does_not_exist")
    assert not exists("style/no_such_file.py", "test_x")
