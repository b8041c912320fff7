"""`read_labcomm`: read a LabComm stream from a file as a `Table`, in any dialect.

Each leaf of a sample becomes a column: ``robot_row.pos`` (N, 7), ``irb2ext.robot[0].joint[2].posRawAbs`` (N,). Numeric
arrays remain arrays; structs in arrays are numbered from 0. One sample defines the rows; the values of other samples
are held until their next value.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from armlab import glossary
from armlab._numbers import check_name, number
from armlab.errors import ArmlabError, LabCommError, LogError
from armlab.log.assembly import rows_in_order
from armlab.log.column import Column, refuse_ragged
from armlab.log.file_formats.opening import FIRST, file_hash, format_of
from armlab.log.table import Table
from armlab.wire.labcomm import Decoder, Limits, Sample
from armlab.wire.labcomm.types import Array, Prim, Struct

_PIECE = 1 << 20
_CLOCKS = {"t_us": 1e-6, "tm": 1e-3, "t": 1.0, "time": 1.0}  # clock fields of a sample and their units in s
_WRAP = 1 << 32  # ms, period of tm, which is a signed 32-bit integer
_BRIDGE = ("robot_row", "command_row")
_UNITS = {"pos": "rad", "vel": "rad/s", "trq": "N m"}  # units of the bridge's samples
_KINDS = {"b": "flag", "i": "count", "f": "real", "U": "text"}
_TYPES = {"boolean": np.bool_, "float": np.float64, "double": np.float64, "string": np.str_}  # other types are integers


@dataclass(slots=True)
class _Leaf:
    """Values of one column read so far, the row count before each value, and the dimension of non-empty values."""

    dtype: Any
    values: list[np.ndarray] = field(default_factory=list)
    rows: list[int] = field(default_factory=list)
    axes: int | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the largest value."""
        axes = max((value.ndim for value in self.values), default=0)  # an empty list of lists has one dimension
        most = [value.shape for value in self.values if value.ndim == axes]
        return tuple(max(sizes) for sizes in zip(*most, strict=True))

    @property
    def size(self) -> int:
        """Eight-byte cells per row; strings take four bytes per character of the longest string."""
        if self.dtype is np.str_:
            return max(value.itemsize for value in self.values) // 8 + 1
        return math.prod(self.shape)

    @property
    def held(self) -> int:
        """Number of cells of the values without padding."""
        return sum(value.nbytes // 8 + 1 for value in self.values)

    def add(self, value: Any, dtype: Any, row: int, label: str) -> None:
        """Append a value, whose type may differ from that of earlier values if its sample was redeclared."""
        array = np.asarray(value, dtype=dtype)
        if dtype is not self.dtype:
            if np.str_ in (dtype, self.dtype):
                raise LogError(f"Expected numbers or strings in {label}, got both. The sample was declared twice.")
            self.dtype = np.result_type(dtype, self.dtype)
        if array.size:
            self.axes = array.ndim if self.axes is None else self.axes
            if self.axes != array.ndim:
                raise LogError(
                    f"Expected arrays with {self.axes} dimensions in {label}, "
                    f"got {array.ndim}. The sample was declared twice."
                )
        self.values.append(array)
        self.rows.append(row)


def read_labcomm(path: str | Path, *, sample: str | None = None, rate: float | None = None, raw: bool = False) -> Table:
    """Read a LabComm stream, as written by the loggers of the predecessor software, from a file into a table.

    The table has one row per value of the defining sample; values of other samples are held until the next value, and
    are missing before the first. A variable-size array has as many columns as its largest value and is padded with NaN.
    A stream that ends within a packet is read up to that point, with one warning and a note.

    Parameters
    ----------
    path : file with definitions and values, in any self-describing dialect.
    sample : name of the sample that defines the rows; default: the sample with the most values.
    rate : sample rate [Hz] of this sample. Default: from a field t_us [us], tm [ms], t or time [s] of the sample.
    raw : keep rows with non-increasing time.

    Returns
    -------
    Table : t = 0 at the first row. LabComm streams contain no units. The units of the bridge's rows are known; all
        other columns have unit 1.

    Raises
    ------
    LogError : the file is missing, is not a LabComm stream, or is malformed (the message states the byte). Also raised
        if the stream has no values, no clock or almost empty columns, or declares a sample twice (as numbers and
        strings, or with arrays of different dimensions).
    UnknownName : `sample` has no values; the message lists the samples with values.
    ShapeError : `rate` is not a single number.
    """
    path = Path(path)
    if rate is not None and not 0.0 < number(rate, "the rate [Hz]") < np.inf:
        raise LogError(f"Expected a rate above 0 Hz, got {rate}.")
    samples, torn = _samples(path)
    counts: dict[str, int] = {}
    for one in samples:
        counts[one.name] = counts.get(one.name, 0) + 1
    if not counts:
        raise LogError(f"Expected values of samples in the LabComm stream {path}, got only definitions.")
    if sample is not None:
        check_name(sample, "sample with values", counts)
    pace = max(counts, key=counts.__getitem__) if sample is None else sample
    try:
        leaves = _leaves(samples, pace)
        sizes = {label: leaf.size for label, leaf in leaves.items()}
        for label, leaf in leaves.items():
            refuse_ragged(max(len(leaf.values), counts[pace]), {label: leaf.size}, leaf.held)
        refuse_ragged(counts[pace], sizes, sum(leaf.held for leaf in leaves.values()))
    except LogError as error:
        raise LogError(f"Expected samples that form a table in {path}, got invalid samples: {error}") from None
    columns = {label: _column(leaf, counts[pace]) for label, leaf in leaves.items()}
    t = _clock(path, columns, pace, counts[pace], rate)
    notes: tuple[str, ...] = ()
    if torn:
        notes = (f"{path.name} ends within a packet: its last {torn} bytes are skipped",)
        warnings.warn(notes[0], stacklevel=2)
    t, keep, dropped = rows_in_order(t, raw)
    try:
        return Table(
            t[keep],
            {label: values[keep] for label, values in columns.items()},
            {label: Column(unit=_unit(label), kind=_KINDS[values.dtype.kind]) for label, values in columns.items()},
            notes=(*notes, *dropped),
            source=(f"{path.name} sha256 {file_hash(path)}",),
        )
    except ArmlabError as error:
        raise LogError(f"Expected samples that match the glossary in {path}, got invalid samples: {error}") from None


def _samples(path: Path) -> tuple[list[Sample], int]:
    """Return the values in the file, in order, and the number of incomplete bytes at its end."""
    decoder, found = Decoder(limits=Limits.file()), []
    try:
        with path.open("rb") as file:
            piece = file.read(_PIECE)
            if format_of(piece[:FIRST]) != "LabComm":
                raise LogError(f"Expected a LabComm stream at {path}, got a file of format {format_of(piece[:FIRST])}.")
            while piece:
                found += [event for event in decoder.feed(piece) if isinstance(event, Sample)]
                piece = file.read(_PIECE)
    except OSError as error:
        raise LogError(f"Expected a log at {path}, got: {error.strerror}.") from None
    except LabCommError as error:
        raise LogError(
            f"Expected a valid LabComm stream in {path}, got an error at byte {error.offset}: {error}"
        ) from None
    return found, decoder.pending


def _leaves(samples: Sequence[Sample], pace: str) -> dict[str, _Leaf]:
    """Return the leaves of all samples by label, starting with the defining sample."""
    leaves: dict[str, _Leaf] = {}
    row = 0
    for one in sorted(samples, key=lambda one: one.name != pace)[:1]:
        leaves.update({label: _Leaf(dtype) for label, dtype, _ in _parts(one.name, one.type, one.value)})
    for one in samples:
        for label, dtype, value in _parts(one.name, one.type, one.value):
            leaf = leaves.setdefault(label, _Leaf(dtype))
            leaf.add(value, dtype, row, label)
        row += one.name == pace
    return leaves


def _parts(label: str, node: Any, value: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the label, type and value of each leaf; a numeric array is one leaf."""
    if isinstance(node, Struct):
        for one in node.fields:
            yield from _parts(f"{label}.{one.name}", one.type, value[one.name])
    elif isinstance(node, Prim):
        yield label, _TYPES.get(node.name, np.int64), value
    elif isinstance(node, Array) and isinstance(node.elem, Prim) and node.elem.name != "string":
        value = np.frombuffer(value, dtype=np.uint8) if isinstance(value, bytes) else value
        yield label, _TYPES.get(node.elem.name, np.int64), value
    elif isinstance(node, Array):
        for place, element in _elements(value, len(node.dims)):
            yield from _parts(label + place, node.elem, element)


def _elements(value: Any, depth: int) -> Iterator[tuple[str, Any]]:
    if not depth:
        yield "", value
        return
    for index, part in enumerate(value):
        for place, element in _elements(part, depth - 1):
            yield f"[{index}]{place}", element


def _column(leaf: _Leaf, rows: int) -> np.ndarray:
    """Return the values (rows, ...) of a leaf, each held until the next value; integers with gaps become floats."""
    shape, axes = leaf.shape, len(leaf.shape)
    whole = leaf.rows[0] == 0 and all(value.shape == shape for value in leaf.values)
    if whole or leaf.dtype is np.str_:
        block = np.array(leaf.values, dtype=leaf.dtype)
    else:
        block = np.full((len(leaf.values), *shape), np.nan)
        for row, value in enumerate(leaf.values):
            if value.ndim == axes:
                block[(row, *(slice(size) for size in value.shape))] = value
    newest = np.searchsorted(leaf.rows, np.arange(rows), side="right") - 1
    held = block[np.maximum(newest, 0)]
    if newest[0] < 0:
        held[newest < 0] = "" if leaf.dtype is np.str_ else np.nan
    return held


def _clock(path: Path, columns: dict[str, np.ndarray], pace: str, rows: int, rate: float | None) -> np.ndarray:
    if rate is not None:
        return np.arange(rows) / rate
    name = next((name for name in _CLOCKS if f"{pace}.{name}" in columns), None)
    stamps = columns[f"{pace}.{name}"] if name else np.zeros(0)
    if name is None or stamps.ndim != 1 or stamps.dtype.kind not in "if" or not np.isfinite(stamps).all():
        raise LogError(
            f"Expected a clock ({', '.join(_CLOCKS)}) in the sample {pace!r} of {path}, got {', '.join(columns)}. "
            f"Pass the rate of this sample: log.read_labcomm(path, rate=250.0)."
        )
    steps = np.diff(stamps, prepend=stamps[:1])
    if name == "tm":
        steps = (steps + _WRAP // 2) % _WRAP - _WRAP // 2
    return np.cumsum(steps) * _CLOCKS[name]


def _unit(label: str) -> str | None:
    name, _, leaf = label.partition(".")
    if label in glossary.columns():
        return None
    return _UNITS.get(leaf, "1") if name in _BRIDGE else "1"
