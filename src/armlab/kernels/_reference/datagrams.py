"""Datagrams in and out of a socket (specification; the compiled twin is native/datagrams.cpp)."""

from __future__ import annotations

import struct
import time
from typing import Any

__all__ = ["Datagrams"]

_LARGEST = 65535
_TIMESPEC = struct.Struct("qq")
_STALE_STAMP = 10**10  # ns: a stamp older than this is a clock that was set, not an age


class Datagrams:
    """Receives and sends on a bound UDP socket of IPv4, never waits and never raises for the socket.

    Parameters
    ----------
    socket : does not block; `close` closes it. With SO_TIMESTAMPNS the kernel's stamps are used.
    kind : named tuple that is made of each datagram: its bytes, (host, port) of the sender, and its arrival on the
        monotonic clock [ns].

    Attributes
    ----------
    errors : socket errors so far.
    """

    def __init__(self, socket: Any, kind: Any) -> None:
        self._socket, self._kind = socket, kind
        self.errors = 0

    def receive(self) -> Any | None:
        """Return the next datagram, None when there is none or the socket reports an error."""
        try:
            data, extra, _, source = self._socket.recvmsg(_LARGEST, 64)
        except BlockingIOError:
            return None
        except OSError:
            self.errors += 1
            return None
        now = time.monotonic_ns()
        if extra and len(extra[0][2]) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(extra[0][2])
            age = time.time_ns() - (seconds * 10**9 + nanoseconds)
            if 0 <= age < _STALE_STAMP:
                now -= age
        return self._kind(data, source, now)

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one datagram. Return whether the system took it.

        Parameters
        ----------
        data : its bytes. to : numeric address and port.
        """
        try:
            self._socket.sendto(data, to)
        except OSError:
            self.errors += 1
            return False
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
