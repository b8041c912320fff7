"""`Port`: the bound UDP socket, with the kernel's stamp of each arrival, and who holds a port that is taken."""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import time
from pathlib import Path
from typing import NamedTuple

from armlab.errors import LinkError

__all__ = ["Arrival", "Port", "holder"]

_LARGEST = 65535
_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)  # Linux; absent from Python's socket module
_TIMESPEC = struct.Struct("qq")
_FLUSHED = 2000  # datagrams: more than a receive buffer holds
_STALE_STAMP = 10**10  # ns: a stamp older than this is a clock that was set, not an age


class Arrival(NamedTuple):
    """One datagram: its bytes, (host, port) of the sender, and its arrival on our monotonic clock [ns]."""

    data: bytes
    source: tuple[str, int]
    ns: int


class Port:
    """A bound UDP port that never blocks and never raises after construction; socket errors are counted.

    Parameters
    ----------
    host, port : where to listen; port 0 lets the system choose.

    Attributes
    ----------
    host, port : the address bound. errors : socket errors so far, for example a peer that went away.

    Raises
    ------
    LinkError : the address cannot be bound; names who holds the port where that can be told.
    """

    def __init__(self, host: str, port: int) -> None:
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
        self.errors = 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def fileno(self) -> int:
        """Return the number by which the system knows the socket: one can wait on it."""
        return self._socket.fileno()

    def receive(self) -> Arrival | None:
        """Return the next datagram, or None when there is none."""
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
                return Arrival(data, source, now - age)
        return Arrival(data, source, now)

    def flush(self) -> None:
        """Throw away what arrived while nobody listened: replies to old packets would be references to old places."""
        for _ in range(_FLUSHED):
            if self.receive() is None:
                break

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one datagram. Return whether the system took it."""
        try:
            self._socket.sendto(data, to)
        except OSError:
            self.errors += 1
            return False
        return True


def holder(port: int) -> str:
    """Return who holds a UDP port, "process 4711 (armlab sim ...)", or "" when that cannot be told.

    Reads what Linux shows of the processes; those of other users stay hidden.

    Parameters
    ----------
    port : number of the port.
    """
    with contextlib.suppress(OSError, ValueError, IndexError):
        inodes = _inodes(port)
        for process in Path("/proc").iterdir():
            if process.name.isdigit() and _has_socket(process, inodes):
                with (process / "cmdline").open("rb") as file:
                    command = file.read(200).replace(b"\0", b" ").decode(errors="replace")
                return f"process {process.name} ({' '.join(command.split())})"
    return ""


def _inodes(port: int) -> set[str]:
    with Path("/proc/net/udp").open(encoding="ascii") as file:
        rows = [line.split() for line in file.readlines()[1:]]
    return {f"socket:[{row[9]}]" for row in rows if int(row[1].rpartition(":")[2], 16) == port}


def _has_socket(process: Path, inodes: set[str]) -> bool:
    with contextlib.suppress(OSError):
        return any(str(entry.readlink()) in inodes for entry in (process / "fd").iterdir())
    return False


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
