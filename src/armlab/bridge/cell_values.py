"""Every value of a cell file, those that it leaves to their defaults too: `cell_values`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from armlab._toml import parsed
from armlab.bridge._cell_file import File
from armlab.bridge.cell import parse_cell

__all__ = ["cell_values"]


def cell_values(text: str, path: str = "cell.toml") -> list[tuple[str, Any, bool]]:
    """Return (place, value, whether the file says it) of all that a cell file may say, as `robots[0].speed`.

    Parameters
    ----------
    text : of the file. path : its name, for messages.

    Raises
    ------
    ConfigError : as of `parse_cell`.
    """
    parse_cell(text, path)
    raw = parsed(text)
    return list(_values(msgspec.convert(raw, File, strict=True), raw, ""))


def _values(value: Any, raw: Any, place: str) -> Iterator[tuple[str, Any, bool]]:
    if isinstance(value, msgspec.Struct):
        for name in value.__struct_fields__:
            given = raw.get(name, _NOTHING) if isinstance(raw, dict) else _NOTHING
            yield from _values(getattr(value, name), given, f"{place}.{name}" if place else name)
    elif isinstance(value, dict) and value:
        for name, one in value.items():
            yield from _values(one, raw[name], f"{place}.{name}")
    elif isinstance(value, list) and value and isinstance(value[0], msgspec.Struct):
        for k, (one, given) in enumerate(zip(value, raw, strict=True)):
            yield from _values(one, given, f"{place}[{k}]")
    else:
        yield place, value, raw is not _NOTHING


_NOTHING = object()
