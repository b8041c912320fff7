"""Sockets: UDP port of an arm, TCP ports of servers, and the socket pairs between the loop and the server processes."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import ipaddress
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

from armlab import kernels
from armlab._files import Descriptor, apart
from armlab.errors import LinkError

_LISTENING = "0A"  # state of a TCP socket in /proc/net/tcp


def process_using_port(port: int, kind: Literal["udp", "tcp"] = "udp") -> str:
    """Return the process that uses a port, such as "process 4711 (armlab sim ...)", or "" if it is unknown."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        inodes = _inodes(port, kind)
        for process in Path("/proc").iterdir():
            if process.name.isdigit() and _has_socket(process, inodes):
                return program(int(process.name))
    return ""


def program(process: int) -> str:
    """Return the number and command line of a process, such as "process 4711 (armlab sim ...)"."""
    with contextlib.suppress(OSError), Path(f"/proc/{process}/cmdline").open("rb") as file:
        command = " ".join(file.read(200).replace(b"\0", b" ").decode(errors="replace").split())
        return f"process {process} ({command})"
    return f"process {process}"


def _inodes(port: int, kind: str) -> set[str]:
    with Path(f"/proc/net/{kind}").open(encoding="ascii") as file:
        rows = [line.split() for line in file.readlines()[1:]]
    mine = [row for row in rows if int(row[1].rpartition(":")[2], 16) == port]
    return {f"socket:[{row[9]}]" for row in mine if kind == "udp" or row[3] == _LISTENING}


def _has_socket(process: Path, inodes: set[str]) -> bool:
    with contextlib.suppress(OSError):
        return any(str(entry.readlink()) in inodes for entry in (process / "fd").iterdir())
    return False


_SO_TIMESTAMPNS = getattr(socket, "SO_TIMESTAMPNS", 35)  # Linux; absent from Python's socket module
_FLUSHED = 2000  # datagrams, more than a receive buffer holds


class Arrival(NamedTuple):
    """One datagram: its bytes, (host, port) of the sender, and its arrival time on the local monotonic clock [ns]."""

    data: bytes
    source: tuple[str, int]
    ns: int


class Port:
    """Bound, non-blocking UDP port; socket errors are counted."""

    def __init__(self, host: str, port: int) -> None:
        self._errors = self._seen = 0
        self._is_closed = False
        self.on_lost: Callable[[], None] = lambda: None
        self._bind(socket.socket(socket.AF_INET, socket.SOCK_DGRAM), host, port)
        name: tuple[str, int] = self._socket.getsockname()
        self.host: str = name[0]
        self.port: int = name[1]

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
        return self._errors + self._datagrams.errors

    def close(self) -> None:
        self._is_closed = True
        if self._descriptor.is_open:
            self._datagrams.close()
        else:
            self._socket.detach()

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> Arrival | None:
        arrival = self._datagrams.receive()
        if arrival is None and self._datagrams.errors != self._seen and self._was_lost():
            arrival = self._datagrams.receive()
        return arrival

    def flush(self) -> None:
        """Discard waiting datagrams, because replies to old packets would contain outdated references."""
        for _ in range(_FLUSHED):
            if self.receive() is None:
                break

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one datagram; return whether the operating system accepted it."""
        return self._datagrams.send(data, to) or (self._was_lost() and self._datagrams.send(data, to))

    def _was_lost(self) -> bool:
        """After an error, rebind the socket if other code has closed it; return whether the socket was closed."""
        self._seen = self._datagrams.errors
        if self._is_closed or self._descriptor.is_open:
            return False
        self._errors, self._seen = self._errors + self._seen, 0
        self._socket.detach()  # its descriptor may already belong to another file
        number = apart(socket.socket(socket.AF_INET, socket.SOCK_DGRAM).detach())
        self._bind(socket.socket(fileno=number), self.host, self.port)
        self.on_lost()
        return True


def _why_not(host: str, port: int, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.EADDRINUSE:
        who = process_using_port(port)
        return (
            f"Expected UDP port {host}:{port} to be free, got a port in use{f' by {who}' if who else ''}. "
            "End that program or choose another port."
        )
    if code == errno.EACCES:
        return f"Expected permission to listen on {host}:{port}, got {error}. Choose a port above 1023."
    return (
        f"Expected a local address to listen on, got {host}:{port} ({error}). Use an address of this computer, or "
        "127.0.0.1 for a robot simulated on this computer."
    )


def listening_socket(host: str, port: int, name: str, backlog: int) -> socket.socket:
    """Return a non-blocking listening socket whose connections send small messages without delay."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else a message may wait up to 40 ms for an ACK
    try:
        listener.bind((host, port))
        listener.listen(backlog)
    except (OSError, OverflowError) as error:
        listener.close()
        is_taken = getattr(error, "errno", None) == errno.EADDRINUSE
        who = process_using_port(port, "tcp") if is_taken else ""
        why = f"a port in use{f' by {who}' if who else ''}" if is_taken else f"{error}"
        raise LinkError(
            f"Expected TCP port {host}:{port} for {name} to be free, "
            f"got {why}. Stop the program that uses this port or choose another port."
        ) from error
    listener.setblocking(False)
    return listener


