"""The matrix of faults and states, read from `matrix.toml`; `docs/_ext/fault_table.py` makes docs/faults.md of it."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

__all__ = ["CELLS", "KINDS", "NO_WORDS", "STATES", "Cell", "shows"]

STATES = ("waiting", "listening", "holding", "running", "stopping")
"""Modes of the bridge when the fault begins, as in `docs/egm.md`."""

KINDS = ("network", "robot", "process", "controller", "disk", "memory", "clock")
"""Sections of the page."""

NO_WORDS = "–"
"""For cells without a message."""

TESTS = Path(__file__).parents[1]


@dataclass(frozen=True)
class Cell:
    """One fault in one state, and the node id of its test; see the head of `matrix.toml`."""

    kind: str
    fault: str
    state: str
    happens: str
    told: str
    recovers: str
    test: str
    given: Any = None
    slow: bool = False

    def __str__(self) -> str:
        return f"{self.fault}, {self.state}"

    def is_told(self, text: str) -> bool:
        """Return whether a text contains the expected message."""
        words = re.escape(self.told).replace("…", ".*?")
        words = re.sub(r"\bN\b", r"[1-9]\\d*", words)
        return self.told == NO_WORDS or re.search(words, text) is not None


def _read() -> Iterator[Cell]:
    text = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    for shared in tomllib.loads(text)["test"]:
        for own in shared.pop("cells"):
            row = shared | own
            states = row.pop("states").split(", ")
            assert row["kind"] in KINDS, row
            assert set(states) <= set(STATES), (states, row)
            yield from (Cell(state=state, **row) for state in states)


CELLS = tuple(_read())
"""Of all tests."""


def shows(test: Any) -> Any:
    """Run a test with each of its cells.

    In the default tests, a fault not covered by another row meets only a moving arm, or its first state.
    """
    node = f"{Path(test.__code__.co_filename).relative_to(TESTS.parent).as_posix()}::{test.__name__}"
    own = [cell for cell in CELLS if cell.test == node]
    assert own, f"no row of matrix.toml names {node}"
    quick = {cell.fault: cell.state for cell in reversed(own)}
    quick |= {cell.fault: cell.state for cell in own if cell.state == "running"}
    slow = [cell.slow or quick[cell.fault] != cell.state for cell in own]
    parameters = [pytest.param(cell, marks=pytest.mark.slow if late else ()) for cell, late in zip(own, slow)]
    return pytest.mark.parametrize("cell", parameters, ids=str)(test)
