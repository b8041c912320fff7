"""The parity table is true: names in rows marked done can be imported, and their tests exist."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "parity.md"
TESTS = ROOT / "tests"
STATES = ("done", "planned", "–")


class Row(NamedTuple):
    original: str
    names: tuple[str, ...]
    state: str
    tests: tuple[str, ...]


def rows(text: str) -> list[Row]:
    """Return the rows of all tables; heads and rulers left out."""
    found = []
    for line in text.splitlines():
        if not line.startswith("|") or line.startswith(("|---", "| original")):
            continue
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert len(cells) == 4, f"expected 4 cells: {line}"
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


ROWS = rows(PAGE.read_text(encoding="utf-8"))
DONE = [row for row in ROWS if row.state == "done"]


def test_every_row_has_a_known_state() -> None:
    assert len(ROWS) > 80
    assert not [row.original for row in ROWS if row.state not in STATES]


def test_what_is_done_exists() -> None:
    for row in DONE:
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
        if row.state != "planned" or not row.names:
            continue
        for name in row.names:
            try:
                resolve(name)
            except (ModuleNotFoundError, AttributeError):
                break
        else:
            pytest.fail(f"{row.original}: {row.names} exist; is the row done?")


def test_the_reader_sees_what_it_must_see() -> None:
    text = "| original | armlab | state | test |\n|---|---|---|---|\n| a, b | `armlab.x.y`, word | done | `x.py` |\n"
    assert rows(text) == [Row("a, b", ("armlab.x.y",), "done", ("x.py",))]
    with pytest.raises((ModuleNotFoundError, AttributeError)):
        resolve("armlab.lie.so3.no_such_name")
    with pytest.raises((ModuleNotFoundError, AttributeError)):
        resolve("armlab.no_such_package.name")
