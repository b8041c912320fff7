"""The matrix: every cell has an existing test, and the page shows all cells."""

from __future__ import annotations

import runpy
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
    text = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    assert all(page[kind] and f"```{{faults}} {kind}\n" in text for kind in KINDS)
    nodes = {row[-1] for rows in page.values() for row in rows}
    assert len(nodes) > 25
    for node in nodes:
        path, _, name = node.partition("::")
        assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8"), node


def test_a_test_elsewhere_looks_for_the_words_of_its_row(page: dict[str, list[tuple[str, ...]]]) -> None:
    """Checked by text search: the words between the gaps occur in the test's file."""
    for rows in page.values():
        for *_, told, _, node in rows:
            path = node.partition("::")[0]
            if told == NO_WORDS or path.startswith("tests/faults/"):
                continue
            text = (ROOT / path).read_text(encoding="utf-8").replace("\\", "")  # of patterns
            assert all(words.strip() in text for words in told.split("…")), f"{node} does not look for {told!r}"


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
    cell = Cell("disk", "is full", "running", "it ends", "missed N rows …: full.", "again", "test")
    assert cell.is_told("it missed 10 rows of the log: full.")
    assert not any(cell.is_told(text) for text in ("missed 0 rows of it: full.", "missed 10 rows of it. full.", ""))
