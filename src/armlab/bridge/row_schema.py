"""`RowSchema`: what is in the rows that other programs get, as canonical JSON."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass

from armlab.bridge._row_layout import (
    ASKED,
    COUNTS,
    FIXED,
    HEAD,
    MEASURED,
    REALS,
    RECORDED,
    SENT,
    TYPES,
    UNITS,
    VERSION,
    WORDS,
)
from armlab.errors import ConfigError, LinkError
from armlab.log import Column
from armlab.robots import Robot

__all__ = ["LARGEST", "RowField", "RowSchema"]

LARGEST = 8192
"""Bytes of a row."""


@dataclass(frozen=True, slots=True)
class RowField:
    """One field of a row.

    Attributes
    ----------
    name : "yumi_left.q". type : "float64", "int64", or "text" (UTF-8, filled up with zero bytes).
    shape : of the values; of a text its bytes. unit, frame : as in the glossary. labels : of the first axis.
    source : robot or source that it comes from. offset : bytes from the beginning of the row.
    """

    name: str
    type: str
    shape: tuple[int, ...]
    unit: str
    frame: str
    labels: tuple[str, ...]
    source: str
    offset: int

    @property
    def size(self) -> int:
        """Bytes, filled up to a multiple of 8."""
        count = math.prod(self.shape)
        return -(-count // 8) * 8 if self.type == "text" else 8 * count


class RowSchema:
    """What is in the rows of a run.

    Parameters
    ----------
    robots : names of the robots. fields : see `RowField`.

    Attributes
    ----------
    robots, fields : as given, `fields` by name. text : canonical JSON, bytes. id : 8 bytes. size : bytes of a row.

    Raises
    ------
    ConfigError : fields of one name, overlapping, of an unknown type, or more than `LARGEST` bytes.
    """

    def __init__(self, robots: Sequence[str], fields: Iterable[RowField]) -> None:
        self.robots = tuple(robots)
        found = list(fields)
        self.fields: Mapping[str, RowField] = {field.name: field for field in found}
        self.size = HEAD.size
        for field in found:
            if field.type not in TYPES or field.offset != self.size or any(size < 0 for size in field.shape):
                raise ConfigError(f"Expected the fields of a row one after another, got {str(field)[:200]}.")
            self.size += field.size
            if self.size > LARGEST:
                raise ConfigError(f"Expected rows of at most {LARGEST} bytes, got {self.size} with {field.name[:60]}.")
        if len(self.fields) < len(found):
            raise ConfigError("Expected each field of a row once, got one name twice. Rename a source.")
        about = {"version": VERSION, "robots": self.robots, "fields": [asdict(field) for field in found]}
        self.text = json.dumps(about, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
        self.id = hashlib.sha256(self.text).digest()[:8]

    @classmethod
    def of(cls, robots: Sequence[Robot], sources: Mapping[str, Mapping[str, Column]] | None = None) -> RowSchema:
        """Return the schema of a cell: per robot the columns of its log, its age and its commander; then the sources.

        Parameters
        ----------
        robots : the arms. sources : fields by name of the source.
        """
        fields: list[RowField] = []
        at = HEAD.size

        def add(owner: str, name: str, type_: str, column: Column, unit: str | None = None) -> None:
            nonlocal at
            known = column.resolved(name) if unit is None else column
            fields.append(
                RowField(
                    f"{owner}.{name}",
                    type_,
                    column.shape,
                    unit or known.unit or "1",
                    known.frame or "",
                    tuple(column.labels),
                    owner,
                    at,
                )
            )
            at += fields[-1].size

        for robot in robots:
            for name in REALS:
                add(robot.name, name, "float64", Column(), UNITS.get(name))
            for name in (*MEASURED, *ASKED, *SENT):
                add(robot.name, name, "float64", Column((robot.n,), labels=robot.joint_names))
            for name, shape in {**FIXED, **RECORDED}.items():
                add(robot.name, name, "float64", Column(shape))
            for name in COUNTS:
                add(robot.name, name, "int64", Column(), UNITS.get(name))
            add(robot.name, "clamped", "int64", Column((robot.n,), labels=robot.joint_names))
            add(robot.name, "commander", "text", Column((WORDS,)), "1")
        for source, columns in (sources or {}).items():
            for name, column in columns.items():
                add(source, name, "float64", column)
            add(source, "age", "float64", Column(), "s")
        return cls([robot.name for robot in robots], fields)

    def require(self, robot: Robot, *, whole: bool = True) -> None:
        """Refuse rows whose fields of an arm are not those of this one: who reads them takes them for granted.

        Parameters
        ----------
        robot : the arm. whole : also refuse rows that do not have all of them.

        Raises
        ------
        LinkError : a field is of another type or shape, or not there.
        """
        for name, wanted in RowSchema.of([robot]).fields.items():
            found = self.fields.get(name, None if whole else wanted)
            if found is None or (found.type, found.shape) != (wanted.type, wanted.shape):
                got = "none" if found is None else f"{found.type} of shape {found.shape}"
                raise LinkError(
                    f"Expected rows with {name}, {wanted.type} of shape {wanted.shape}, got {got}. Use the same "
                    f"description of {robot.name}, and the same armlab, at both ends."
                )

    @classmethod
    def read(cls, text: bytes) -> RowSchema:
        """Return the schema that was written as JSON.

        Parameters
        ----------
        text : as in `RowSchema.text`.

        Raises
        ------
        ConfigError : not such a text.
        """
        import msgspec

        class Written(msgspec.Struct, forbid_unknown_fields=True):
            version: int
            robots: list[str]
            fields: list[RowField]

        try:
            written = msgspec.json.decode(text, type=Written)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ConfigError(
                f"Expected the schema of rows as JSON, but {error}. Take it from the same feed."
            ) from None
        if written.version != VERSION:
            raise ConfigError(f"Expected rows of version {VERSION}, got {written.version}. Install the same armlab.")
        return cls(written.robots, written.fields)
