"""The file beside a CSV file, ``run.csv.toml``: what a line of headings cannot say of the columns."""

from __future__ import annotations

from pathlib import Path

import msgspec
import tomli_w

from armlab._toml import parsed
from armlab.errors import LogError
from armlab.log.description import Description
from armlab.log.table import Table

__all__ = ["describe", "read_sidecar", "sidecar_path"]


def sidecar_path(path: Path) -> Path:
    """Return the name of the file beside a CSV file: ``run.csv.toml`` of ``run.csv``."""
    return path.with_name(f"{path.name}.toml")


def describe(table: Table) -> str:
    """Return the text of the file for a table."""
    return tomli_w.dumps(msgspec.to_builtins(Description.of(table)))


def read_sidecar(path: Path) -> Description | None:
    """Return what the file beside a CSV file says, None where there is none.

    Raises
    ------
    LogError : it cannot be read; says where.
    """
    beside = sidecar_path(path)
    try:
        return msgspec.convert(parsed(beside.read_text(encoding="utf-8")), Description)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LogError(f"Expected to read {beside}, got: {error.strerror}.") from None
    except (ValueError, msgspec.ValidationError) as error:
        what = str(error).rstrip(".")
        raise LogError(
            f"Expected the columns of {path.name} in {beside}, got: {what}. Remove it, or mend it."
        ) from None
