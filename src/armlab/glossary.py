"""Glossary of armlab's symbols with shape, unit, frame, kind and description, read from ``glossary.toml``.

Plot labels, log headers and error messages use the glossary.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from types import MappingProxyType

from armlab._display import Shown
from armlab.errors import UnknownName

__all__ = ["Symbol", "columns", "label", "lookup", "symbols"]


@dataclass(frozen=True, slots=True, repr=False)
class Symbol(Shown):
    """Glossary symbol.

    Attributes
    ----------
    name : symbol as used in code, columns and files.
    shape : shape as text, where N is the number of samples and n the number of joints.
    unit : SI unit.
    frame : axes in which the numbers are expressed; empty if not applicable.
    kind : real, angle, pose, quaternion, count, flag or text; decides how a column is resampled.
    text : description.
    column : whether the symbol is a log column. In other files, names such as x, y, e and g have other meanings.
    """

    name: str
    shape: str
    unit: str
    frame: str
    kind: str
    text: str
    column: bool = True


@cache
def symbols() -> Mapping[str, Symbol]:
    """Return all symbols by name."""
    text = files("armlab").joinpath("glossary.toml").read_text(encoding="utf-8")
    return MappingProxyType({name: Symbol(name=name, **entry) for name, entry in tomllib.loads(text).items()})


@cache
def columns() -> Mapping[str, Symbol]:
    """Return the symbols that are log columns, by name."""
    return MappingProxyType({name: symbol for name, symbol in symbols().items() if symbol.column})


def lookup(name: str) -> Symbol:
    """Return the symbol `name`.

    Raises
    ------
    UnknownName : if the symbol is not in the glossary.
    """
    try:
        return symbols()[name]
    except KeyError:
        raise UnknownName.among("symbol", name, symbols()) from None


def label(name: str) -> str:
    """Return the axis label of a symbol, such as ``"tau [N m]"``; names that are not in the glossary have no unit."""
    symbol = symbols().get(name)
    return f"{name} [{symbol.unit}]" if symbol and symbol.unit not in ("", "1") else name
