"""`Outbox`: what waits for one client; who does not read loses the oldest, and is closed in the end."""

from __future__ import annotations

from collections import Counter, deque
from typing import NamedTuple

__all__ = ["Outbox"]

_KEPT = 1_000_000_000  # ns that a message waits at most
_PATIENCE = 10_000_000_000  # ns without progress after which a client is given up
_LARGEST = 4 * 2**20  # bytes that wait at most


class _Waiting(NamedTuple):
    """One message, when it came, and its topic."""

    ns: int
    topic: str
    data: bytes


class Outbox:
    """Messages for one client, in order.

    Attributes
    ----------
    sent, dropped : messages taken out to be sent, and thrown away.
    """

    def __init__(self) -> None:
        self._waiting: deque[_Waiting] = deque()
        self._of_topic: Counter[str] = Counter()
        self._bytes = 0
        self._since_ns: int | None = None
        self.sent = self.dropped = 0

    def put(self, data: bytes, now_ns: int, topic: str = "", most: int = 0) -> None:
        """Let a message wait; what has waited for more than 1 s goes.

        Parameters
        ----------
        data : the message. now_ns : monotonic clock. topic : of what is published.
        most : messages of this topic that wait at most, 0 for any number; the oldest of them goes.
        """
        if self._since_ns is None:
            self._since_ns = now_ns
        while self._waiting and (now_ns - self._waiting[0].ns > _KEPT or self._bytes + len(data) > _LARGEST):
            self._drop(0)
        if most and self._of_topic[topic] >= most:
            self._drop(next(k for k, one in enumerate(self._waiting) if one.topic == topic))
        self._waiting.append(_Waiting(now_ns, topic, data))
        self._of_topic[topic] += 1
        self._bytes += len(data)

    def take(self, most: int) -> list[bytes]:
        """Return the next messages, for a client that takes them now.

        Parameters
        ----------
        most : bytes, and one message more.
        """
        self._since_ns = None
        found: list[bytes] = []
        while self._waiting and most > 0:
            found.append(self._remove(0).data)
            most -= len(found[-1])
        self.sent += len(found)
        return found

    def is_stuck(self, now_ns: int) -> bool:
        """Return whether the client has taken nothing for 10 s although something came for it.

        Parameters
        ----------
        now_ns : monotonic clock.
        """
        return self._since_ns is not None and now_ns - self._since_ns > _PATIENCE

    def _drop(self, k: int) -> None:
        self._remove(k)
        self.dropped += 1

    def _remove(self, k: int) -> _Waiting:
        one = self._waiting[k]
        del self._waiting[k]
        self._of_topic[one.topic] -= 1
        self._bytes -= len(one.data)
        return one
