"""The gallery shows every figure there is, each with the line that draws it."""

from __future__ import annotations

import re
from pathlib import Path

from armlab import plots

DOCS = Path(__file__).parents[2] / "docs"
NO_FIGURES = {"png", "show"}
SHOWN = re.compile(
    r"^### (\w+)\n.*?^```\{literalinclude\} (\S+)\n.*?^:start-at: (.+?)\n:end-at: (.+?)\n"
    r".*?^```\{figure\} _figures/(\S+)$",
    flags=re.M | re.S,
)


def test_every_figure_is_shown_with_the_line_that_draws_it() -> None:
    shown = SHOWN.findall((DOCS / "gallery.md").read_text(encoding="utf-8"))
    names = [name for name, *_ in shown]
    assert sorted(names) == sorted(set(plots.__all__) - NO_FIGURES)
    for name, source, start, end, picture in shown:
        lines = (DOCS / source).read_text(encoding="utf-8").splitlines()
        first = next(k for k, line in enumerate(lines) if start in line)
        last = next(k for k, line in enumerate(lines[first:], first) if end in line)
        assert any(f"plots.{name}(" in line for line in lines[first : last + 1]), f"{name}: another line"
        written = (picture, re.sub(r"\d", "{number}", picture))
        assert any(word in line for word in written for line in lines), f"{name}: {source} does not write {picture}"
