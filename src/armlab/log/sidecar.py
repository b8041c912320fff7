"""The file beside a CSV file, ``run.csv.toml``: what a line of headings cannot say of the columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import tomli_w

import armlab
from armlab.errors import LogError
from armlab.log.column import Column
from armlab.log.table import Table

__all__ = ["Sidecar", "describe", "headings", "read_sidecar", "sidecar_path"]


class _ColumnTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    shape: tuple[int, ...]
    unit: str
    frame: str
    kind: str
    labels: tuple[str, ...]


class Sidecar(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the file says: version of armlab, wall clock and owner of the clock, notes, source, and each column."""

    armlab: str
    t0_ns: int
    clock: str
    notes: tuple[str, ...]
    source: tuple[str, ...]
    columns: dict[str, _ColumnTable]

    def described(self) -> dict[str, Column]:
        """Return the columns in the order of the CSV file."""
        fields = Column.__dataclass_fields__
        return {name: Column(**{field: getattr(one, field) for field in fields}) for name, one in self.columns.items()}

    def labels(self) -> list[str]:
        """Return the line of headings that belongs to it."""
        return ["t [s]", *(label for name, column in self.described().items() for label in headings(name, column))]


def sidecar_path(path: Path) -> Path:
    """Return the name of the file beside a CSV file: ``run.csv.toml`` of ``run.csv``."""
    return path.with_name(f"{path.name}.toml")


def describe(table: Table) -> str:
    """Return the text of the file for a table."""
    columns = {}
    for name in table.names:
        one = table.columns[name]
        columns[name] = {"shape": list(table[name].shape[1:]), "unit": one.unit, "frame": one.frame}
        columns[name] |= {"kind": one.kind, "labels": list(one.labels)}
    about = {"armlab": armlab.__version__, "t0_ns": int(table.t0_ns), "clock": table.clock}
    return tomli_w.dumps({**about, "notes": list(table.notes), "source": list(table.source), "columns": columns})


def read_sidecar(path: Path) -> Sidecar | None:
    """Return what the file beside a CSV file says, None where there is none.

    Raises
    ------
    LogError : it cannot be read; says where.
    """
    beside = sidecar_path(path)
    try:
        return msgspec.toml.decode(beside.read_bytes(), type=Sidecar)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LogError(f"Expected to read {beside}, got: {error.strerror}.") from None
    except (ValueError, msgspec.ValidationError) as error:
        what = str(error).rstrip(".")
        raise LogError(
            f"Expected the columns of {path.name} in {beside}, got: {what}. Remove it, or mend it."
        ) from None


def headings(name: str, column: Column) -> Sequence[str]:
    """Return the heading of each component of a column: "q2 [rad]", "wrench_hat_cov1_4 [N^2 m]"."""
    units = (column.unit or "1").split(", ")
    found = []
    for place in np.ndindex(column.shape):  # forces first, then moments: of a matrix, the more moments, the later
        unit = units[min(sum(index >= 3 for index in place), len(units) - 1)] if len(units) > 1 else units[0]
        found.append(replace(column, unit=unit).heading(name + "_".join(str(index + 1) for index in place)))
    return found
