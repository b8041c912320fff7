"""`Port`: the bound UDP socket, with the kernel's stamp of each arrival, and who holds a port that is taken."""

from __future__ import annotations

import contextlib
import errno
import socket
from typing import NamedTuple

from armlab import kernels
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
    """A bound UDP port that never blocks and never raises after construction; socket errors are counted.

    Parameters
    ----------
    host, port : where to listen; port 0 lets the system choose. to_itself : send there, whatever the address.

    Attributes
    ----------
    host, port : the address bound.

    Raises
    ------
    LinkError : the address cannot be bound; names who holds the port where that can be told.
    """

    def __init__(self, host: str, port: int, to_itself: bool = False) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise LinkError(_why_not(host, port, error)) from error
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self.host, self.port = self._socket.getsockname()
        self._always_to = (self.host, self.port) if to_itself else None
        self._datagrams = kernels.Datagrams(self._socket, Arrival)

    @property
    def errors(self) -> int:
        """Socket errors so far."""
        return self._datagrams.errors

    def close(self) -> None:
        """Close the socket."""
        self._datagrams.close()

    def fileno(self) -> int:
        """Return the number by which the system knows the socket: one can wait on it."""
        return self._socket.fileno()

    def receive(self) -> Arrival | None:
        """Return the next datagram, or None when there is none."""
        return self._datagrams.receive()

    def flush(self) -> None:
        """Throw away what arrived while nobody listened: replies to old packets would be references to old places."""
        for _ in range(_FLUSHED):
            if self.receive() is None:
                break

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one datagram. Return whether the system took it."""
        return self._datagrams.send(data, self._always_to or to)


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
