"""Numbers out of messages in JSON and protobuf, one message at a time, by dotted name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import msgspec
import numpy as np

from armlab.errors import LogError
from armlab.log.holes import refuse_holes
from armlab.log.mcap_decode import Decoded

__all__ = ["decode_one_by_one", "numbers_in_json", "numbers_in_protobuf"]

Numbers = dict[str, Any]
"""Dotted name -> a number, or a list of them."""

_MAX_DEPTH = 32
_MAX_NAMES = 4096  # in one message; more are the parts of a cloud or a map
_LARGEST = 2**63  # larger integers are real numbers, as far as these go
_PROTOBUF_MESSAGE, _PROTOBUF_NUMBERS = 11, {1, 2, 3, 4, 5, 6, 7, 8, 13, 14, 15, 16, 17, 18}


def decode_one_by_one(
    messages: Iterable[tuple[int, int, bytes]], numbers: Callable[[bytes], Numbers]
) -> tuple[Decoded, int, str]:
    """Return the numbers of messages, how many messages are left out, and why one of them is.

    Parameters
    ----------
    messages : sequence number, log time [ns] and bytes of each. numbers : takes one apart; LogError where it cannot.
    """
    sequence: list[int] = []
    log_ns: list[int] = []
    columns: dict[str, tuple[list[int], list[Any]]] = {}
    bad, reason = 0, ""
    for number, stamp, raw in messages:
        try:
            found = numbers(raw)
        except LogError as error:
            bad, reason = bad + 1, reason or str(error)
            continue
        for name, value in found.items():
            rows, values = columns.setdefault(name, ([], []))
            rows.append(len(sequence))
            values.append(value)
        sequence.append(number)
        log_ns.append(stamp)
    widths = {name: max(map(_size, values)) for name, (_, values) in columns.items()}
    try:
        refuse_holes(len(sequence), widths, sum(sum(map(_size, values)) for _, values in columns.values()))
    except LogError as error:
        bad, reason = bad + len(sequence), str(error)
        sequence, log_ns, columns = [], [], {}
    fields = {name: _array(len(sequence), *column, widths[name]) for name, column in columns.items()}
    return Decoded(np.array(sequence, dtype=np.uint32), np.array(log_ns, dtype=np.int64), fields), bad, reason


def _size(value: Any) -> int:
    return len(value) if isinstance(value, list) else 1


def _array(count: int, rows: list[int], values: list[Any], width: int) -> np.ndarray:
    """Return numbers or lists of numbers in these of the rows as (N, k), NaN where there is none."""
    if len(rows) == count and all(isinstance(value, bool) for value in values):
        return np.array(values)[:, None]
    if len(rows) == count and all(isinstance(value, int) for value in values):
        try:
            return np.array(values, dtype=np.int64)[:, None]
        except OverflowError:
            pass
    array = np.full((count, width), np.nan)
    for row, value in zip(rows, values, strict=True):
        array[row, : _size(value)] = value
    return array


def numbers_in_json(raw: bytes) -> Numbers:
    """Return the numbers of a message in JSON; lists of numbers stay whole, texts are left out.

    Raises
    ------
    LogError : no JSON.
    """
    found: Numbers = {}
    try:
        _collect(msgspec.json.decode(raw), "", found, 0)
    except (ValueError, RecursionError, OverflowError) as error:
        raise LogError(f"Expected a message in JSON, got: {str(error).rstrip('.')}.") from None
    return found


def _collect(value: Any, path: str, found: Numbers, depth: int) -> None:
    if depth > _MAX_DEPTH or len(found) > _MAX_NAMES:
        return
    if isinstance(value, dict):
        for key, inner in value.items():
            _collect(inner, f"{path}.{key}" if path else str(key), found, depth + 1)
    elif isinstance(value, int | float):
        found[path or "value"] = value if -_LARGEST <= value < _LARGEST else float(value)
    elif isinstance(value, list):
        if value and all(isinstance(one, int | float) for one in value):
            found[path or "value"] = [float(one) for one in value]
        else:
            for index, inner in enumerate(value[:_MAX_NAMES]):
                _collect(inner, f"{path}[{index}]", found, depth + 1)


def numbers_in_protobuf(name: str, definition: bytes) -> Callable[[bytes], Numbers]:
    """Return what takes messages in protobuf apart.

    Parameters
    ----------
    name : of the message type. definition : a FileDescriptorSet with the files that it needs.

    Raises
    ------
    LogError : the definition cannot be read.
    """
    from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory

    try:
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(definition).file:
            pool.Add(file)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    except (message.DecodeError, KeyError, TypeError, ValueError) as error:
        raise LogError(f"Expected the definition of {name} in protobuf, got something else: {error}.") from None

    def numbers(raw: bytes) -> Numbers:
        found: Numbers = {}
        try:
            _collect_protobuf(kind.FromString(raw), "", found, 0)
        except (message.DecodeError, ValueError, RecursionError) as error:
            raise LogError(f"Expected a {name} in protobuf, got: {str(error).rstrip('.')}.") from None
        return found

    return numbers


def _collect_protobuf(message: Any, path: str, found: Numbers, depth: int) -> None:
    if depth > _MAX_DEPTH or len(found) > _MAX_NAMES:
        return
    for field in message.DESCRIPTOR.fields:
        there, value = f"{path}.{field.name}" if path else field.name, getattr(message, field.name)
        several = _is_repeated(field, value)
        if field.type == _PROTOBUF_MESSAGE and several and not isinstance(value, Mapping):
            for index, inner in enumerate(value[:_MAX_NAMES]):
                _collect_protobuf(inner, f"{there}[{index}]", found, depth + 1)
        elif field.type == _PROTOBUF_MESSAGE and not several and message.HasField(field.name):
            _collect_protobuf(value, there, found, depth + 1)
        elif field.type in _PROTOBUF_NUMBERS:
            found[there] = [float(one) for one in value] if several else value


def _is_repeated(field: Any, value: Any) -> bool:
    """Tell whether a field is a list or a map; protobuf has asked this in two ways."""
    return bool(getattr(field, "is_repeated", hasattr(value, "__len__") and not isinstance(value, str | bytes)))
