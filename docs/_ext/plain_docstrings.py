"""Sphinx extension: parser for armlab docstrings, NumPy sections with shape, unit and frame in words.

The text after the colon in ``name : (N, n) joint positions [rad].`` is prose, so Sphinx looks up no types in it.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from sphinx.application import Sphinx

SECTIONS = ("Parameters", "Returns", "Yields", "Raises", "Attributes", "Notes", "Examples", "References")
WITH_ENTRIES = ("Parameters", "Raises", "Attributes")
LITERAL = re.compile(r"(``.*?``|`.*?`)")
ENTRY = re.compile(r"(\S.*?) : (.*)")
TYPE_WIDTH = 80  # characters; longer first lines are prose that wraps
NUMBER = re.compile(r"np\.float64\((.*?)\)")  # in the representation of a default
FUNCTION = re.compile(r"<function .*?>+")
NEXT_ENTRY = re.compile(r"(?<=\.) (?=[\w, *]+ : )")  # several short entries may share a line


class _Pair(NamedTuple):
    """Named tuple used only to get the type of its fields."""

    field: int


TUPLE_FIELD = type(_Pair.__dict__["field"])


def sections(lines: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield (title, lines) of a docstring; the first part has the title ""."""
    title, body = "", []
    for line, below in zip(lines, [*lines[1:], ""]):
        if line in SECTIONS and below and not below.strip("-"):
            yield title, body
            title, body = line, []
        elif body or line.strip("-"):  # skip the underline of a title
            body.append(line)
    yield title, body


def entries(body: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield (names, description) of a section; other lines continue the previous entry."""
    name, text = "", []
    body = [part for line in body for part in (NEXT_ENTRY.split(line) if line[:1].strip() else [line])]
    for line, below in zip(body, [*body[1:], ""]):
        match = ENTRY.fullmatch(line)
        alone = bool(line) and not line[0].isspace() and not match and below.startswith(" ")
        if match or alone:
            if name:
                yield name, text
            name, text = (match[1], [match[2]]) if match else (line, [])
        else:
            text.append(line.strip())
    if name:
        yield name, text


def unindented(body: list[str]) -> list[str]:
    """Return the unindented lines."""
    return [line for line in body if line[:1].strip()]


def bullet(name: str, text: list[str]) -> list[str]:
    """Return an entry as a list item; entries within its lines become a nested list."""
    first, *others = text
    short = len(name) + len(first) < TYPE_WIDTH
    if short and others and others[0] and not first.endswith((".", ",", ":", ";")):  # a type, then prose
        first = f"*{first}.*" if not re.search(r"[*`|]", first) else f"{first}."
    lines, margin = [f"* ``{name}``: {escaped(first)}"], "  "
    for line in others:
        if match := ENTRY.fullmatch(line):
            lines, margin = [*lines, "", f"  * ``{match[1]}``: {escaped(match[2])}"], "    "
        else:
            lines.append(margin + escaped(line))
    return lines


def escaped(line: str) -> str:
    """Escape vertical bars outside literals; otherwise, they would mark substitutions."""
    parts = LITERAL.split(line)
    return "".join(part if k % 2 else part.replace("|", r"\|") for k, part in enumerate(parts))


def prose(lines: list[str]) -> list[str]:
    """Escape all lines except literal blocks, which are indented."""
    return [line if line.startswith("  ") else escaped(line) for line in lines]


def rewrite(_app: Sphinx, _what: str, _name: str, _thing: Any, _options: Any, lines: list[str]) -> None:
    """Convert one docstring to reStructuredText, in place."""
    result: list[str] = []
    for title, body in sections(lines):
        if title:
            result += ["", f".. rubric:: {title}", ""]
        if title in WITH_ENTRIES or (title == "Returns" and all(map(ENTRY.fullmatch, unindented(body)))):
            for name, text in entries(body):
                result += bullet(name, text or [""])
        else:
            result += prose(body)
    lines[:] = result


def skip(_app: Sphinx, _what: str, _name: str, thing: Any, is_skipped: bool, _options: Any) -> bool | None:
    """Skip the fields of named tuples: the section Attributes describes them."""
    return True if isinstance(thing, TUPLE_FIELD) else None


def sign(
    _app: Sphinx, what: str, _name: str, thing: Any, _options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Shorten defaults; hide the arguments of classes whose docstring does not document all of them."""
    if signature:
        signature = FUNCTION.sub("...", NUMBER.sub(lambda found: f"{float(found[1]):.4g}", signature))
    shown = (signature, returned)
    if what != "class" or not signature or not isinstance(thing, type) or issubclass(thing, tuple):
        return shown
    text = thing.__doc__ or ""
    try:
        names = list(inspect.signature(thing).parameters)
    except (TypeError, ValueError):
        return shown
    return shown if all(re.search(rf"\b{name}\b", text) for name in names) else ("", None)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to autodoc."""
    app.connect("autodoc-process-docstring", rewrite)
    app.connect("autodoc-process-signature", sign)
    app.connect("autodoc-skip-member", skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
