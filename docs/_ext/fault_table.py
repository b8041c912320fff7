"""Sphinx extension: the directive ``faults KIND``, cells of the matrix as their tests state them."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from itertools import groupby
from pathlib import Path
from typing import Any

from docutils import nodes
from library_table import row, table
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

FOLDER = Path(__file__).parents[2] / "tests" / "faults"
PACKAGE = "fault_tests"
HEAD = ("fault", "while", "what happens", "what you read", "what it takes to go on", "test")


def cells() -> list[Any]:
    """Return the cells of all tests: importing a test adds its own."""
    if PACKAGE not in sys.modules:
        spec = ModuleSpec(PACKAGE, None, is_package=True)
        spec.submodule_search_locations = [str(FOLDER)]
        sys.modules[PACKAGE] = module_from_spec(spec)
        for path in (*sorted(FOLDER.glob("test_*.py")), FOLDER / "elsewhere.py"):
            import_module(f"{PACKAGE}.{path.stem}")
    return import_module(f"{PACKAGE}.matrix").CELLS


def rows(kind: str) -> list[tuple[str, ...]]:
    """Return the texts of one kind; states in which the same happens share a row."""
    found = []
    words = [(cell.fault, cell.happens, cell.told, cell.recovers, cell.test, cell) for cell in cells()]
    for (fault, happens, told, recovers, test), group in groupby(
        (one for one in words if one[-1].kind == kind), key=lambda one: one[:-1]
    ):
        states = ", ".join(one[-1].state for one in group)
        found.append((fault, states, happens, told, recovers, test))
    return found


class Faults(SphinxDirective):
    """The table of one kind of fault."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        for path in FOLDER.glob("*.py"):
            self.env.note_dependency(str(path))
        made = []
        for fault, states, happens, told, recovers, test in rows(self.arguments[0]):
            where = nodes.literal("", test.replace("/", "/\u200b").replace("::", "::\u200b"))
            made.append(row([*map(nodes.Text, (fault, states, happens, told, recovers)), where]))
        return [table(HEAD, made)]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("faults", Faults)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
