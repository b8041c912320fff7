"""Model files: TOML with provenance, exact to the last digit, bound to one robot.

A file begins with ``[meta]``: kind, format, armlab version, command line, UTC time, sources with their SHA-256, robot
name and hash, and the sign convention of the wrench. A loader refuses another kind, format or sign. The torque model
has tables that are made to be read by people; other values are written by `armlab.models.registry`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from armlab._toml import TomlError, parsed
from armlab._whole_files import whole_file
from armlab.errors import ConfigError, ModelMismatchError
from armlab.models._torque_file import KIND, read_torque_model, torque_tables
from armlab.models.registry import decode, encode, read_value, value_file
from armlab.models.torque import TorqueModel

__all__ = ["load", "load_statistics", "save"]


def save(
    value: Any, path: str | Path, statistics: Mapping[str, Any] | None = None, sources: Sequence[str] = ()
) -> Path:
    """Write a model file and return its path; an existing file is replaced in one step or not at all.

    Parameters
    ----------
    value : a `TorqueModel`, or an instance of a class that `registry.register` knows.
    path : ends in ``.toml``.
    statistics : what a fit knew of the value, kept in the table [fit].
    sources : names of files that it comes from, with their SHA-256, besides those that the value knows.

    Raises
    ------
    ConfigError : another ending, or a value whose class has no file format. OSError : it cannot be written.
    """
    path = Path(path)
    if path.suffix != ".toml":
        raise ConfigError(f"Expected a model file name that ends in .toml, got {path}. Add the ending.")
    content = torque_tables(value) if isinstance(value, TorqueModel) else value_file(value)
    content["meta"]["sources"] = [*content["meta"]["sources"], *sources]
    if statistics is not None:
        content["fit"] = {name: encode(part) for name, part in statistics.items()}
    with whole_file(path) as part:
        part.write_text(tomli_w.dumps(content), encoding="utf-8")
    return path


def load(path: str | Path, kind: str | None = None) -> Any:
    """Read the value of a model file: a `TorqueModel`, or whatever was saved.

    Parameters
    ----------
    path : file written by `save`.
    kind : refuse files of another kind, for example "torque_model".

    Raises
    ------
    ConfigError : when the file is missing, damaged or has unknown fields; one line with the place.
    ModelMismatchError : when it is of another kind, format or sign convention.
    """
    path = Path(path)
    raw = _tables(path)
    meta = raw["meta"]
    if kind is not None and meta.get("kind") != kind:
        raise ModelMismatchError(
            f"Expected a file of kind {kind!r} at {path}, got {meta.get('kind')!r}. Name the right file."
        )
    return read_torque_model(raw, path) if meta.get("kind") == KIND else read_value(raw, path)


def load_statistics(path: str | Path) -> dict[str, Any]:
    """Read the table [fit] of a model file; empty where the value was saved without its fit.

    Parameters
    ----------
    path : file written by `save`.

    Raises
    ------
    ConfigError : the file cannot be read.
    """
    fit = _tables(Path(path)).get("fit", {})
    try:
        return {name: decode(part) for name, part in fit.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        what = str(error).rstrip(".")
        raise ConfigError(
            f"Expected the tables of a fit in [fit] at {path}, got: {what}. Make the file again."
        ) from None


def _tables(path: Path) -> dict[str, Any]:
    """Read a TOML file that begins with [meta]."""
    try:
        raw = parsed(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"Expected a model file at {path}, got: {error.strerror}. Check the name.") from None
    except (TomlError, UnicodeDecodeError) as error:
        raise ConfigError(f"Expected a TOML model file, got something else in {path}: {error}.") from None
    if not isinstance(raw.get("meta"), dict):
        raise ModelMismatchError(
            f"Expected a model file with kind, format and sign in [meta] at {path}, got none. Identify again."
        )
    return raw
