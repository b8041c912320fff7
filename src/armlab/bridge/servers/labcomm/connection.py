"""`Peer`: one connection of a server or client: its stream both ways, its queue and its patience. Never blocks."""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections import deque

from armlab.wire.labcomm import Decoder, Encoder
from armlab.wire.labcomm.types import Event

QUEUE = 64
"""Packets that wait for a slow peer; then the oldest data packets go."""

_AT_ONCE = 65_536  # bytes read
_PATIENCE = 5.0  # s for a packet to be complete, and for a peer to take something
_KERNEL = 65_536  # bytes that the system may hold back: rows of a slow peer shall not be old


class Peer:
    """A connection.

    connection : connected socket. address : of the other side, for messages. encoder : of what is sent, None until the
        dialect is known.
    began : when it connected, monotonic [s]. refused : samples of it that were not taken. told : when that was told.
    """

    def __init__(self, connection: socket.socket, address: str, encoder: Encoder | None) -> None:
        self.socket, self.address, self.encoder = connection, address, encoder
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.decoder, self.sent, self.dropped, self.refused = Decoder(), 0, 0, 0
        self.began, self.told = time.monotonic(), -math.inf
        self._queue: deque[tuple[bytes, bool]] = deque()  # packet, whether it may be dropped
        self._rest = b""  # of a packet that was sent in part
        self._stuck: float | None = None  # since when nothing could be sent
        self._packet = (0, self.began)  # position of an incomplete packet, since when

    @property
    def is_waiting(self) -> bool:
        return bool(self._rest or self._queue)

    @property
    def is_stuck(self) -> bool:
        """Whether the system took nothing the last time."""
        return self._stuck is not None

    def push(self, packet: bytes, may_drop: bool = True) -> None:
        """Queue one packet. When the queue is full the oldest packet that may be dropped goes."""
        queue = self._queue
        if len(queue) >= QUEUE:
            oldest = next((index for index, (_, droppable) in enumerate(queue) if droppable), None)
            if oldest is not None:
                del queue[oldest]
                self.dropped += 1
            elif may_drop:
                self.dropped += 1
                return
        queue.append((packet, may_drop))

    def clear(self) -> None:
        kept = [entry for entry in self._queue if not entry[1]]
        self.dropped += len(self._queue) - len(kept)
        self._queue = deque(kept)

    def flush(self) -> bool:
        """Send what the system takes, one write per packet. Return False when the connection is gone."""
        while self._rest or self._queue:
            data, is_row = (self._rest, False) if self._rest else self._queue.popleft()
            self.sent += is_row
            try:
                sent = self.socket.send(data)
            except (BlockingIOError, InterruptedError):
                self._rest = data
                self._stuck = self._stuck or time.monotonic()
                return True
            except OSError:
                return False
            self._rest, self._stuck = data[sent:], None
        return True

    def read(self, most: int = _AT_ONCE) -> list[Event] | None:
        """Return the events of one read, None when the other side has closed."""
        try:
            data = self.socket.recv(most)
        except (BlockingIOError, InterruptedError):
            return []
        except OSError:
            return None
        if not data:
            self.decoder.close()
            return None
        return self.decoder.feed(data)

    def overdue(self, now: float) -> str:
        """Return why the connection must be closed, "" when it need not. now : monotonic [s]."""
        if self.decoder.pending:
            position, since = self._packet
            if position != self.decoder.offset:
                self._packet = (self.decoder.offset, now)
            elif now - since > _PATIENCE:
                return f"a packet was not complete after {_PATIENCE:g} s"
        else:
            self._packet = (self.decoder.offset, now)
        if self._stuck is not None and now - self._stuck > _PATIENCE:
            return f"it took nothing for {_PATIENCE:g} s"
        return ""

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self.socket.close()
