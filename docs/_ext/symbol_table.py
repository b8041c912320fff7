"""Sphinx extension: the directive ``symbols``, a table of every symbol in the glossary."""

from __future__ import annotations

from docutils import nodes
from library_table import row, table
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from armlab import glossary


class Symbols(SphinxDirective):
    """The table of symbols: log columns, or with the option ``other`` the symbols of motions."""

    option_spec = {"other": lambda _: True}  # noqa: RUF012  the interface of docutils

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        self.env.note_dependency(str(glossary.__file__).replace(".py", ".toml"))
        rows = [
            row([nodes.literal("", one.name), *map(nodes.Text, (one.shape, one.unit, one.frame, one.text))])
            for one in glossary.symbols().values()
            if one.column != ("other" in self.options)
        ]
        return [table(("symbol", "shape", "unit", "axes", "meaning"), rows)]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("symbols", Symbols)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
