"""Values that have a file format: any frozen dataclass of numbers, texts and arrays, once it is registered.

    [meta]   kind, package of its class, format, armlab version, command line, UTC time, sources, robot name and hash
    [value]  the fields of the value
    [fit]    what the fit knew of them: names, units, covariance, noise, outliers

Numbers are written with 17 digits and arrays row by row, so that what is read is bit-equal to what was written. A class
anywhere in the package registers itself by `register`; `models.save` and `models.load` do the rest.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import armlab
from armlab.errors import ConfigError, ModelMismatchError

__all__ = ["decode", "encode", "kind_of", "provenance", "read_value", "register", "value_file"]

FORMAT = 1

_CLASSES: dict[str, type] = {}


def register(kind: str, cls: type) -> None:
    """Give a frozen dataclass a file format.

    Parameters
    ----------
    kind : name of the format, written into the file; for example "hand_eye".
    cls : its fields are numbers, texts, arrays, tuples and dicts of these, None, or other registered values. Its
        constructor must take what its fields hold.
    """
    if not is_dataclass(cls) or _CLASSES.setdefault(kind, cls) is not cls:
        raise ConfigError(f"Expected a dataclass and a kind of its own, got {cls.__name__} and {kind!r}.")


def kind_of(value: object) -> str:
    """Return the kind of a registered value.

    Raises
    ------
    ConfigError : its class has no file format.
    """
    for kind, cls in _CLASSES.items():
        if type(value) is cls:
            return kind
    raise ConfigError(
        f"Expected a value with a file format, got {type(value).__name__}. "
        f"These have one: {', '.join(sorted(c.__name__ for c in _CLASSES.values())) or 'none'} and TorqueModel."
    )


def provenance(kind: str, value: object) -> dict[str, Any]:
    """Return the table [meta] of a file that is written now.

    Parameters
    ----------
    kind : of the value. value : sources, robot name and hash are taken from it where it has them.
    """
    return {
        "kind": kind,
        "format": FORMAT,
        "armlab": armlab.__version__,
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "created": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "sources": list(getattr(value, "sources", ())),
        "robot": getattr(value, "robot_name", ""),
        "robot_hash": getattr(value, "robot_hash", ""),
    }


def value_file(value: object) -> dict[str, Any]:
    """Return the tables [meta] and [value] of a registered value, with the UNITS of its fields where it has them."""
    kind = kind_of(value)
    meta, units = provenance(kind, value), _units(value)
    meta["package"] = type(value).__module__.rpartition(".")[0]
    if units:
        meta["units"] = units
    return {"meta": meta, "value": encode(value)["fields"]}


def _units(value: Any, prefix: str = "") -> dict[str, str]:
    """Return the UNITS of a value and, by "part.field", those of the values that are its fields."""
    found = {prefix + name: unit for name, unit in getattr(type(value), "UNITS", {}).items()}
    for field in fields(value):
        part = getattr(value, field.name)
        if type(part) in _CLASSES.values():
            found |= _units(part, f"{prefix}{field.name}.")
    return found


def _check_units(written: Any, known: Mapping[str, str]) -> None:
    """Refuse units in a file that are not those in which its numbers are read."""
    for name, unit in written.items() if isinstance(written, dict) else ():
        if known.get(name) != unit:
            raise ConfigError(
                f"Expected [meta.units] to say {known.get(name)!r} for {name}, got {unit!r}. No number is "
                "converted: write them in the first."
            )


def _check_texts(value: Any, path: Path) -> None:
    """Refuse a value whose sources and robot could not be named again in [meta]."""
    known = provenance("", value)
    for name, text in (
        *(("sources", one) for one in known["sources"]),
        *((k, known[k]) for k in ("robot", "robot_hash")),
    ):
        if not isinstance(text, str):
            raise ConfigError(f"Expected texts for {name} at {path}, got {text!r}. Make the file again.")


def read_value(raw: Mapping[str, Any], path: Path) -> Any:
    """Return the value of a file's tables.

    Parameters
    ----------
    raw : the tables, with a [meta] of some kind. path : for messages.

    Raises
    ------
    ModelMismatchError : a kind or format that this version does not know. ConfigError : fields are missing or wrong.
    """
    meta = raw["meta"]
    kind, version, package = str(meta.get("kind")), meta.get("format"), str(meta.get("package", "")) or "the package"
    owner = package.removeprefix("armlab.")
    if kind not in _CLASSES and owner in armlab.__all__:
        getattr(armlab, owner)  # is imported by that, and its kinds are registered
    if kind not in _CLASSES or version != FORMAT:
        raise ModelMismatchError(
            f"Expected a file of format {FORMAT} and a kind of {sorted({*_CLASSES, 'torque_model'})} at {path}, got "
            f"{kind!r} in format {version}. Import {package} that made it, or make it again."
        )
    try:
        value = decode({"kind": kind, "fields": raw["value"]})
        _check_units(meta.get("units", {}), _units(value))
        _check_texts(value, path)
        return value
    except ConfigError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        what = str(error).rstrip(".")
        raise ConfigError(f"Expected the fields of a {kind} at {path}, got: {what}. Make the file again.") from None


def encode(item: Any) -> Any:
    """Return numbers, texts, lists and tables that TOML can hold; None becomes an empty table.

    Parameters
    ----------
    item : a field of a registered value.
    """
    if isinstance(item, np.ndarray):
        return {"shape": list(item.shape), "array": item.tolist()} if not item.size else {"array": item.tolist()}
    if item is None:
        return {}
    if isinstance(item, (bool, int, float, str)):
        return item
    if isinstance(item, np.generic):
        return item.item()
    if isinstance(item, (tuple, list)):
        return {"tuple": [encode(part) for part in item]}
    if isinstance(item, Mapping):
        return {"table": {str(key): encode(part) for key, part in item.items()}}
    return {"kind": kind_of(item), "fields": {f.name: encode(getattr(item, f.name)) for f in fields(item)}}


def decode(item: Any) -> Any:
    """Return the field that `encode` has turned into tables.

    Parameters
    ----------
    item : from a TOML file.
    """
    if not isinstance(item, dict):
        return item
    if "array" in item:
        values = np.array(item["array"])
        return values.reshape(item["shape"]).astype(float) if "shape" in item else values
    if "tuple" in item:
        return tuple(decode(part) for part in item["tuple"])
    if "table" in item:
        return {key: decode(part) for key, part in item["table"].items()}
    if "kind" in item:
        return _CLASSES[item["kind"]](**{name: decode(part) for name, part in item["fields"].items()})
    if item:
        raise ConfigError(
            "Expected a table with array, tuple, table or kind, or an empty one, got one with "
            f"{sorted(item)[0][:60]!r}. Make the file again."
        )
    return None