_BUFFER = 4 * 2**20  # bytes: maximum queued for a server
_SNDBUFFORCE = 32  # Linux: may exceed the system limit
_LARGEST = 2**17  # bytes: maximum size of a message from a server


def pair() -> tuple[socket.socket, socket.socket]:
    """Return two connected sockets that preserve message boundaries: ours, which is non-blocking, and the server's."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, getattr(socket, "SOCK_SEQPACKET", socket.SOCK_DGRAM))
    ours.setblocking(False)
    for option in (socket.SO_SNDBUF, _SNDBUFFORCE):
        with contextlib.suppress(OSError):
            ours.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
    return ours, theirs


class Outlet:
    """Connection to one server process."""

    rows: int
    lost: int

    def __init__(self, name: str) -> None:
        self.name = name
        self.rows = self.lost = 0
        self.where: list[str] | None = None
        self.clients: dict[str, tuple[int, int]] | None = None
        self._socket: socket.socket | None = None
        self._descriptor = Descriptor(-1)

    def open(self) -> socket.socket:
        """Return a new socket for the server process; close the old one."""
        self.close()
        ours, theirs = pair()
        self._socket, self._descriptor = ours, Descriptor(ours.fileno())
        return theirs

    def close(self) -> None:
        """Close our end; the server process then ends."""
        gone, self._socket, self.where = self._socket, None, None
        if gone is not None:
            gone.detach()
            self._descriptor.close()

    def row(self, data: bytes) -> None:
        """Send one row without blocking; count it as lost if it is dropped."""
        if self.send(data):
            self.rows += 1
        else:
            self.lost += 1

    def send(self, data: bytes) -> bool:
        """Send one message without blocking; return False if it is dropped (the process has ended or is not
        reading)."""
        try:
            return self._socket is not None and self._socket.send(data) > 0
        except OSError:  # full, or the process has ended and its supervisor restarts it
            return False

    def receive(self) -> bytes | None:
        connection = self._socket
        try:
            return None if connection is None else connection.recv(_LARGEST) or None
        except OSError:
            return None


def is_here(place: str) -> bool:
    """Return whether "HOST:PORT" is on this computer; host names other than localhost are not resolved."""
    host = place.rpartition(":")[0].strip("[]")
    return host == "localhost" or is_loopback(host)


def is_loopback(host: str) -> bool:
    """Return whether a host is a loopback address; False for host names."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


_SIOCGIFADDR = 0x8915


def local_addresses() -> dict[str, str]:
    """Return the IPv4 address of each network interface that has one."""
    found: dict[str, str] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):  # an interface without an address
                reply = fcntl.ioctl(control.fileno(), _SIOCGIFADDR, name.encode()[:15].ljust(256, b"\0"))
                found[name] = socket.inet_ntoa(reply[20:24])
    return found
