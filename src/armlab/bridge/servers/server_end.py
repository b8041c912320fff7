"""`LoopEnd`: a server process's connection to the loop; rows and messages in, client requests out."""

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

from armlab.bridge.servers.messages import (
    CommandRequest,
    Counted,
    Renew,
    Report,
    Request,
    SetRequest,
    Stop,
    TrajectoryRequest,
)
from armlab.bridge.servers.row import MAGIC, RowSchema
from armlab.errors import CommandRefused, LinkError
from armlab.robots import Robot, from_toml

_LARGEST = 2**17
_URGENT = 256  # maximum number of requests queued while the socket is full
_RETRY = 0.005  # s between attempts to send them
_AT_ONCE = 64  # maximum number of messages per call of `receive`
_LONGEST = 1.0  # s: longest single wait

Clients = Mapping[str, tuple[int, int]]


class LoopEnd:
    """Server's end of the socket to `hub.Hub`; only `ask` may be called from several threads."""

    lost: int = 0
    schema: RowSchema

    def __init__(self, feed: socket.socket, clients: Callable[[], Clients] = dict) -> None:
        self._feed = feed
        self._clients: Callable[[], Clients] = dict  # until the server exists
        self._urgent: deque[bytes] = deque()
        self._lock = threading.Lock()
        self.parameters: dict[str, dict[str, Any]] = {}
        self.about: dict[str, Any] = {}
        self._buffer = memoryview(bytearray(_LARGEST))  # reused, because the system would map a new buffer for each row
        received: set[str] = set()
        while not {"about", "parameters"} <= received:
            messages = self.receive(None)
            if messages is None:
                raise LinkError(
                    "Expected the loop to send its row schema, but it closed the feed. Start the bridge again."
                )
            received |= {message["kind"] for message in messages if isinstance(message, dict)}
        self._clients = clients

    def fileno(self) -> int:
        return self._feed.fileno()

    @property
    def is_behind(self) -> bool:
        """Whether requests to the loop are waiting."""
        return bool(self._urgent)

    def robots(self) -> dict[str, Robot]:
        return {name: from_toml(text, f"the bridge of {name}") for name, text in self.about["robots"].items()}

    def receive(self, patience: float | None = 0.0) -> list[bytes | dict[str, Any]] | None:
        """Return the messages (dict with "kind") up to and including a row (bytes), or None once the loop has ended.

        Rows are returned one at a time, because checking for another row takes as long as handling one.
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
        """Send a request to the loop; return False if the socket is full.

        If the socket is full, commands, settings, renewals and reports are dropped, because newer ones follow;
        `receive` sends stops and releases later. Trajectory parts leave room in the socket for stops and releases; the
        loop detects missing parts.
        """
        data = encoded(request)
        with self._lock:
            if not self._urgent and self._sent(data):
                return True
            room = _URGENT // 2 if isinstance(request, TrajectoryRequest) else _URGENT
            if isinstance(request, Stop):
                room *= 2  # no later request replaces a lost stop
            if not isinstance(request, CommandRequest | SetRequest | Report | Renew) and len(self._urgent) < room:
                self._urgent.append(data)
            else:
                self.lost += 1
        return False

    def _wait(self, patience: float | None) -> None:
        """Wait for a message; meanwhile, send queued requests."""
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
    """Encode a request to the loop as bytes."""
    try:
        return msgspec.json.encode(request)
    except (ValueError, TypeError, OverflowError, RecursionError, msgspec.MsgspecError) as error:
        raise CommandRefused(f"Expected a request that can be encoded as UTF-8 JSON, got {error}.") from None
