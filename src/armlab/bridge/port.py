"""`Port`: the bound UDP socket, with the kernel's stamp of each arrival, and who holds a port that is taken.

A socket whose descriptor other code in this process closed (`os.closerange`) is bound again: a moving arm has to be
brought to rest.
"""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Callable
from typing import NamedTuple

from armlab import kernels
from armlab._descriptors import Descriptor, apart
from armlab.bridge.holder import holder
from armlab.errors import LinkError

__all__ = ["Arrival", "Port"]

_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)  # Linux; absent from Python's socket module
_FLUSHED = 2000  # datagrams: more than a receive buffer holds


class Arrival(NamedTuple):
    """One datagram: its bytes, (host, port) of the sender, and its arrival on our monotonic clock [ns]."""

    data: bytes
    source: tuple[str, int]
    ns: int


class Port:
    """A bound UDP port that never blocks; socket errors are counted.

    Parameters
    ----------
    host, port : where to listen; port 0 lets the system choose. to_itself : send there, whatever the address.

    Attributes
    ----------
    host, port : the address bound. on_lost : called after the socket was bound again.

    Raises
    ------
    LinkError : the address cannot be bound, or not again; names who holds the port where that can be determined.
    """

    def __init__(self, host: str, port: int, to_itself: bool = False) -> None:
        self._errors = self._seen = 0
        self._is_closed = False
        self.on_lost: Callable[[], None] = lambda: None
        self._bind(socket.socket(socket.AF_INET, socket.SOCK_DGRAM), host, port)
        self.host, self.port = self._socket.getsockname()
        self._always_to = (self.host, self.port) if to_itself else None

    def _bind(self, opened: socket.socket, host: str, port: int) -> None:
        self._socket = opened
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise LinkError(_why_not(host, port, error)) from error
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._descriptor = Descriptor(self._socket.fileno())
        self._datagrams = kernels.Datagrams(self._socket, Arrival)

    @property
    def errors(self) -> int:
        """Socket errors so far."""
        return self._errors + self._datagrams.errors

    def close(self) -> None:
        """Close the socket."""
        self._is_closed = True
        if self._descriptor.is_open:
            self._datagrams.close()
        else:
            self._socket.detach()

    def fileno(self) -> int:
        """Return the number by which the system knows the socket: one can wait on it."""
        return self._socket.fileno()

    def receive(self) -> Arrival | None:
        """Return the next datagram, or None when there is none."""
        arrival = self._datagrams.receive()
        if arrival is None and self._datagrams.errors != self._seen and self._was_lost():
            arrival = self._datagrams.receive()
        return arrival

    def flush(self) -> None:
        """Throw away what arrived while nobody listened: replies to old packets would be references to old places."""
        for _ in range(_FLUSHED):
            if self.receive() is None:
                break

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one datagram. Return whether the system took it."""
        to = self._always_to or to
        return self._datagrams.send(data, to) or (self._was_lost() and self._datagrams.send(data, to))

    def _was_lost(self) -> bool:
        """After an error: return whether other code had closed the socket, which is bound again then."""
        self._seen = self._datagrams.errors
        if self._is_closed or self._descriptor.is_open:
            return False
        self._errors, self._seen = self._errors + self._seen, 0
        self._socket.detach()  # its number may belong to another file by now
        number = apart(socket.socket(socket.AF_INET, socket.SOCK_DGRAM).detach())
        self._bind(socket.socket(fileno=number), self.host, self.port)
        self.on_lost()
        return True


def _why_not(host: str, port: int, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.EADDRINUSE:
        who = holder(port)
        return (
            f"Expected UDP port {host}:{port} to be free, but it is in use{f' by {who}' if who else ''}. "
            "End that program or choose another port."
        )
    if code == errno.EACCES:
        return f"Expected to be allowed to listen on {host}:{port} ({error}). Choose a port above 1023."
    return (
        f"Expected a local address to listen on, got {host}:{port} ({error}). Use an address of this computer, "
        "127.0.0.1 for a robot simulated on it."
    )
