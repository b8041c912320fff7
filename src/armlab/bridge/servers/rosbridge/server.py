"""`RosbridgeServer`: WebSocket server process between the loop and the `Engine`."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import os
import re
import socket
import ssl
import stat
import time
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armlab.bridge.net.sockets import listening_socket
from armlab.bridge.servers.messages import Listening
from armlab.bridge.servers.rosbridge.engine import ClientSession, Engine
from armlab.bridge.servers.rosbridge.protocol import LARGEST
from armlab.bridge.servers.server_end import LoopEnd
from armlab.errors import ConfigError, MissingExtra

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response


_SHORTEST = 16  # minimum length of a token in characters
_LOCAL_PAGES = re.compile(r"https?://(localhost|127\.0\.0\.1)(:\d{1,5})?")


@dataclass(frozen=True, repr=False)
class Access:
    """Access control: token required for commands, TLS context, and allowed origins of web pages."""

    token: bytes | None
    context: ssl.SSLContext | None
    origins: tuple[Any, ...]

    def judge(self, authorization: str | None) -> bool | None:
        """Return whether a client with this header may send commands, or None to refuse the connection."""
        if self.token is None:
            return True
        if authorization is None:
            return False
        kind, _, shown = authorization.partition(" ")
        is_right = hmac.compare_digest(shown.strip().encode(errors="replace"), self.token)  # in constant time
        return True if is_right and kind.lower() == "bearer" else None


def read_access(options: Mapping[str, Any], environment: Mapping[str, str] | None = None) -> Access:
    """Return the access control defined by the server's options."""
    token = _token(options, os.environ if environment is None else environment)
    context = _context(options.get("certificate"), options.get("key"))
    return Access(token, context, (None, _LOCAL_PAGES, *options.get("origins", ())))


def _token(options: Mapping[str, Any], environment: Mapping[str, str]) -> bytes | None:
    file, variable = options.get("token_file"), options.get("token_variable")
    if file and variable:
        raise ConfigError("Expected token_file or token_variable for rosbridge, got both. Remove one.")
    if variable:
        where, text = f"the variable {variable}", environment.get(variable, "")
    elif file:
        where, text = str(file), _secret(Path(file))
    else:
        return None
    token = text.strip()
    if len(token) < _SHORTEST or not token.isascii() or len(token.split()) > 1:
        raise ConfigError(
            f"Expected a token of at least {_SHORTEST} ASCII characters without spaces in {where}, got {len(token)} "
            "characters. Create one with python -c 'import secrets; print(secrets.token_urlsafe())'."
        )
    return token.encode()


def _secret(file: Path) -> str:
    try:
        with file.open(encoding="utf-8", errors="replace") as opened:
            mode = stat.S_IMODE(os.fstat(opened.fileno()).st_mode)
            if mode & 0o077:
                raise ConfigError(
                    f"Expected {file} to be readable only by its owner, got mode {mode:04o}. Run chmod 600 {file}."
                )
            return opened.read(4096)
    except OSError as error:
        raise ConfigError(f"Expected the rosbridge token in {file}, got {error.strerror}.") from None


def _context(certificate: str | None, key: str | None) -> ssl.SSLContext | None:
    if not certificate and not key:
        return None
    if not certificate or not key:
        raise ConfigError("Expected a certificate and a key for rosbridge, got only one of them. Set both.")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key, password="")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        raise ConfigError(
            f"Expected a certificate in {certificate} and its key, without a password, in {key}, got {error}."
        ) from None
    return context


_CLIENTS = 16
_SEND_BUFFER = 65536  # bytes; with the default size, a slow client would receive data that is 30 s old
_KEPT = 100  # number of disconnected clients whose counts are kept
_TICK = 0.1  # s between calls of `Engine.tick`
_WRITE_LIMIT = 16384  # bytes buffered in the process before a send blocks
_CLOSING = 0.5  # s for a client to close its connection
_PING, _PONG = 5.0, 10.0  # s between pings, and s without a pong after which a client counts as lost


