"""The guard thread that answers when the controller does not, and `Lateness`, which says when it was too often."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from armlab.bridge.conditions import GUARD_PRIORITY, priority

__all__ = ["Guard", "Lateness"]

_ROW = 5  # late cycles in a row
_SHARE = 0.05  # of the cycles of one second
_WINDOW = 1_000_000_000  # ns
_LONGEST_CALL = 250_000_000  # ns
_PAUSE = 250_000_000  # ns without a call: the share counts from then on
_NAP = 2e-3  # s between two looks of the guard


class Lateness:
    """Says when late cycles are too many: 5 in a row, 5 % in 1 s, or one call above 0.25 s."""

    def __init__(self) -> None:
        self._row = self._recent_late = 0
        self._recent: deque[tuple[int, bool]] = deque()

    def add(self, now_ns: int, late: bool, call_ns: int) -> str:
        """Take one cycle and return why the controller must stop, "" when it need not.

        Parameters
        ----------
        now_ns : our monotonic clock. late : this cycle was, by the controller's fault. call_ns : time it spent.
        """
        self._row = self._row + 1 if late else 0
        if self._recent and now_ns - call_ns - self._recent[-1][0] > _PAUSE:
            self._recent.clear()  # a second of which most was a pause holds few cycles: one of them is not 5 %
            self._recent_late = 0
        self._recent.append((now_ns, late))
        self._recent_late += late
        while self._recent[0][0] < now_ns - _WINDOW:
            self._recent_late -= self._recent.popleft()[1]
        full = now_ns - self._recent[0][0] > 0.9 * _WINDOW
        if call_ns > _LONGEST_CALL:
            return f"one call took {1e-9 * call_ns:.2f} s, allowed are {1e-9 * _LONGEST_CALL:.2f} s"
        if self._row >= _ROW:
            return f"{self._row} cycles in a row were late"
        if full and self._recent_late > _SHARE * len(self._recent):
            return f"{self._recent_late} of {len(self._recent)} cycles within one second were late"
        return ""


class Guard:
    """Thread that wakes at the deadline of each cycle and acts only when the loop is overdue.

    Parameters
    ----------
    overdue : called without a lock; returns the seconds until the loop will be overdue, 0 or less when it is.
    act : called when it is: answers for the loop.
    """

    def __init__(self, overdue: Callable[[], float], act: Callable[[], None]) -> None:
        self._overdue, self._act = overdue, act
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="armlab guard", daemon=True)

    def __enter__(self) -> Guard:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        with priority(GUARD_PRIORITY):
            while not self._stop.is_set():
                left = self._overdue()
                if left > 0.0:
                    time.sleep(min(left, _NAP))
                else:
                    self._act()
