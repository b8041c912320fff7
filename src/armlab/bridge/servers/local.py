"""Local feed over a Unix socket of the user: client `LocalFeed`, and server process `LocalServer`."""

from __future__ import annotations

import contextlib
import os
import select
import selectors
import socket
import stat
import struct
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from armlab.bridge.net.sockets import program
from armlab.bridge.servers.messages import (
    Counted,
    Leave,
    Listening,
    Report,
    Request,
    Subscribe,
    read_request,
    text_message,
)
from armlab.bridge.servers.row import MAGIC, Pace, Row, RowSchema, read_row
from armlab.bridge.servers.server_end import LoopEnd
from armlab.bridge.servers.status import Status
from armlab.errors import CommandRefused, ConfigError, LinkError

_LARGEST = 2**17


def socket_path(cell: str) -> Path:
    """Return the socket path of a cell's local feed in a private folder of the user."""
    given = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(given) / "armlab" if given else Path(tempfile.gettempdir()) / f"armlab-{os.getuid()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o077:
        raise LinkError(f"Expected {folder} to be private (mode 0700). Remove the folder, or set XDG_RUNTIME_DIR.")
    return folder / f"{cell}.sock"


def cells() -> list[str]:
    """Return the names of the user's running cells."""
    found = []
    for path in sorted(socket_path("x").parent.glob("*.sock")):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as one:
            one.connect(str(path))
            found.append(path.stem)
    return found


class LocalFeed(contextlib.AbstractContextManager["LocalFeed"]):
    """Client of a cell's local feed ("": the only running cell), which waits `patience` seconds for a message."""

    def __init__(self, cell: str = "", patience: float = 5.0) -> None:
        if not cell:
            running = cells()
            if len(running) > 1:
                raise ConfigError(
                    f"Expected the name of a running cell ({', '.join(running)}), got none. Specify --cell NAME."
                )
            cell = running[0] if running else ""
        if not cell:
            raise LinkError(
                "Expected a running bridge of this user, found none. Start one with armlab bridge --config CELL."
            )
        self.cell = cell
        self._schema: RowSchema | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(patience)
        try:
            self._socket.connect(str(socket_path(cell)))
        except OSError as error:
            self._socket.close()
            raise LinkError(
                f"Expected a running bridge of the cell {cell!r}, but it cannot be reached ({error}). "
                "Start armlab bridge --config CELL."
            ) from error

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()

    def wait(self, seconds: float) -> bool:
        """Return whether a message arrives within this time [s]."""
        return bool(select.select([self._socket], [], [], max(seconds, 0.0))[0])

    def ask(self, request: Request) -> None:
        """Send a request to the bridge."""
        try:
            self._socket.send(msgspec.json.encode(request))
        except OSError as error:
            raise LinkError(
                f"Expected the bridge to accept a request, got {error}. The bridge may have ended."
            ) from error

    def receive(self) -> Row | dict[str, Any]:
        """Return the next message: a row, or the fields of any other message, including its "kind"."""
        while True:
            try:
                data = self._socket.recv(_LARGEST)
            except TimeoutError:
                seconds = self._socket.gettimeout()
                raise LinkError(
                    f"Expected a message from the bridge within {seconds:g} "
                    "s, got none. Check that the bridge is running."
                ) from None
            except OSError:
                data = b""
            if not data:
                raise LinkError(f"Expected the bridge of {self.cell} to keep running, but it closed the feed.")
            if data[:4] != MAGIC:
                message = msgspec.json.decode(data)
                if message["kind"] == "about":
                    self._schema = RowSchema.read(message["schema"].encode())
                return message
            if self._schema is not None:
                return read_row(self._schema, data)


_CLIENTS = 8
_STATUS = 0.5  # s between status reports
_EVENTS = 20  # number of recent events sent to a new client
_KEPT = 100  # number of disconnected clients whose counts are kept
_RETRY = 0.005  # s between attempts to send queued requests
_FRESH = struct.Struct("<q")
_TAKEN = 16  # maximum number of messages read from a client per turn


class _Client:
    """Connection of one client; `pace` limits its row rate (None: no rows)."""

    def __init__(self, connection: socket.socket, name: str) -> None:
        self.connection, self.name = connection, name
        self.pace: Pace | None = None
        self.rows = self.dropped = 0

    def send(self, data: bytes) -> bool:
        try:
            return self.connection.send(data) > 0
        except OSError:  # full or closed: the next read shows which
            return False

    def row(self, data: bytes) -> None:
        if self.send(data):
            self.rows += 1
        else:
            self.dropped += 1