class RosbridgeServer:
    """rosbridge server process, which runs until the loop closes the socket."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._websockets = _websockets()
        self._open = self._websockets.State.OPEN
        self._access = read_access(options)
        self._loop = LoopEnd(feed, self._counts)
        self._engine = Engine(self._loop, dialect=options["dialect"])
        self._connections: dict[str, ServerConnection] = {}
        self._gone: dict[str, tuple[int, int]] = {}
        self._over = asyncio.Event()
        self._listener = listening_socket(options["host"], options["port"], "rosbridge", _CLIENTS)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)  # accepted sockets inherit it

    def run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        server = self._websockets.serve(
            self._client,
            sock=self._listener,
            ssl=self._access.context,
            origins=self._access.origins,
            process_request=self._judge,
            compression=None,  # compression would take longer than all other work
            max_size=LARGEST,
            write_limit=_WRITE_LIMIT,
            close_timeout=_CLOSING,
            ping_interval=_PING,
            ping_timeout=_PONG,
            logger=logging.Logger("armlab.bridge.servers.rosbridge", logging.ERROR),  # lower levels log tokens
        )
        running = asyncio.get_running_loop()
        async with server:
            host, port = self._listener.getsockname()
            label = "rosbridge" if self._access.context is None else "rosbridge, TLS"
            self._loop.ask(Listening(where=[f"{host}:{port} ({label})"]))
            running.add_reader(self._loop.fileno(), self._receive)
            while not self._over.is_set():
                self._tick()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._over.wait(), _TICK)
            running.remove_reader(self._loop.fileno())

    def _receive(self) -> None:
        """Handle messages from the loop and send the resulting messages to the clients."""
        messages = self._loop.receive()
        if messages is None:
            self._over.set()
            return
        for message in messages:
            if isinstance(message, bytes):
                self._engine.row(message, time.monotonic_ns())
            else:
                self._engine.text(message, time.monotonic_ns())
        for name, session in self._engine.sessions.items():
            self._send(self._connections[name], session)

    def _tick(self) -> None:
        """Handle timeouts and disconnect blocked clients."""
        now = time.monotonic_ns()
        self._engine.tick(now)
        self._receive()
        for name, session in self._engine.sessions.items():
            if session.outbox.is_stuck(now):
                self._connections[name].transport.abort()

    def _send(self, connection: ServerConnection, session: ClientSession) -> None:
        """Send a client its queued messages in one write unless earlier messages are unread."""
        transport = connection.transport
        if transport.get_write_buffer_size() > _WRITE_LIMIT or connection.state is not self._open:
            return
        if messages := session.outbox.take(_SEND_BUFFER):
            frames = self._websockets.frames
            texts = [frames.Frame(frames.Opcode.TEXT, data) for data in messages]
            transport.write(b"".join([one.serialize(mask=False) for one in texts]))

    def _judge(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the response that refuses a connection (too many clients, or a wrong token), or None to accept it."""
        if len(self._connections) >= _CLIENTS:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"Expected at most {_CLIENTS} clients.\n")
        if self._may_ask(request) is None:
            return connection.respond(
                HTTPStatus.UNAUTHORIZED, "Expected the header Authorization: Bearer with the correct token.\n"
            )
        return None

    def _may_ask(self, request: Request) -> bool | None:
        headers = request.headers.get_all("Authorization")
        return self._access.judge(",".join(headers) if headers else None)

    async def _client(self, connection: ServerConnection) -> None:
        """Serve one client until it disconnects."""
        name = "{}:{}".format(*connection.remote_address[:2])
        session = self._engine.join(name, bool(connection.request and self._may_ask(connection.request)))
        self._connections[name] = connection
        try:
            async for message in connection:
                self._engine.take(session, message, time.monotonic_ns())
                self._send(connection, session)
        except self._websockets.ConnectionClosed:
            pass
        finally:
            del self._connections[name]
            self._gone[name] = (session.outbox.sent, session.outbox.dropped)
            if len(self._gone) > _KEPT:
                del self._gone[next(iter(self._gone))]
            self._engine.leave(session)

    def _counts(self) -> Mapping[str, tuple[int, int]]:
        here = {name: (one.outbox.sent, one.outbox.dropped) for name, one in self._engine.sessions.items()}
        return {**self._gone, **here}


def _websockets() -> Any:
    try:
        import websockets.asyncio.server
        import websockets.frames
    except ImportError:
        raise MissingExtra(
            "Expected the package websockets for the rosbridge server, but it is not installed. Install it: pip "
            "install 'armlab[net]'."
        ) from None
    return websockets
