"""`Outlet`: the socket between the loop and one server process; it never blocks."""

from __future__ import annotations

import contextlib
import socket

from armlab._descriptors import Descriptor

__all__ = ["Outlet", "pair"]

_BUFFER = 4 * 2**20  # bytes that wait for a server
_SNDBUFFORCE = 32  # Linux: beyond the system's limit, where permitted
_LARGEST = 2**17


def pair() -> tuple[socket.socket, socket.socket]:
    """Return two connected sockets that keep messages whole: ours, which never blocks, and the server's."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, getattr(socket, "SOCK_SEQPACKET", socket.SOCK_DGRAM))
    ours.setblocking(False)
    for option in (socket.SO_SNDBUF, _SNDBUFFORCE):
        with contextlib.suppress(OSError):
            ours.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
    return ours, theirs


class Outlet:
    """The way to one server process and back.

    Parameters
    ----------
    name : of the server.

    Attributes
    ----------
    rows, lost : rows that the server was sent, and that it did not take in time.
    where : what the server listens on; None until it says so.
    clients : rows sent to each of its clients and dropped for it; None until it says so.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.rows = self.lost = 0
        self.where: list[str] | None = None
        self.clients: dict[str, tuple[int, int]] | None = None
        self._socket: socket.socket | None = None
        self._descriptor = Descriptor(-1)

    def open(self) -> socket.socket:
        """Return a new socket for the server process; the old one, of a process that has ended, is closed."""
        self.close()
        ours, theirs = pair()
        self._socket, self._descriptor = ours, Descriptor(ours.fileno())
        return theirs

    def close(self) -> None:
        """Close our end: the server process ends then."""
        gone, self._socket, self.where = self._socket, None, None
        if gone is not None:
            gone.detach()
            self._descriptor.close()

    def row(self, data: bytes) -> None:
        """Send one row, or count it as lost. Never waits."""
        if self.send(data):
            self.rows += 1
        else:
            self.lost += 1

    def send(self, data: bytes) -> bool:
        """Send one message; False when it was dropped: no process, or one that does not read. Never waits."""
        try:
            return self._socket is not None and self._socket.send(data) > 0
        except OSError:  # full, or the process has gone: its supervisor sees to that
            return False

    def receive(self) -> bytes | None:
        """Return one message, None when none waits."""
        connection = self._socket
        try:
            return None if connection is None else connection.recv(_LARGEST) or None
        except OSError:
            return None