class LocalServer:
    """Server that sends rows and events to at most 8 of the user's clients, and forwards their requests to the loop."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._path = Path(options["path"])
        self._listener = _listen(self._path)
        self._clients: dict[socket.socket, _Client] = {}
        self._events: deque[bytes] = deque(maxlen=_EVENTS)
        self._gone: dict[str, tuple[int, int]] = {}  # rows sent and dropped, by disconnected client
        self._count = 0
        self._reported = 0.0
        try:
            self._loop = LoopEnd(feed, self._counts)
        except LinkError:
            self._close()
            raise
        parameters = {"kind": "parameters", "parameters": list(self._loop.parameters.values())}
        self._first = {one["kind"]: msgspec.json.encode(one) for one in (self._loop.about, parameters)}
        schema = self._loop.schema
        self._status = Status(schema)
        self._fresh = [schema.fields[f"{robot}.fresh"].offset for robot in schema.robots]
        self._selector = selectors.DefaultSelector()

    def run(self) -> None:
        self._listener.setblocking(False)
        for one in (self._loop, self._listener):
            self._selector.register(one, selectors.EVENT_READ)
        self._loop.ask(Listening(where=[f"{self._path} (local)"]))
        try:
            while self._serve():
                pass
        finally:
            self._close()
            self._selector.close()

    def _close(self) -> None:
        for one in (*self._clients, self._listener):
            one.close()
        self._path.unlink(missing_ok=True)

    def _serve(self) -> bool:
        """Handle all pending messages; return False once the loop has ended."""
        for key, _ in self._selector.select(_RETRY if self._loop.is_behind else _STATUS):
            if key.fileobj is self._listener:
                self._accept()
            elif key.fileobj in self._clients:
                self._take(self._clients[key.fileobj])  # type: ignore[index]
        while messages := self._loop.receive():
            for message in messages:
                if isinstance(message, bytes):
                    self._row(message)
                else:
                    self._text(message)
        return messages is not None

    def _counts(self) -> dict[str, tuple[int, int]]:
        here = {client.name: (client.rows, client.dropped) for client in self._clients.values()}
        return {**self._gone, **here}

    def _row(self, data: bytes) -> None:
        now = time.monotonic()
        self._status.add(data)
        if now - self._reported > _STATUS:
            self._reported = now
            self._send_to_all(text_message("status", **self._status.summary()))
        arms = [offset for offset in self._fresh if _FRESH.unpack_from(data, offset)[0]]
        for client in self._clients.values():
            if client.pace is not None and client.pace.takes(arms, now):
                client.row(data)

    def _text(self, message: Mapping[str, Any]) -> None:
        kind, data = message["kind"], msgspec.json.encode(message)
        if kind == "answer":
            for client in self._clients.values():
                if client.name == message["client"]:
                    client.send(data)
        elif kind == "event":
            self._events.append(data)
            self._send_to_all(data)
        elif kind != "count":
            self._first[kind] = data
            self._send_to_all(data)

    def _send_to_all(self, data: bytes) -> None:
        for client in self._clients.values():
            client.send(data)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # already disconnected, or too many open files; keep serving the others
            return
        connection.setblocking(False)
        if len(self._clients) >= _CLIENTS:
            text = f"Expected at most {_CLIENTS} clients of the local feed. Close one."
            with contextlib.suppress(OSError):
                connection.send(text_message("answer", client="", text=text))
            connection.close()
            return
        self._count += 1
        client = self._clients[connection] = _Client(connection, str(self._count))
        self._selector.register(connection, selectors.EVENT_READ)
        for data in (*self._first.values(), *self._events):
            client.send(data)

    def _take(self, client: _Client) -> None:
        for _ in range(_TAKEN):
            try:
                data = client.connection.recv(_LARGEST)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._leave(client)
                return
            try:
                request = read_request(data)
                if isinstance(request, Subscribe):
                    rate = request.rate
                    client.pace = Pace(0.0 if rate is None else 1.0 / rate) if rate is None or rate > 0.0 else None
                elif not isinstance(request, Listening | Counted | Report):
                    self._loop.ask(msgspec.structs.replace(request, client=client.name))
            except (LinkError, CommandRefused) as error:
                client.send(text_message("answer", client=client.name, text=str(error)))
                self._loop.ask(Report(client.name, str(error)))

    def _leave(self, client: _Client) -> None:
        self._selector.unregister(client.connection)
        del self._clients[client.connection]
        client.connection.close()
        self._gone[client.name] = (client.rows, client.dropped)
        if len(self._gone) > _KEPT:
            del self._gone[next(iter(self._gone))]
        self._loop.ask(Leave(client.name))


def _listen(path: Path) -> socket.socket:
    """Return a listening socket that only the current user can open."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            path.unlink(missing_ok=True)  # left by an earlier process
        else:
            process, _, _ = struct.unpack("3i", probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            raise LinkError(
                f"Expected no other bridge at {path}, got {program(process)}. Choose another name for the cell."
            )
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    before = os.umask(0o177)
    try:
        listener.bind(str(path))
    finally:
        os.umask(before)
    listener.listen(_CLIENTS)
    return listener
