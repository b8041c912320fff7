"""Events of a run: callback type `Tell`, null callback `nobody`, and rate limiter `Limited`."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

_EVERY = 1_000_000_000  # ns between reported events of one kind
_EACH = 50  # events of one kind per `_EVERY` with each=True: commanding clients may change ten times a second
_KINDS = 64  # kinds with their own limit; further kinds share one limit
_CHANGING = re.compile(r"'[^']*'|\"[^\"]*\"|\d[\d.]*")  # parts that may differ between events of one kind


class Tell(Protocol):
    """Callback for events."""

    def __call__(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Report one event; `warn` marks a problem, and `each` reports all events of a kind up to a limit."""
        ...


def nobody(text: str, warn: bool = False, each: bool = False) -> None:
    """Ignore an event."""


@dataclass(slots=True)
class _Kind:
    """State of the rate limiter for one kind of event: start of the interval, reported events, delayed event and number
    of replaced events."""

    reported_ns: int
    reported: int = 1
    pending: tuple[str, bool, int] | None = None
    replaced: int = 0


class Limited:
    """Rate limiter for events: the first event of a kind is reported immediately, later events at most once a second.

    Events that differ only in numbers and quoted words are of the same kind. The newest event within a second is
    delayed to the end of that second; its text states how many events it replaced. Thus a condition that changes with
    every packet cannot fill the disk, but its last state is always reported. Events with ``each=True`` are limited to
    fifty of each kind per second.
    """

    waiting: int

    def __init__(self, report: Callable[[str, bool, int], None]) -> None:
        self._report = report
        self._kinds: dict[str, _Kind] = {}
        self.waiting = 0
        self._lock = threading.RLock()  # a report may cause another event

    def __call__(self, text: str, warn: bool, stamp_ns: int, each: bool = False) -> None:
        with self._lock:
            self.due(stamp_ns)
            name = _CHANGING.sub("#", text)
            if name not in self._kinds and len(self._kinds) >= _KINDS:  # forget kinds without a recent event
                kinds = self._kinds.items()
                self._kinds = {key: kind for key, kind in kinds if kind.pending or not _is_over(kind, stamp_ns)}
                name = name if len(self._kinds) < _KINDS else ""
            kind = self._kinds.get(name)
            if kind is None:
                self._kinds[name] = _Kind(stamp_ns)
            elif _is_over(kind, stamp_ns):
                kind.reported_ns, kind.reported = stamp_ns, 1
            elif each and kind.reported < _EACH:
                kind.reported += 1
            else:
                self.waiting += kind.pending is None
                kind.replaced += kind.pending is not None
                kind.pending = (text, warn, stamp_ns)
                return
            self._report(text, warn, stamp_ns)

    def due(self, now_ns: int) -> None:
        if self.waiting:
            self._publish(lambda kind: _is_over(kind, now_ns), now_ns)

    def close(self) -> None:
        self._publish(lambda kind: True, 0)

    def _publish(self, condition: Callable[[_Kind], bool], now_ns: int) -> None:
        with self._lock:
            ready = [kind for kind in self._kinds.values() if kind.pending is not None and condition(kind)]
            for kind in sorted(ready, key=lambda kind: kind.pending[2] if kind.pending else 0):
                if kind.pending is not None:
                    (text, warn, stamp_ns), replaced = kind.pending, kind.replaced
                    kind.reported_ns, kind.reported, kind.pending, kind.replaced = now_ns, 1, None, 0
                    self.waiting -= 1
                    self._report(f"{text} ({replaced} similar events skipped.)" if replaced else text, warn, stamp_ns)


def _is_over(kind: _Kind, now_ns: int) -> bool:
    return abs(now_ns - kind.reported_ns) >= _EVERY  # a robot's clock may be set back
