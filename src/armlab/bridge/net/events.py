"""How the parts of a run tell what a user should know: `Tell`, `nobody`, who does not listen, and `Limited`."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

_EVERY = 1_000_000_000  # ns between two sentences of one kind
_EACH = 50  # of a kind in that time that are told one by one: arms that the lease frees change hands ten times a second
_KINDS = 64  # that are told apart at a time; more are a flood and share one turn
_CHANGING = re.compile(r"'[^']*'|\"[^\"]*\"|\d[\d.]*")  # what differs between sentences of one kind


class Tell(Protocol):
    """Takes sentences."""

    def __call__(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Take one sentence; `warn` when something is wrong, `each` when others like it do not stand for it."""
        ...


def nobody(text: str, warn: bool = False, each: bool = False) -> None:
    """Ignore a sentence."""


@dataclass(slots=True)
class _Kind:
    """When its turn began, how many were passed on in it, the one that waits since then, how many it has replaced."""

    told_ns: int
    told: int = 1
    waits: tuple[str, bool, int] | None = None
    left_out: int = 0


class Limited:
    """Passes sentences on: of each kind the first at once, then at most one a second.

    Sentences are of one kind when they differ only in numbers and quoted words. Of those that come too soon the newest
    waits for its turn, with its own stamp; it says how many it stands for. So something that flaps with every packet
    fills no disk, and its last state is always known.
    What must be told one by one is, up to fifty of a kind in a second; who sends more floods the log.
    """

    def __init__(self, tell: Callable[[str, bool, int], None]) -> None:
        self._tell = tell
        self._kinds: dict[str, _Kind] = {}
        self.waiting = 0
        self._lock = threading.RLock()  # to tell may lead to another sentence

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
                kind.told_ns, kind.told = stamp_ns, 1
            elif each and kind.told < _EACH:
                kind.told += 1
            else:
                self.waiting += kind.waits is None
                kind.left_out += kind.waits is not None
                kind.waits = (text, warn, stamp_ns)
                return
            self._tell(text, warn, stamp_ns)

    def due(self, now_ns: int) -> None:
        if self.waiting:
            self._publish(lambda kind: _is_over(kind, now_ns), now_ns)

    def close(self) -> None:
        self._publish(lambda kind: True, 0)

    def _publish(self, condition: Callable[[_Kind], bool], now_ns: int) -> None:
        with self._lock:
            ready = [kind for kind in self._kinds.values() if kind.waits is not None and condition(kind)]
            for kind in sorted(ready, key=_stamp):
                if kind.waits is not None:
                    (text, warn, stamp_ns), left_out = kind.waits, kind.left_out
                    kind.told_ns, kind.told, kind.waits, kind.left_out = now_ns, 1, None, 0
                    self.waiting -= 1
                    self._tell(f"{text} ({left_out} like it left out.)" if left_out else text, warn, stamp_ns)

    def _forget(self, now_ns: int) -> None:
        """Forget kinds of which nothing was heard lately."""
        self._kinds = {
            name: kind for name, kind in self._kinds.items() if kind.waits is not None or not _is_over(kind, now_ns)
        }


def _is_over(kind: _Kind, now_ns: int) -> bool:
    return abs(now_ns - kind.told_ns) >= _EVERY  # a robot's clock may begin anew


def _stamp(kind: _Kind) -> int:
    return 0 if kind.waits is None else kind.waits[2]
