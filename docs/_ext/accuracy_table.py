"""Sphinx extension: the directive ``accuracy``, errors of the kernels as they are when the pages are built."""

from __future__ import annotations

import runpy
from importlib import import_module
from pathlib import Path

from docutils import nodes
from library_table import row, table
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

SCRIPT = Path(__file__).parents[2] / "tests" / "numerics" / "results.py"
MODULES = ("armlab.kernels._native", "armlab.kernels._reference")


class Accuracy(SphinxDirective):
    """A table of the largest error of each kernel, compiled and in NumPy, with its bound."""

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        self.env.note_dependency(str(SCRIPT))
        results = runpy.run_path(str(SCRIPT))
        rows = []
        for key, exact in results["tables"]().items():
            found = [results["result"](import_module(module), key, exact) for module in MODULES]
            errors = (nodes.Text(f"{results['error'](exact, values):.1f}") for values in found)
            name = nodes.literal("", key.partition("/")[2])
            rows.append(row([name, *errors, nodes.Text(f"{results['bound'](key):.0f}")]))
        reasons = nodes.definition_list()
        for name, (_, reason) in results["BOUNDS"].items():
            term = nodes.term("", "", nodes.literal("", name))
            reasons += nodes.definition_list_item("", term, nodes.definition("", nodes.paragraph("", reason)))
        return [table(("kernel", "compiled", "NumPy", "bound"), rows), reasons]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("accuracy", Accuracy)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
