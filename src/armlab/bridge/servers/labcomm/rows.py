"""LabComm rows of an arm: `Row`, and `RowTypes`, the sample types of a port.

On the wire, joints are in ABB's order (axes 1 to 6, then 7) unless the port is set to "chain". In a `Row`, joints are
in kinematic order from base to tool. Missing vectors are NaN on the wire and None in a `Row`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from armlab.errors import ConfigError, LabCommError
from armlab.wire.labcomm import Sample, idl, parse_lc
from armlab.wire.labcomm.types import Array, Event, Prim, SampleType, Struct

Order = Literal["abb", "chain"]
"""Order of the joints on the wire."""

STOP = idl.samples("armlab")["stop"]
"""``sample void stop``, which brings all arms to rest; accepted from any client on any port."""

_YUMI = (1, 2, 7, 3, 4, 5, 6)
_VECTORS = ("pos", "vel", "trq")


class Row(NamedTuple):
    """One row of an arm, in kinematic joint order.

    Attributes
    ----------
    tm : int, ms
        Timestamp of the robot's packet, modulo 2**32; in a command, the timestamp of the answered row.
    q : array, shape (n,), rad
        Positions; None if missing. When sending, any sequence is accepted.
    qd : array, shape (n,), rad/s
        Velocities; None if missing.
    tau : array, shape (n,), N m
        Torques; None if missing.
    """

    tm: int
    q: np.ndarray | None = None
    qd: np.ndarray | None = None
    tau: np.ndarray | None = None


def signed(tm: int) -> int:
    """Return a timestamp modulo 2**32 as LabComm's signed int."""
    return (tm + 2**31) % 2**32 - 2**31


class RowTypes:
    """Sample types and joint order of an arm's port."""

    sent: SampleType
    accepted: SampleType

    def __init__(self, axes: Sequence[int] = _YUMI, order: Order = "abb", text: str | None = None) -> None:
        self.n: int = len(axes)
        if sorted(axes) != list(range(1, self.n + 1)) or order not in ("abb", "chain"):
            raise ConfigError(
                f'Expected ABB\'s axis numbers from 1 to n and order "abb" or "chain", got {tuple(axes)} and {order!r}.'
            )
        if text is None and self.n != 7:
            text = idl.text("armlab").partition("// t_us")[0].replace("[7]", f"[{self.n}]")
        found = [one for one in parse_lc(text or idl.text("armlab")) if isinstance(one, SampleType)]
        found = found[:2] if text is None else found
        if not found:
            raise LabCommError(
                "Expected .lc text that defines the sent and the accepted sample, got no definition of either."
            )
        self.sent, self.accepted = found[0], found[-1]
        for sample in (self.sent, self.accepted):
            self._check(sample)
        columns = np.arange(self.n) if order == "chain" else np.asarray(axes) - 1
        self._to_chain, self._to_wire = columns, np.argsort(columns).tolist()

    def accepts(self, sample: SampleType) -> bool:
        """Return whether a client's type is a command: a subset of the accepted type's fields, including `pos`."""
        ours, theirs = _fields(self.accepted), _fields(sample)
        fits = "pos" in theirs and all(ours.get(name) == node for name, node in theirs.items())
        return sample.name == self.accepted.name and fits

    def value(self, row: Row, sample: SampleType | None = None) -> dict[str, Any]:
        """Convert a row to its wire value, with NaN for missing vectors."""
        parts = {"pos": row.q, "vel": row.qd, "trq": row.tau}
        names = _fields(self.sent if sample is None else sample)
        return {name: signed(row.tm) if name == "tm" else self._wired(name, parts[name]) for name in names}

    def row(self, value: Mapping[str, Any]) -> Row:
        """Convert a wire value to a row, with None for missing fields."""
        parts = [self._chained(name, value.get(name)) for name in _VECTORS]
        return Row(value.get("tm", 0), *parts)

    def rows(self, events: Iterable[Event]) -> list[Row]:
        """Return the rows among the events, which are the samples of type `sent`."""
        accepted = self.sent.name, self.sent.type
        return [self.row(one.value) for one in events if isinstance(one, Sample) and (one.name, one.type) == accepted]

    def command(self, value: Mapping[str, Any]) -> Row:
        """Convert a wire value to a command; omit `vel` or `trq` if all its elements are zero or NaN."""
        row = self.row(value)
        if row.q is None or not np.isfinite(row.q).all():
            raise LabCommError(f"Expected finite positions in a command, got {value.get('pos')}.")
        return Row(row.tm, row.q, _commanded(row.qd, "vel", value), _commanded(row.tau, "trq", value))

    def _wired(self, name: str, part: Any) -> list[float]:
        if part is None:
            return [math.nan] * self.n
        array = np.asarray(part, dtype=float)
        if array.shape != (self.n,):
            raise LabCommError(f"Expected {self.n} numbers in {name} of a row, got shape {array.shape}.")
        part = array.tolist()
        return [part[k] for k in self._to_wire]

    def _chained(self, name: str, part: Sequence[float] | None) -> np.ndarray | None:
        if part is None:
            return None
        if len(part) != self.n:
            raise LabCommError(f"Expected {self.n} numbers in {name} of a row, got {len(part)}.")
        return np.array(part, dtype=float)[self._to_chain]

    def _check(self, sample: SampleType) -> None:
        fields = _fields(sample)
        numbers = {name: node for name, node in fields.items() if name in _VECTORS and _is_vector(node, self.n)}
        stamps = {name: node for name, node in fields.items() if name == "tm" and _named(node) in ("int", "long")}
        if not numbers or len(numbers) + len(stamps) != len(fields):
            raise LabCommError(
                f"Expected {sample.name} to be a struct with fields among tm (int, long), pos, vel and trq (float or "
                f"double, [{self.n}] or [_]), got {', '.join(fields) or 'no struct'}."
            )


def _commanded(part: np.ndarray | None, name: str, value: Mapping[str, Any]) -> np.ndarray | None:
    """Return a vector of a command, or None if all its elements are zero or NaN."""
    if part is None or not np.nan_to_num(part).any():
        return None
    if np.isinf(part).any():
        raise LabCommError(f"Expected finite numbers in {name} of a command, got {value[name]}.")
    return np.nan_to_num(part)


def _fields(sample: SampleType) -> dict[str, Any]:
    return {field.name: field.type for field in sample.type.fields} if isinstance(sample.type, Struct) else {}


def _named(node: object) -> str:
    return node.name if isinstance(node, Prim) else ""


def _is_vector(node: object, n: int) -> bool:
    return isinstance(node, Array) and node.dims in ((n,), (0,)) and _named(node.elem) in ("float", "double")
