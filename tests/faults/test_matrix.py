"""The matrix: every cell has a test that is there, and the page shows them all."""

from __future__ import annotations

import ast
import runpy
from dataclasses import replace
from pathlib import Path

import pytest

from .matrix import KINDS, NO_WORDS, STATES, Cell

ROOT = Path(__file__).parents[2]
MOVING = {"waiting", "holding", "running", "stopping"}


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[str, ...]]]:
    """The rows of the page by kind."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "docs" / "_ext")
        extension = runpy.run_path(str(ROOT / "docs" / "_ext" / "fault_table.py"))
    return {kind: extension["rows"](kind) for kind in KINDS}


def test_every_test_on_the_page_is_there(page: dict[str, list[tuple[str, ...]]]) -> None:
    nodes = {row[-1] for rows in page.values() for row in rows}
    assert len(nodes) > 25
    for node in nodes:
        path, _, name = node.partition("::")
        assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8"), node


def test_a_test_elsewhere_looks_for_the_words_of_its_row(page: dict[str, list[tuple[str, ...]]]) -> None:
    """As far as its text tells: the words between the gaps are in it, or in what it names of its file."""
    for rows in page.values():
        for *_, told, _, node in rows:
            path, _, name = node.partition("::")
            if told == NO_WORDS or path.startswith("tests/faults/"):
                continue
            text = said(ast.parse((ROOT / path).read_text(encoding="utf-8")), name)
            assert all(words.strip() in text for words in told.split("…")), f"{node} does not look for {told!r}"


def said(module: ast.Module, name: str) -> str:
    """Return the texts in a function and in the functions and constants of its file that it names, but docstrings."""
    named = {one.name: one for one in module.body if isinstance(one, ast.FunctionDef | ast.ClassDef)}
    constants = {
        target.id: one
        for one in module.body
        if isinstance(one, ast.Assign)
        for target in one.targets
        if isinstance(target, ast.Name)
    }
    found, todo = {name}, [named[name]]
    texts = []
    while todo:
        for one in ast.walk(todo.pop()):
            if isinstance(one, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(one) is not None:
                del one.body[0]
            if isinstance(one, ast.Constant) and isinstance(one.value, str):
                texts.append(one.value.replace("\\", ""))  # of patterns
            if isinstance(one, ast.Name) and one.id not in found and one.id in (named | constants):
                found.add(one.id)
                todo.append((named | constants)[one.id])
    return "\n".join(texts)


def test_the_page_has_a_section_for_each_kind(page: dict[str, list[tuple[str, ...]]]) -> None:
    text = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    for kind in KINDS:
        assert page[kind]
        assert f"```{{faults}} {kind}\n" in text


def test_network_and_clock_faults_meet_every_state(page: dict[str, list[tuple[str, ...]]]) -> None:
    covered: dict[str, set[str]] = {}
    for fault, states, *_, test in page["network"] + page["clock"]:
        if test.startswith("tests/faults"):
            covered.setdefault(fault, set()).update(states.split(", "))
    missing = {fault: MOVING - states for fault, states in covered.items() if MOVING - states}
    assert missing == {"the system refuses to send": {"waiting"}}, "nothing is sent while it waits"


def test_no_cell_is_there_twice(page: dict[str, list[tuple[str, ...]]]) -> None:
    found = [(fault, state) for rows in page.values() for fault, states, *_ in rows for state in states.split(", ")]
    assert len(found) == len(set(found))
    assert {state for _, state in found} == set(STATES)


def test_words_with_a_gap() -> None:
    cell = Cell("disk", "is full", "running", "it ends", "stopped after … rows: full.", "again", "test")
    assert cell.is_told("The log stopped after 12 rows: full.")
    assert not cell.is_told("The log stopped after 12 rows. full.")
    assert not cell.is_told("")
    assert str(cell) == "is full, running"
    cell = replace(cell, told="missed N, late")
    assert cell.is_told("Packets 20, missed 10, late 0.")
    assert not cell.is_told("Packets 20, missed 0, late 1.")
