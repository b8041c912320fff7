"""Printing of the commands: results to standard output, messages to standard error."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

__all__ = ["aligned", "note", "print_json", "result"]


def result(text: str) -> None:
    """Write a line of result to standard output."""
    sys.stdout.write(f"{text}\n")


def note(text: str) -> None:
    """Write a message for the reader to standard error."""
    sys.stderr.write(f"{text}\n")


def print_json(data: Any) -> None:
    """Write data as JSON to standard output: arrays become lists, values that are not finite null."""
    sys.stdout.write(json.dumps(_plain(data), indent=2, ensure_ascii=False) + "\n")


def aligned(rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Return rows of words as lines with aligned columns; `right` numbers the columns of figures."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))] if rows else []
    lines = []
    for row in rows:
        words = [
            word.rjust(width) if i in right else word.ljust(width)
            for i, (word, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(words).rstrip())
    return "\n".join(lines)


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {str(key): _plain(value) for key, value in data.items()}
    if isinstance(data, np.ndarray | np.generic):
        return _plain(data.tolist())
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if isinstance(data, float) and not np.isfinite(data):
        return None
    return data
