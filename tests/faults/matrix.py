"""The matrix of faults and states: each cell says what must happen, in words that its test looks for.

`docs/faults.md` is made of the cells of these tests; see `docs/_ext/fault_table.py`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

__all__ = ["CELLS", "KINDS", "NO_WORDS", "STATES", "Cell", "cells", "elsewhere", "shows"]

STATES = ("waiting", "listening", "holding", "running", "stopping")
"""Modes of the bridge when the fault begins, as in `docs/egm.md`."""

KINDS = ("network", "robot", "process", "controller", "disk", "memory", "clock")
"""Sections of the page."""

NO_WORDS = "–"
"""Where there is nothing to tell."""

TESTS = Path(__file__).parents[1]


@dataclass(frozen=True)
class Cell:
    """One fault in one state.

    Attributes
    ----------
    kind, fault, state : what goes wrong, and when. happens : what must happen.
    told : words that the user reads, with "…" for what differs and "N" for a number above zero; "–" when there is
        nothing to tell.
    recovers : what it takes to go on. given : what else its test needs. test : node id.
    """

    kind: str
    fault: str
    state: str
    happens: str
    told: str
    recovers: str
    given: Any = field(default=None, compare=False)
    test: str = ""

    def __str__(self) -> str:
        return f"{self.fault}, {self.state}"

    def is_told(self, text: str) -> bool:
        """Whether a text has the words."""
        words = re.escape(self.told).replace("…", ".*?")
        words = re.sub(r"\bN\b", r"[1-9]\\d*", words)
        return self.told == NO_WORDS or re.search(words, text) is not None


CELLS: list[Cell] = []
"""Of all tests that were imported."""


def cells(
    kind: str, fault: str, states: str, happens: str, told: str, recovers: str, given: Any = None
) -> tuple[Cell, ...]:
    """Return a cell for each of the `states`, names with commas between; the rest is as in `Cell`."""
    found = tuple(Cell(kind, fault, state, happens, told, recovers, given) for state in states.split(", "))
    assert kind in KINDS
    assert {cell.state for cell in found} <= set(STATES)
    return found


def shows(*groups: tuple[Cell, ...]) -> Callable[[Any], Any]:
    """Run a test with each of its cells, and have them on the page.

    In the default tests a fault meets a moving arm only, or its first state; the others are slow tests.
    """

    def decorate(test: Any) -> Any:
        node = f"{Path(test.__code__.co_filename).relative_to(TESTS.parent).as_posix()}::{test.__name__}"
        own = [replace(cell, test=node) for group in groups for cell in group]
        CELLS.extend(own)
        quick = {cell.fault: cell.state for cell in reversed(own)}
        quick |= {cell.fault: cell.state for cell in own if cell.state == "running"}
        parameters = [
            pytest.param(cell, marks=() if quick[cell.fault] == cell.state else pytest.mark.slow) for cell in own
        ]
        return pytest.mark.parametrize("cell", parameters, ids=str)(test)

    return decorate


def elsewhere() -> list[Cell]:
    """Return the cells that tests of other folders hold."""
    text = Path(__file__).with_name("elsewhere.toml").read_text(encoding="utf-8")
    return [Cell(**row) for row in tomllib.loads(text)["cell"]]
