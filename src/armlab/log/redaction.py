"""Secrets in settings that are attached to a recording: replaced before they are written, whatever shape they have.

A file that mentions none stays as it is, to the byte. Of one that does, the values are written anew: what a key or a
table says to be secret is ``***``, and comments are gone. What cannot be read is left out: nobody knows what is in it.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from configparser import RawConfigParser
from pathlib import Path
from typing import Any

from armlab._toml import parsed

__all__ = ["SECRET", "redacted"]

SECRET = re.compile(r"token|password|passwd|secret|api[-_ ]?key", re.IGNORECASE)
"""What a name has inside whose value is secret."""

_TOLD = re.compile(rf"((?:{SECRET.pattern})[\w.-]*+[\"']?\s*[=:]\s*)\S[^\n]*", re.IGNORECASE)  # within a text
_HIDDEN = "***"
_LEFT_OUT = b"# left out: it may hold a secret, and its values could not be told apart\n"
_TOP = " "  # name of a section for what comes before the first of an INI file


def redacted(name: str, data: bytes) -> bytes:
    """Return a file without its secrets.

    Parameters
    ----------
    name : of the file; TOML, JSON, YAML and INI are looked at, others stay as they are. data : its bytes.
    """
    if Path(name).suffix.lower() not in _FORMATS:
        return bytes(data)
    plain = data.replace(b"\0", b"").decode("latin-1")  # finds the names in UTF-16, too
    mentions = SECRET.search(plain) is not None
    if not mentions and "\\" not in plain:  # "\u0074oken" is a name, too
        return bytes(data)
    read, write = _FORMATS[Path(name).suffix.lower()]
    try:
        held = read(data.decode("utf-8-sig"))
        told = _without(held, {})
        return write(told).encode() if mentions or told != held else bytes(data)
    except Exception:  # what parsers raise on texts of others is nowhere listed: configparser an AttributeError
        return _LEFT_OUT


def _without(value: Any, known: dict[int, Any]) -> Any:
    """Return a value of tables, lists and texts without secrets; what stands in several places of it, once."""
    if id(value) in known:
        return known[id(value)]
    if isinstance(value, dict):
        table = known[id(value)] = {}
        for key, one in value.items():
            table[key] = _HIDDEN if SECRET.search(str(key)) else _without(one, known)
        return table
    if isinstance(value, list):
        items = known[id(value)] = []
        items += [_without(one, known) for one in value]
        return items
    if isinstance(value, tuple | set):  # pairs of YAML, whose keys are not told from other values
        raise TypeError("no table, list, text or number")
    return _TOLD.sub(rf"\1{_HIDDEN}", value) if isinstance(value, str) else value


def _to_toml(held: Any) -> str:
    import tomli_w

    return tomli_w.dumps(held)


def _to_json(held: Any) -> str:
    return json.dumps(held, indent=1) + "\n"


def _from_yaml(text: str) -> list[Any]:
    """Return the documents of a file."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    parser = YAML(typ="safe", pure=True)
    parser.allow_duplicate_keys = True
    try:
        return list(parser.load_all(text))
    except YAMLError as error:
        raise ValueError("no YAML") from error


def _to_yaml(documents: list[Any]) -> str:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    writer, out = YAML(typ="safe", pure=True), io.StringIO()
    writer.default_flow_style = False
    try:
        writer.dump_all(documents, out)
    except YAMLError as error:
        raise ValueError("no YAML") from error
    return out.getvalue()


class _Ini(RawConfigParser):
    """Settings in sections, each value a text; names keep their case."""

    def __init__(self) -> None:
        super().__init__(strict=False, allow_no_value=True, default_section="")

    def optionxform(self, optionstr: str) -> str:
        return optionstr


def _from_ini(text: str) -> dict[str, Any]:
    parser = _Ini()
    parser.read_string(f"[{_TOP}]\n{text}")
    return {section: dict(parser.items(section)) for section in parser.sections()}


def _to_ini(held: dict[str, Any]) -> str:
    parser, out = _Ini(), io.StringIO()
    parser.read_dict({name: values if isinstance(values, dict) else {_HIDDEN: None} for name, values in held.items()})
    parser.write(out)
    return out.getvalue().replace(f"[{_TOP}]\n", "", 1)


_FORMATS: dict[str, tuple[Callable[[str], Any], Callable[[Any], str]]] = {
    ".toml": (parsed, _to_toml),
    ".json": (json.loads, _to_json),
    ".yaml": (_from_yaml, _to_yaml),
    ".yml": (_from_yaml, _to_yaml),
    ".cfg": (_from_ini, _to_ini),
    ".ini": (_from_ini, _to_ini),
}
