"""Events of a run: the callback type `Tell`, the null callback `nobody`, and the rate limit `Limited`."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

_EVERY = 1_000_000_000  # ns between two events of one kind
_EACH = 50  # events of a kind in that time with each=True: commanding clients may change ten times a second
_KINDS = 64  # limited separately; further kinds share one limit
_CHANGING = re.compile(r"'[^']*'|\"[^\"]*\"|\d[\d.]*")  # may differ between events of one kind


class Tell(Protocol):
    """Callback for events."""

    def __call__(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Report one event; `warn` marks a problem, and `each` keeps later events of its kind from replacing it."""
        ...


def nobody(text: str, warn: bool = False, each: bool = False) -> None:
    """Ignore an event."""


@dataclass(slots=True)
class _Kind:
    """Rate limit of one kind: start of its interval, events reported in it, pending event, events it replaced."""

    reported_ns: int
    reported: int = 1
    pending: tuple[str, bool, int] | None = None
    replaced: int = 0


class Limited:
    """Rate limit for events: the first event of each kind is reported immediately, then at most one per second.

    Events are of one kind if they differ only in numbers and quoted words. The newest event within a second is delayed
    to the end of that second; it keeps its timestamp and counts the events it replaced. A condition that changes with
    every packet therefore cannot fill the disk, and its last state is always reported. Events with ``each=True`` are
    limited to fifty per second and kind.
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
            if name not in self._kinds and len(self._kinds) >= _KINDS:
                self._forget(stamp_ns)
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
            for kind in sorted(ready, key=_stamp):
                if kind.pending is not None:
                    (text, warn, stamp_ns), replaced = kind.pending, kind.replaced
                    kind.reported_ns, kind.reported, kind.pending, kind.replaced = now_ns, 1, None, 0
                    self.waiting -= 1
                    self._report(f"{text} ({replaced} similar events skipped.)" if replaced else text, warn, stamp_ns)

    def _forget(self, now_ns: int) -> None:
        """Forget the kinds without a recent event."""
        self._kinds = {
            name: kind for name, kind in self._kinds.items() if kind.pending is not None or not _is_over(kind, now_ns)
        }


def _is_over(kind: _Kind, now_ns: int) -> bool:
    return abs(now_ns - kind.reported_ns) >= _EVERY  # a robot's clock may be set back


def _stamp(kind: _Kind) -> int:
    return 0 if kind.pending is None else kind.pending[2]
