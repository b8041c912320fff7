"""`LoopEnd`: the loop as a server process sees it: rows and texts come in, requests of clients go out."""

from __future__ import annotations

import contextlib
import math
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from armlab.bridge.servers.messages import CommandRequest, Counted, Report, Request, SetRequest
from armlab.bridge.servers.row import MAGIC, RowSchema
from armlab.errors import CommandRefused, LinkError
from armlab.robots import Robot, from_toml

_LARGEST = 2**17
_URGENT = 256  # requests that wait when the way to the loop is full
_RETRY = 0.005  # s until they are tried again
_AT_ONCE = 64  # messages that one look takes
_LONGEST = 1.0  # s of one look

Clients = Mapping[str, tuple[int, int]]


class LoopEnd:
    """A server process's end of its socket to the loop (the other is `hub.Hub`).

    `ask` may be called from any thread, everything else from one.
    """

    def __init__(self, feed: socket.socket, clients: Callable[[], Clients] = dict) -> None:
        self._feed = feed
        self._clients: Callable[[], Clients] = dict  # the server is not there yet
        self._urgent: deque[bytes] = deque(maxlen=_URGENT)
        self._lock = threading.Lock()
        self.parameters: dict[str, dict[str, Any]] = {}
        self.about: dict[str, Any] = {}
        self.lost = 0
        self._buffer = memoryview(bytearray(_LARGEST))  # not a new one for each row: the system would map it each time
        said: set[str] = set()
        while not {"about", "parameters"} <= said:
            messages = self.receive(None)
            if messages is None:
                raise LinkError("Expected the loop to say what its rows hold, but it closed the feed. Start it again.")
            said |= {message["kind"] for message in messages if isinstance(message, dict)}
        self._clients = clients

    def fileno(self) -> int:
        return self._feed.fileno()

    @property
    def is_behind(self) -> bool:
        """Whether requests wait until the loop has room for them."""
        return bool(self._urgent)

    def robots(self) -> dict[str, Robot]:
        return {name: from_toml(text, f"the bridge of {name}") for name, text in self.about["robots"].items()}

    def receive(self, patience: float | None = 0.0) -> list[bytes | dict[str, Any]] | None:
        """Return what has come, up to the first row: rows as bytes, texts as they say, by their "kind".

        None when the loop has gone. Rows come one by one: to look whether there is a second one costs what a row costs.
        """
        self._wait(patience)
        found: list[bytes | dict[str, Any]] = []
        while len(found) < _AT_ONCE:
            try:
                size = self._feed.recv_into(self._buffer, 0, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError:
                size = 0
            if not size:
                return found or None
            data = self._buffer[:size].tobytes()
            if data.startswith(MAGIC):
                found.append(data)
                break
            found.append(self._text(data))
        return found

    def ask(self, request: Request) -> bool:
        """Send a request to the loop; False when there is no room.

        A command, a setting or a report is lost then, as newer ones follow; a stop or a release waits, and goes out by
        `receive`.
        """
        data = encoded(request)
        with self._lock:
            if not self._urgent and self._sent(data):
                return True
            if isinstance(request, CommandRequest | SetRequest | Report):
                self.lost += 1
            else:
                self._urgent.append(data)
        return False

    def _wait(self, patience: float | None) -> None:
        """Wait for a message, and send meanwhile what found no room."""
        until = math.inf if patience is None else time.monotonic() + patience
        while True:
            self._retry()
            left = until - time.monotonic()
            if left <= 0.0 or patience == 0.0:
                return
            if select.select([self._feed], [], [], min(left, _RETRY if self._urgent else _LONGEST))[0]:
                return

    def _retry(self) -> None:
        if self._urgent:
            with self._lock:
                while self._urgent and self._sent(self._urgent[0]):
                    self._urgent.popleft()

    def _sent(self, data: bytes) -> bool:
        with contextlib.suppress(OSError):
            return self._feed.send(data, socket.MSG_DONTWAIT) > 0
        return False

    def _text(self, data: bytes) -> dict[str, Any]:
        message = msgspec.json.decode(data)
        kind = message["kind"]
        if kind == "about":
            self.about, self.schema = message, RowSchema.read(message["schema"].encode())
        elif kind == "parameters":
            self.parameters = {one["name"]: one for one in message["parameters"]}
        elif kind == "count":
            self.ask(Counted(clients=dict(self._clients())))
        return message


def encoded(request: Request) -> bytes:
    """Return a request as it is sent to the loop."""
    try:
        return msgspec.json.encode(request)
    except (ValueError, TypeError, OverflowError, RecursionError, msgspec.MsgspecError) as error:
        raise CommandRefused(f"Expected what JSON in UTF-8 can say and armlab can read, but {error}.") from None
