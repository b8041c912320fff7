"""`Subscription`: what one client wants of one topic: in which dialect, how often at most, how many that wait."""

from __future__ import annotations

from collections import deque

from armlab.bridge.rosbridge.dialect import Dialect
from armlab.bridge.rosbridge.operations import full_name
from armlab.bridge.rosbridge.outbox import Outbox

__all__ = ["Subscription"]

_IDS = 16  # of one topic; who gives more ids has lost count


class Subscription:
    """One topic for one client. Several ids share it: the topic comes once, as the most eager of them wants.

    Parameters
    ----------
    topic : its name as the client spells it. outbox : of the client. dialect : see `dialect.Dialect`.

    Attributes
    ----------
    topic, dialect : as given. full_name : of the topic.
    """

    def __init__(self, topic: str, outbox: Outbox, dialect: Dialect) -> None:
        self.dialect: Dialect = dialect
        self.topic, self.full_name, self._outbox = topic, full_name(topic), outbox
        self._ids: dict[str, tuple[int, int]] = {}
        self._waiting: deque[bytes] = deque()
        self._every_ns = self._most = self._due_ns = 0

    def add(self, id_: str, throttle_ms: float, queue_length: int) -> None:
        """Take what one id wants.

        Parameters
        ----------
        id_ : of the client's own. throttle_ms : least time between two messages.
        queue_length : messages that wait at most; 0 throws away what comes too early.
        """
        self._ids[id_] = (int(1e6 * throttle_ms), queue_length)
        while len(self._ids) > _IDS:
            del self._ids[next(iter(self._ids))]
        self._agree()

    def remove(self, id_: str | None) -> bool:
        """Forget one id, or all of them for None; return whether nothing is wanted any more.

        Parameters
        ----------
        id_ : of the client's own.
        """
        if id_ is None:
            self._ids.clear()
        self._ids.pop(id_ or "", None)
        self._agree()
        return not self._ids

    def is_due(self, now_ns: int) -> bool:
        """Return whether a message of now would be sent or would wait; sends what waited long enough.

        Parameters
        ----------
        now_ns : monotonic clock.
        """
        if self._waiting and now_ns >= self._due_ns:
            self._send(self._waiting.popleft(), now_ns)
        return self._most > 0 or now_ns >= self._due_ns

    def offer(self, data: bytes, now_ns: int) -> None:
        """Send a message, let it wait, or throw it away.

        Parameters
        ----------
        data : encoded, in the dialect. now_ns : monotonic clock.
        """
        if now_ns >= self._due_ns and not self._waiting:
            self._send(data, now_ns)
        elif self._most:
            self._waiting.append(data)
            while len(self._waiting) > self._most:
                self._waiting.popleft()
                self._outbox.dropped += 1

    def _send(self, data: bytes, now_ns: int) -> None:
        self._due_ns = now_ns + self._every_ns
        self._outbox.put(data, now_ns, self.topic, 0 if self._every_ns else self._most)

    def _agree(self) -> None:
        self._every_ns = min((every for every, _ in self._ids.values()), default=0)
        self._most = min((most for _, most in self._ids.values()), default=0)
