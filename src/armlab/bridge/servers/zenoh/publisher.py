"""What goes out under a key, as long as somebody reads it: `Output`, and `Waiting`, which waits for a slow reader."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable
from typing import Any

from armlab.bridge.servers.zenoh.session import zenoh

__all__ = ["Output", "Waiting"]

_WAITING = 2500  # rows of a recorder that is slow: 10 s of one arm
_LAST = 1.0  # s for what waits at the end


class Output:
    """One key. Nothing is sent while nobody reads it; for a slow reader it is dropped."""

    def __init__(self, session: Any, key: str, changed: Callable[[], None] = lambda: None) -> None:
        self.wanted, self.sent, self.dropped = False, 0, 0
        self._changed = changed
        self._publisher = self._declared(session, key)
        self._listener = self._publisher.declare_matching_listener(self._matched)
        self.wanted = self.wanted or self._publisher.matching_status.matching

    def put(self, data: bytes, attachment: bytes | None = None) -> None:
        """Send when it is wanted."""
        if self.wanted:
            self._publisher.put(data, attachment=attachment)
            self.sent += 1

    def _declared(self, session: Any, key: str) -> Any:
        control = zenoh().CongestionControl.DROP
        return session.declare_publisher(key, congestion_control=control, express=True)

    def _matched(self, status: Any) -> None:
        self.wanted = status.matching
        self._changed()


class Waiting(Output):
    """The same for readers that must have everything: a thread of its own waits for the slow one.

    A reader that stands still loses its connection when the buffers on the way are full, after some seconds; it gets
    rows again when it has connected again, and the hole shows in their numbers.
    """

    def __init__(self, session: Any, key: str) -> None:
        self._queue: queue.Queue[tuple[bytes, bytes | None] | None] = queue.Queue(_WAITING)
        self._thread = threading.Thread(target=self._send, name=key, daemon=True)
        super().__init__(session, key)
        self._thread.start()

    def put(self, data: bytes, attachment: bytes | None = None) -> None:
        """Queue what is wanted."""
        if self.wanted:
            try:
                self._queue.put_nowait((data, attachment))
            except queue.Full:
                self.dropped += 1

    def close(self) -> None:
        """Send what waits, and end; call it before the session is closed."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=_LAST)
        self._thread.join(_LAST)

    def _declared(self, session: Any, key: str) -> Any:
        module = zenoh()
        return session.declare_publisher(
            key,
            congestion_control=module.CongestionControl.BLOCK,
            priority=module.Priority.DATA_LOW,  # a queue of its own: what others read goes on meanwhile
            express=True,
        )

    def _send(self) -> None:
        while (message := self._queue.get()) is not None:
            try:
                self._publisher.put(message[0], attachment=message[1])
                self.sent += 1
            except zenoh().ZError:  # the session is closed
                self.dropped += 1
