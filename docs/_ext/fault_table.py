"""Sphinx extension: the directive ``faults KIND``, a table of the fault matrix."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from runpy import run_path
from typing import Any

from docutils import nodes
from library_table import row, table
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

FOLDER = Path(__file__).parents[2] / "tests" / "faults"
HEAD = ("fault", "mode", "reaction", "message", "recovery", "test")


def cells() -> tuple[Any, ...]:
    """Return the cells of the matrix."""
    return run_path(str(FOLDER / "matrix.py"))["CELLS"]


def rows(kind: str) -> list[tuple[str, ...]]:
    """Return the rows of one kind; states and faults with the same reaction share a row."""
    same = [(cell.happens, cell.told, cell.recovers, cell.test, cell) for cell in cells() if cell.kind == kind]
    found = []
    for (happens, told, recovers, test), alike in groupby(same, key=lambda one: one[:-1]):
        by_fault = groupby((one[-1] for one in alike), key=lambda cell: cell.fault)
        by_states = groupby(
            ((fault, _listed(one.state for one in group)) for fault, group in by_fault), lambda one: one[1]
        )
        for states, group in by_states:
            found.append((_listed(fault for fault, _ in group), states, happens, told, recovers, test))
    return found


def _listed(texts: Iterable[str]) -> str:
    """Join texts with commas, or with semicolons if one contains a comma."""
    texts = list(texts)
    return ("; " if any("," in text for text in texts) else ", ").join(texts)


def _text(words: str) -> nodes.inline:
    """Return a text node in which text between backticks is code."""
    parts = enumerate(words.split("`"))
    return nodes.inline("", "", *(nodes.literal("", part) if k % 2 else nodes.Text(part) for k, part in parts if part))


class Faults(SphinxDirective):
    """Table of one kind of fault."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        self.env.note_dependency(str(FOLDER / "matrix.toml"))
        made = []
        for fault, states, happens, told, recovers, test in rows(self.arguments[0]):
            where = nodes.literal("", re.sub(r"(/|::|_)", "\\1\u200b", test.removeprefix("tests/faults/")))
            made.append(row([*map(_text, (fault, states, happens, told, recovers)), where]))
        whole = table(HEAD, made)
        whole["classes"].append("faults")
        return [whole]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("faults", Faults)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
