"""How the bytes of messages are made from rows without their objects: templates for `kernels.RowMessages`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from struct import Struct
from typing import Any

import numpy as np

from armlab.bridge.servers.ros.mapping import Form, Kind
from armlab.bridge.servers.ros.types import store
from armlab.robots import Robot

__all__ = ["Encode", "cdr", "plan"]

Encode = Callable[[Any, str], bytes]
"""Bytes of a message of `store`, of a type."""

_SECOND = 1_000_000_000
_KINDS = (Kind.COPIED, Kind.TURNED, Kind.POSE)
_POSE = 7  # numbers

Variant = tuple[bytes, int, list[tuple[int, int, int]]]


def plan(form: Form, robot: Robot, places: Mapping[str, tuple[Struct, int]], encode: Encode) -> tuple[Any, ...]:
    """Return how `kernels.RowMessages` makes the messages of a topic."""
    columns = [(places[name][1], places[name][0].size // 8) for name in form.fields]
    variants = [
        _variant(form, robot, [column if bits >> k & 1 else None for k, column in enumerate(columns)], encode)
        for bits in range(1 << len(columns))
    ]
    return places["fresh"][1], columns, variants, _KINDS.index(form.kind), robot.chain, places["q"][1]


def _variant(form: Form, robot: Robot, there: list[tuple[int, int] | None], encode: Encode) -> Variant | None:
    """Return the template of rows with these columns, each a place and a count."""
    held = [column for column in there if column is not None]
    if not held:
        return None
    if form.kind is Kind.COPIED:
        counts = [0 if column is None else column[1] for column in there]
    else:
        counts = [_POSE if form.kind is Kind.POSE else held[0][1]]
    template, (stamp, *slots) = _template(form, robot, counts, encode)
    copies = [(to, at, count) for to, (at, _), count in zip(slots, held, filter(None, counts))]
    return template, stamp, copies


def _template(form: Form, robot: Robot, counts: list[int], encode: Encode) -> tuple[bytes, list[int]]:
    """Return a message, and where its stamp and its columns begin.

    They are seen by two messages that differ in every byte of them, and nowhere else: no format is known here.
    """
    numbers = Struct(f"<iI{sum(counts)}d")

    def encoded(value: int) -> bytes:
        sec, nanosec, *values = numbers.unpack(bytes([value]) * numbers.size)
        stops = np.cumsum(counts).tolist()
        columns = tuple(tuple(values[stop - count : stop]) for stop, count in zip(stops, counts))
        return encode(form.message(robot, sec * _SECOND + nanosec, columns), form.type)

    zeros, ones = encoded(0), encoded(1)
    differ = np.frombuffer(zeros, np.uint8) != np.frombuffer(ones, np.uint8)
    return zeros, np.flatnonzero(np.diff(differ, prepend=False) & differ).tolist()


def cdr(message: Any, type: str) -> bytes:
    """Return a message as ROS 2 has it on the wire, little-endian, behind its 4 bytes."""
    return bytes(store().serialize_cdr(message, type))
