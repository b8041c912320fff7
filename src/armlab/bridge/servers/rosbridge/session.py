"""`ClientSession`: state of one client, and messages to it."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec

from armlab.bridge.servers.rosbridge.protocol import Dialect, Level, full_name

__all__ = ["Outbox", "ClientSession", "PendingSetting", "Subscription"]

_KEPT = 1_000_000_000  # ns that a message waits at most
_PATIENCE = 10_000_000_000  # ns without progress after which a client is given up
_LARGEST = 4 * 2**20  # bytes that wait at most


class _Waiting(NamedTuple):
    """One message, when it came, and its topic."""

    ns: int
    topic: str
    data: bytes


class Outbox:
    """Messages for one client, in order."""

    def __init__(self) -> None:
        self._waiting: deque[_Waiting] = deque()
        self._of_topic: Counter[str] = Counter()
        self._bytes = 0
        self._since_ns: int | None = None
        self.sent = self.dropped = 0

    def put(self, data: bytes, now_ns: int, topic: str = "", most: int = 0) -> None:
        """Let a message wait; what has waited for more than 1 s goes."""
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
        """Return the next messages, for a client that takes them now."""
        self._since_ns = None
        found: list[bytes] = []
        while self._waiting and most > 0:
            found.append(self._remove(0).data)
            most -= len(found[-1])
        self.sent += len(found)
        return found

    def is_stuck(self, now_ns: int) -> bool:
        """Return whether the client has taken nothing for 10 s although something came for it."""
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


_IDS = 16  # of one topic; who gives more ids has lost count


class Subscription:
    """One topic for one client. Several ids share it: the topic comes once, as the most eager of them wants."""

    def __init__(self, topic: str, outbox: Outbox, dialect: Dialect) -> None:
        self.dialect: Dialect = dialect
        self.topic, self.full_name, self._outbox = topic, full_name(topic), outbox
        self._ids: dict[str, tuple[int, int]] = {}
        self._waiting: deque[bytes] = deque()
        self._every_ns = self._most = self._due_ns = 0

    def add(self, id_: str, throttle_ms: float, queue_length: int) -> None:
        """Take what one id wants."""
        self._ids[id_] = (int(1e6 * throttle_ms), queue_length)
        while len(self._ids) > _IDS:
            del self._ids[next(iter(self._ids))]
        self._agree()

    def remove(self, id_: str | None) -> bool:
        """Forget one id, or all of them for None; return whether nothing is wanted any more."""
        if id_ is None:
            self._ids.clear()
        self._ids.pop(id_ or "", None)
        self._agree()
        return not self._ids

    def is_due(self, now_ns: int) -> bool:
        """Return whether a message of now would be sent or would wait; sends what waited long enough."""
        if self._waiting and now_ns >= self._due_ns:
            self._send(self._waiting.popleft(), now_ns)
        return self._most > 0 or now_ns >= self._due_ns

    def offer(self, data: bytes, now_ns: int) -> None:
        """Send a message, let it wait, or throw it away."""
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


_LEVELS = ("info", "warning", "error", "none")


@dataclass(frozen=True)
class PendingSetting:
    """A parameter that a client has set by a service, until the loop has answered.

    sequence : of the parameter's last change when the loop was asked; None while an earlier setting of it waits, as
        the loop's answers name the parameter, not the call.
    """

    service: str
    id: str | int | None
    parameter: str
    value: Any
    until_ns: int
    sequence: int | None = None


class ClientSession:
    """One client."""

    def __init__(self, name: str, may_ask: bool) -> None:
        self.name, self.may_ask = name, may_ask
        self.outbox = Outbox()
        self.subscriptions: dict[str, Subscription] = {}
        self.advertised: set[str] = set()
        self.warned: set[str] = set()
        self.settings: list[PendingSetting] = []
        self.level: Level = "error"  # of the protocol

    def status(self, level: Level, text: str, now_ns: int, id_: str | int | None = None) -> None:
        """Tell the client what happened, if it wants to hear of it."""
        if _LEVELS.index(level) >= _LEVELS.index(self.level):
            about = {} if id_ is None else {"id": id_}
            self._send({"op": "status", **about, "level": level, "msg": text}, now_ns)

    def response(self, service: str, id_: str | int | None, values: Any, is_done: bool, now_ns: int) -> None:
        """Answer the call of a service."""
        about = {} if id_ is None else {"id": id_}
        message = {"op": "service_response", **about, "service": service, "values": values, "result": is_done}
        self._send(message, now_ns)

    def _send(self, message: dict[str, Any], now_ns: int) -> None:
        self.outbox.put(msgspec.json.encode(message), now_ns)
