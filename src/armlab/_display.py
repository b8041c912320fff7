"""Short reprs of at most twenty lines, notebook tables, and figure colours.

`Shown` is the base class of public dataclasses with ``repr=False``. The repr has one field per line and shows large
arrays by their shape.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from html import escape
from typing import Any

# Colour-blind-safe palette: Okabe and Ito, "Color Universal Design" (2008), without yellow, which vanishes on white.
# Each joint and each axis has the same colour in every figure and in the browser.
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
PURPLE, ORANGE, SKY, BLACK = "#CC79A7", "#E69F00", "#56B4E9", "#000000"
GREY = "#4D4D4D"

COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
"""Colours of joints 1, 2, ..., repeated after seven joints."""
AXIS_COLORS = (VERMILION, GREEN, BLUE)
"""Colours of the axes x, y, z."""


_WIDTH = 100  # characters per line
_LINES = 18  # lines of fields in a repr
_ENTRIES = 9  # largest size of an array shown in full
_ROWS = 40  # rows of a notebook table


def brief(value: Any, width: int = _WIDTH) -> str:
    """Describe a value in one line; arrays with more than a few numbers are shown by their shape."""
    import numpy as np  # not needed for command help

    if isinstance(value, np.ndarray):
        if value.size <= _ENTRIES and value.ndim <= 1 and value.dtype.kind in "biuf":
            return f"[{' '.join(f'{entry:.6g}' for entry in value.ravel().tolist())}]"
        return f"array{value.shape} of {value.dtype}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Shown) or getattr(getattr(value, "__dataclass_params__", None), "repr", False):
        text = f"{type(value).__name__}(...)"
    elif isinstance(value, Mapping):
        text = f"{{{', '.join(f'{key!r}: {brief(entry, 30)}' for key, entry in list(value.items())[:4])}"
        text += ", ...}" if len(value) > 4 else "}"
    elif isinstance(value, (tuple, list)):
        text = ", ".join(brief(entry, 30) for entry in value[:4])
        text = f"({text}{f', ... {len(value)} in all' if len(value) > 4 else ',' * (len(value) == 1)})"
    else:
        text = repr(value)
    text = " ".join(text.split())
    return text if len(text) <= width else f"{text[: width - 4]} ..."


class Shown:
    """Base class of values with a short repr and a table in notebooks."""

    __slots__ = ()

    def _entries(self) -> list[tuple[str, str]]:
        """Return the name and a one-line description of each shown field."""
        return [(f.name, brief(getattr(self, f.name), _WIDTH - len(f.name))) for f in fields(self) if f.repr]  # type: ignore[arg-type]

    def __repr__(self) -> str:
        name, entries = type(self).__name__, self._entries()
        line = f"{name}({', '.join(f'{key}={text}' for key, text in entries)})"
        if len(line) <= _WIDTH:
            return line
        more = [f"  ... {len(entries) - _LINES + 1} more"] if len(entries) > _LINES else []
        kept = entries[: _LINES - 1] if more else entries
        return "\n".join([f"{name}(", *(f"  {key}={text}," for key, text in kept), *more, ")"])

    def _repr_html_(self) -> str:
        return html_table(type(self).__name__, ("field", "value"), self._entries())


def html_table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]], after: Sequence[str] = ()) -> str:
    """Return an HTML table for notebooks, with a title, a header, rows of cells, and lines of text below."""
    listed = [list(row) for row in rows]
    body = "".join(f"<tr>{''.join(f'<td>{escape(word)}</td>' for word in row)}</tr>" for row in listed[:_ROWS])
    lines = [*([f"and {len(listed) - _ROWS} more"] if len(listed) > _ROWS else []), *after]
    below = "".join(f"<div>{escape(line)}</div>" for line in lines)
    top = "".join(f"<th>{escape(word)}</th>" for word in head)
    return f"<div><b>{escape(title)}</b></div><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>{below}"
