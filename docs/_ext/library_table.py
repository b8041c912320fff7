"""Sphinx extension: the directive ``robot-library``, a table of the library robots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import armlab.robots as robots


def facts(source: str) -> dict[str, str]:
    """Return the lines ``key: text`` of a source."""
    return dict(line.split(": ", 1) for line in source.splitlines())


def known(robot: robots.Robot) -> str:
    """Return the kinds of data beyond geometry."""
    has = {
        "limits": np.isfinite(robot.q_min).all(),
        "speeds": np.isfinite(robot.qd_max).all(),
        "torques": np.isfinite(robot.tau_max).all(),
        "gears": not np.array_equal(robot.coupling, np.eye(robot.n)),
        "inertias": robot.inertias is not None,
    }
    return ", ".join(kind for kind, there in has.items() if there)


def row(cells: Iterable[nodes.Node]) -> nodes.row:
    """Return one row of a table."""
    return nodes.row("", *(nodes.entry("", nodes.paragraph("", "", cell)) for cell in cells))


def table(head: Sequence[str], rows: Iterable[nodes.row]) -> nodes.table:
    """Return a table with a header row."""
    group = nodes.tgroup("", *(nodes.colspec(colwidth=1) for _ in head), cols=len(head))
    group += nodes.thead("", row(nodes.Text(title) for title in head))
    group += nodes.tbody("", *rows)
    return nodes.table("", group)


class RobotLibrary(SphinxDirective):
    """Table of the robots, then the sources of their data."""

    def run(self) -> list[nodes.Node]:
        """Return the table and the sources."""
        library = Path(robots.__file__).with_name("library")
        rows, sources = [], nodes.definition_list()
        for name in robots.names():
            self.env.note_dependency(str(library / f"{name}.toml"))
            robot = robots.load(name)
            stated = facts(robot.source)
            label = nodes.literal("", name)
            rows.append(
                row([label, nodes.Text(stated.pop("robot")), nodes.Text(str(robot.n)), nodes.Text(known(robot))])
            )
            items = [nodes.list_item("", nodes.paragraph("", f"{key}: {text}")) for key, text in stated.items()]
            sources += nodes.definition_list_item(
                "", nodes.term("", "", label.deepcopy()), nodes.definition("", nodes.bullet_list("", *items))
            )
        return [table(("name", "robot: payload, reach", "joints", "data beyond geometry"), rows), sources]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("robot-library", RobotLibrary)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
