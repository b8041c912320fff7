"""`Inbox`: what has come and waits for the thread that reads it, bounded in number and in bytes."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

__all__ = ["Inbox"]

_LARGEST = 2**26  # bytes of all that wait: ten seconds of all rows of twenty arms
_LEAST = 256  # bytes that a message is counted for at least

T = TypeVar("T")


class Inbox(Generic[T]):
    """Messages from Zenoh's threads; when too much waits the oldest are lost.

    Parameters
    ----------
    most : messages.
    """

    def __init__(self, most: int) -> None:
        self._most, self._size = most, 0
        self._waiting: deque[tuple[int, T]] = deque()
        self._came = threading.Condition(threading.Lock())

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, message: T, size: int = 0) -> None:
        """Keep a message, and wake who waits.

        Parameters
        ----------
        message : of any kind. size : bytes that it had.
        """
        size = max(size, _LEAST)
        with self._came:
            while self._waiting and (len(self._waiting) >= self._most or self._size + size > _LARGEST):
                self._size -= self._waiting.popleft()[0]
            self._waiting.append((size, message))
            self._size += size
            self._came.notify()

    def get(self, patience: float = 0.0) -> T | None:
        """Return the oldest message and forget it, None when none comes in time.

        Parameters
        ----------
        patience : s to wait for one.
        """
        with self._came:
            if not self._waiting and not (patience > 0.0 and self._came.wait(patience) and self._waiting):
                return None
            size, message = self._waiting.popleft()
            self._size -= size
            return message

    def wait(self, patience: float) -> bool:
        """Return whether a message waits, or comes in time.

        Parameters
        ----------
        patience : s to wait for one.
        """
        with self._came:
            return bool(self._waiting) or self._came.wait(patience)
