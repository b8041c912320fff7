"""Sphinx extension: the directives ``accuracy`` (kernel errors) and ``accuracy-left-out`` (kernels without a table)."""

from __future__ import annotations

import runpy
from pathlib import Path

from docutils import nodes
from library_table import row, table
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from armlab import kernels

SCRIPT = Path(__file__).parents[2] / "tests" / "numerics" / "results.py"


class Accuracy(SphinxDirective):
    """Table of the largest error of each kernel, with its bound."""

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        self.env.note_dependency(str(SCRIPT))
        results = runpy.run_path(str(SCRIPT))
        rows = []
        for key, exact in results["tables"]().items():
            error = results["error"](exact, results["result"](kernels, key, exact))
            name = nodes.literal("", key.partition("/")[2])
            rows.append(row([name, nodes.Text(f"{error:.1f}"), nodes.Text(f"{results['bound'](key):.0f}")]))
        reasons = {name: reason for name, (_, reason) in results["BOUNDS"].items()}
        return [table(("kernel", "error", "bound"), rows), definitions(reasons)]


class LeftOut(SphinxDirective):
    """Kernels without a table, with their other tests."""

    def run(self) -> list[nodes.Node]:
        """Return the list."""
        self.env.note_dependency(str(SCRIPT))
        return [definitions(runpy.run_path(str(SCRIPT))["LEFT_OUT"])]


def definitions(reasons: dict[str, str]) -> nodes.definition_list:
    """Return a list of names with their descriptions."""
    found = nodes.definition_list()
    for name, reason in reasons.items():
        term = nodes.term("", "", nodes.literal("", name))
        found += nodes.definition_list_item("", term, nodes.definition("", nodes.paragraph("", reason)))
    return found


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("accuracy", Accuracy)
    app.add_directive("accuracy-left-out", LeftOut)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
