"""Reports as self-contained HTML files that contain no scripts and load nothing from the network."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from armlab._files import whole_file

Drawing = tuple[str, str, str, Callable[[], Any]]  # title, alternative text, caption, drawing function

_HEAD = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; }}
h1 {{ font-size: 1.6rem; margin-bottom: .2rem; }}
h2 {{ font-size: 1.15rem; margin: 2.2rem 0 .4rem; border-bottom: 1px solid #ddd; }}
.about {{ color: #555; margin-top: 0; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }}
th, td {{ padding: .18rem .55rem; text-align: right; vertical-align: bottom; border-bottom: 1px solid #eee; }}
th:first-child, td:first-child, .words {{ text-align: left; }}
th {{ border-bottom: 1px solid #999; font-weight: 600; }}
@media (max-width: 50rem) {{ table {{ font-size: 11px; }} th, td {{ padding: .18rem .3rem; }} }}
figure {{ margin: .8rem 0; }}
img {{ max-width: 100%; height: auto; }}
figcaption, .note {{ color: #555; max-width: 52rem; }}
.verdict {{ border-left: 5px solid #009E73; background: #f4faf7; padding: .6rem 1rem; }}
.verdict.care {{ border-color: #E69F00; background: #fdf8ec; }}
.verdict p {{ margin: .2rem 0; }}
.verdict ul {{ margin: .1rem 0 .6rem; padding-left: 1.2rem; }}
pre {{ white-space: pre-wrap; background: #f6f6f6; padding: .6rem; font-size: 11px; }}
summary {{ cursor: pointer; color: #555; }}
</style>
</head>
<body>
"""


@dataclass
class Verdict:
    """Findings and advice of a report."""

    good: list[str] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)
    ahead: list[str] = field(default_factory=list)  # advice

    @property
    def parts(self) -> tuple[tuple[str, list[str]], ...]:
        """Title and sentences of each non-empty section."""
        named = (("Good", self.good), ("Problems", self.bad), ("Next", self.ahead))
        return tuple((title, sentences) for title, sentences in named if sentences)

    def text(self) -> str:
        """Return one line per sentence."""
        return "\n".join(f"{title.lower()}: {sentence}" for title, sentences in self.parts for sentence in sentences)


@dataclass
class HtmlReport:
    """HTML report, built from top to bottom."""

    title: str
    about: str  # subtitle: robot, files, time
    pieces: list[str] = field(default_factory=list)  # HTML of the parts added so far

    def verdict(self, verdict: Verdict) -> None:
        """Add the box with the verdict."""
        body = "".join(
            f"<p><b>{title}</b></p><ul>{''.join(f'<li>{escape(sentence)}</li>' for sentence in sentences)}</ul>"
            for title, sentences in verdict.parts
        )
        self.pieces.append(f'<div class="verdict{" care" if verdict.bad else ""}">{body}</div>')

    def section(self, title: str, words: str = "") -> None:
        """Begin a section, with an optional paragraph."""
        self.pieces.append(f"<h2>{escape(title)}</h2>" + (f'<p class="note">{escape(words)}</p>' if words else ""))

    def table(self, rows: Sequence[Sequence[str]], folded: str = "") -> None:
        """Add a table whose first row is the header. Text is left-aligned, and numbers are right-aligned."""
        head, *body = rows
        words = [any(row[k][:1].isalpha() and row[k] != "nan" for row in body) for k in range(len(head))]
        head_cells = "".join(_cell("th", cell, text) for cell, text in zip(head, words, strict=True))
        lines = "".join(
            f"<tr>{''.join(_cell('td', cell, text) for cell, text in zip(row, words, strict=True))}</tr>"
            for row in body
        )
        self._add(f"<table><thead><tr>{head_cells}</tr></thead><tbody>{lines}</tbody></table>", folded)

    def figure(self, png: bytes, alt: str, caption: str = "") -> None:
        data = base64.b64encode(png).decode("ascii")
        below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
        self.pieces.append(f'<figure><img src="data:image/png;base64,{data}" alt="{escape(alt)}">{below}</figure>')

    def figures(self, drawings: Sequence[Drawing], tell: Callable[[float, float, str], None]) -> None:
        """Add a section with a figure for each drawing."""
        from armlab.plots.style import png

        for k, (title, alt, caption, draw) in enumerate(drawings):
            tell(k, len(drawings), f"drawing {title.lower()}")
            self.section(title)
            self.figure(png(draw()), alt, caption)

    def verbatim(self, text: str, folded: str = "") -> None:
        self._add(f"<pre>{escape(text)}</pre>", folded)

    def html(self) -> str:
        top = f'<h1>{escape(self.title)}</h1>\n<p class="about">{escape(self.about)}</p>'
        return "\n".join([_HEAD.format(title=escape(self.title)) + top, *self.pieces, "</body>\n</html>\n"])

    def _add(self, piece: str, folded: str) -> None:
        self.pieces.append(f"<details><summary>{escape(folded)}</summary>{piece}</details>" if folded else piece)

    def write(self, path: Path) -> None:
        """Write the page atomically."""
        with whole_file(path) as part:
            part.write_text(self.html(), encoding="utf-8")


def _cell(kind: str, text: str, words: bool) -> str:
    """Return the HTML of a cell; units and values with uncertainty are never wrapped."""
    whole = re.sub(r"\[[^]]*\]|± \S+", lambda found: found[0].replace(" ", "\N{NO-BREAK SPACE}"), text)
    opened = f'{kind} class="words"' if words else kind
    return f"<{opened}>{escape(whole)}</{kind}>"
