"""Zenoh sessions without multicast (`open_session`, `open_near`), addresses of labs, and publishers."""

from __future__ import annotations

import contextlib
import json
import queue
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple
from urllib.parse import parse_qsl

from armlab.bridge.net.sockets import is_here
from armlab.bridge.servers.zenoh.messages import key
from armlab.bridge.servers.zenoh.security import Security
from armlab.bridge.urls import split_url
from armlab.errors import ConfigError, LinkError, MissingExtra

_RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
_OPENED = 1500  # ms for the other end to accept a connection
_ROOM = 16  # messages queued per connection (the maximum); two would be too few while a process is not scheduled
_BEFORE_DROP = 20_000  # us before the first drop, because a slow reader may only be waiting for the processor
_BEFORE_CLOSE = 250_000  # us until a link with full buffers (seconds of data) closes; a blocked put delays declarations
_TRIES = 2  # attempts to become or find a router, because a router may exit between the two steps
_FOUND = 1.0  # s allowed for finding a router on this computer
_ANYWHERE = "0.0.0.0"
# Maximum size of a fragmented message. Our largest message, a reply to "about", has three texts of 2**17 bytes. Our
# router also forwards messages of other programs, such as small images.
_LARGEST = 2**20
_ANSWERS = 2**26  # bytes of all replies to a query: a few KiB from each of a thousand bridges
_UNUSED = "127.0.0.2"  # local address used only by programs that listen on every address

_open: set[Any] = set()
_lock = threading.Lock()
_watcher: list[threading.Thread] = []


def zenoh() -> Any:
    try:
        import zenoh as module
    except ImportError:
        raise MissingExtra(
            "Expected the package eclipse-zenoh, but it is not installed. Install it: pip install 'armlab[net]'."
        ) from None
    return module


def open_session(
    mode: Literal["router", "peer", "client"],
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    security: Security | None = None,
) -> Any:
    """Return a session, which is closed by `close_session` or at the end of the program.

    A "peer" discovers other programs through a router; a "client" communicates only through its router. Addresses are
    "HOST:PORT"; failed connections are retried indefinitely.
    """
    module, safe = zenoh(), security or Security()
    protocol = "tls" if safe.ca is not None else "tcp"
    values: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": [f"{protocol}/{place}" for place in listen],
        "connect/endpoints": [f"{protocol}/{place}" for place in connect],
        "connect/exit_on_failure": False,
        "connect/retry": _RETRY,
        "scouting/multicast/enabled": False,
        **({"scouting/delay": 0} if mode == "router" else {}),  # by default, a router waits 0.5 s for multicast
        "transport/unicast/open_timeout": _OPENED,
        "transport/link/rx/max_message_size": _LARGEST,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _BEFORE_DROP,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _BEFORE_CLOSE,
        **{f"transport/link/tx/queue/size/{priority}": _ROOM for priority in ("data", "data_low")},
        "transport/shared_memory/enabled": False,
        **safe.values(listens=bool(listen)),
    }
    config = module.Config()
    for name, value in values.items():
        config.insert_json5(name, json.dumps(value))
    try:
        session = module.open(config)
    except module.ZError as error:
        raise LinkError(f"Expected a Zenoh session, got {_short(error)}. Choose another address or port.") from None
    with _lock:
        _open.add(session)
        if not _watcher:
            _watcher.append(threading.Thread(target=_close_at_exit, name="zenoh at exit"))
            _watcher[0].start()
    return session


def open_near(
    host: str, port: int, router: str = "", security: Security | None = None, commands: bool = False
) -> tuple[Any, str]:
    """Return a server session and its location as text; the session is a router unless another router already uses the
    port.

    If another server's router uses the port, the session joins it and listens on a port chosen by the system. `router`
    is the "HOST:PORT" of a router on another computer.
    """
    safe = security or Security()
    protocol = "tls" if safe.ca is not None else "tcp"
    is_open = commands and not safe.is_safe  # whether any client could send commands
    if router:
        _check_router(router, is_open)
    else:
        port = port or _free_port(host)
    near = "127.0.0.1" if host == _ANYWHERE else host
    place = router or f"{near}:{port}"
    for _ in range(_TRIES):
        if not router:
            session = _opened("router", [f"{host}:{port}"], [], safe)
            if session is not None:
                return session, f"{protocol}/{host}:{port} (zenoh router)"
            _check_router_here(host, port, is_open)
        can_listen = safe.ca is None or safe.certificate is not None
        for own in (port if router and port else _free_port(host), _free_port(host)):
            session = _opened("peer", [f"{host}:{own}"] if can_listen else [], [place], safe)
            if session is None:
                continue
            if router or wait_for_router(session, _FOUND):
                where = f"{protocol}/{host}:{own} (zenoh, through" if can_listen else f"{protocol} (zenoh, only through"
                return session, f"{where} the router at {place})"
            close_session(session)
            break
    raise LinkError(
        f"Expected a Zenoh router at {place} or a free port, but the port is in use, or its router requires different "
        "certificates and passwords. Choose another `port`."
    )


def _opened(
    mode: Literal["router", "peer"], listen: Sequence[str], connect: Sequence[str], security: Security
) -> Any | None:
    """Return a session, or None if the port is in use."""
    try:
        return open_session(mode, listen, connect, security)
    except LinkError as error:
        if "in use" not in str(error):
            raise
        return None


def _free_port(host: str) -> int:
    """Return a free port, because Zenoh does not report a port chosen by the system."""
    with socket.socket() as probe:
        try:
            probe.bind((host, 0))
        except OSError as error:
            raise LinkError(
                f"Expected an address of this computer to listen on, got {host} ({error.strerror})."
            ) from None
        return int(probe.getsockname()[1])


def _check_router(router: str, is_open: bool) -> None:
    """Raise an error if the configured router would let any client send commands."""
    port = router.rpartition(":")[2]
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
        raise ConfigError(f"Expected a router such as 192.168.1.9:7447, got {router!r}.")
    if is_open and not is_here(router):
        raise ConfigError(
            f"Expected certificates and users, because `commands` lists this server and its router {router} is on "
            "another computer: any client of the router could send commands. Create both with armlab bridge "
            "certificates, or remove the server from `commands`."
        )
    _check_router_here("", int(port), is_open)


def _check_router_here(host: str, port: int, is_open: bool) -> None:
    """Raise an error if a router at our port lets any client send commands, or does not listen on our address."""
    with socket.socket() as probe:
        try:
            probe.bind((_UNUSED, port))
        except OSError:  # in use on every address or, on some systems, possibly on only one other address
            if is_open:
                raise ConfigError(
                    f"Expected a Zenoh router that listens only on this computer, but the router at port {port} "
                    "listens on every address, so any client could send commands. Make the router listen only on "
                    "127.0.0.1, choose another `port`, or create certificates and users with armlab bridge "
                    "certificates."
                ) from None
            return
    if host == _ANYWHERE:
        raise LinkError(
            f"Expected TCP port {port} to be free on every address, but another "
            "router already uses the port for connections from this computer only. "
            "Choose another `port`, or give both servers the same --listen."
        )


def wait_for_router(session: Any, patience: float) -> bool:
    """Return whether a peer finds a router or another peer before the timeout [s]."""
    until = time.monotonic() + patience
    while not (session.info.routers_zid() or session.info.peers_zid()):
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def close_session(session: Any) -> None:
    """Close a session unless it is already closed."""
    with _lock:
        known = session in _open
        _open.discard(session)
    if known:
        session.close()


def queried(session: Any, selector: str, patience: float) -> list[tuple[str, bytes]]:
    """Return the keys and bytes of all replies to a query, up to 64 MiB in total."""
    found, room = [], _ANSWERS
    for reply in session.get(selector, timeout=patience):
        if reply.ok is not None:
            data = reply.ok.payload.to_bytes()
            room -= len(data)
            if room < 0:
                break
            found.append((str(reply.ok.key_expr), data))
    return found


def _close_at_exit() -> None:
    """Close open sessions when the main thread ends, because Python waits for callback threads before `atexit`."""
    threading.main_thread().join()
    for session in list(_open):
        close_session(session)


def _short(error: Exception) -> str:
    """Return the text of a ZError without source locations."""
    return str(error).partition(" at /")[0].rstrip(".")


_PERIOD = 0.5  # s between queries to a bridge
_ANSWER = 2.0  # s for a reply


class Discovery:
    """Sends "about" queries, at most two per second to each bridge."""

    def __init__(self, session: Any, answered: Callable[[str, str, bytes], None]) -> None:
        self._session, self._answered = session, answered
        self._due: dict[tuple[str, str], float] = {}

    def ask(self, lab: str, robot: str) -> None:
        """Send a query if it is due."""
        now = time.monotonic()
        if now < self._due.get((lab, robot), 0.0):
            return
        self._due[lab, robot] = now + _PERIOD

        def take(reply: Any) -> None:
            if reply.ok is not None:
                self._answered(lab, robot, reply.ok.payload.to_bytes())

        with contextlib.suppress(zenoh().ZError):  # the session is being closed
            self._session.get(key(lab, robot, "about"), take, timeout=_ANSWER)


LAB = "lab"
"""Default name of a lab."""

PORT = 7447
"""Default port of Zenoh routers."""

_PATIENCE = 5.0  # s for the first connection
_TRIED = 0.1  # s between attempts to reach a router
_AGAIN = 0.1  # s between queries: a new session discovers the bridges one after another
_OPTIONS = ("ca", "secret")


class LabAddress(NamedTuple):
    """Address and security settings of a lab."""

    host: str = "127.0.0.1"
    port: int = PORT
    lab: str = LAB
    security: Security = Security()

    @classmethod
    def read(cls, url: str) -> LabAddress:
        """Parse a URL ``zenoh://HOST:PORT/LAB?ca=FILE&secret=FILE``; only the host is required."""
        parts = split_url(url)
        try:
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        lab = parts.path.strip("/")
        if parts.scheme != "zenoh" or not host or "/" in lab or "*" in lab:
            raise ConfigError(f"Expected an address such as zenoh://192.168.1.5:7447/lab1, got {url!r}.")
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        return cls.of(host, PORT if port is None else port, {"lab": lab, **options})

    @classmethod
    def of(cls, host: str, port: int, options: dict[str, str]) -> LabAddress:
        unknown = sorted(set(options) - {"lab", *_OPTIONS})
        if unknown:
            raise ConfigError(f"Expected only the options ca and secret in a zenoh link, got {', '.join(unknown)}.")
        return cls(host, port, options.get("lab") or LAB, Security.of(options))

    def open(self, patience: float = _PATIENCE) -> Any:
        """Return a session at this address; see `close_session`."""
        where = f"{self.host}:{self.port}"
        listen = ["127.0.0.1:0"] if self.security.ca is None and self.host.startswith("127.") else []
        session = open_session("peer", listen, [where], self.security)
        if not wait_for_router(session, patience):
            close_session(session)
            check = "certificates and passwords" if self.security.ca or self.security.secret else "that it is running"
            raise LinkError(
                f"Expected a bridge or a Zenoh router at {where} within {patience:g} s, got no connection. "
                f"Check {check}."
            )
        return session

    def open_behind(self, patience: float = _PATIENCE) -> Any:
        """Return a session that sends all messages through the router, regardless of the number of robots."""
        where, until = f"{self.host}:{self.port}", time.monotonic() + patience
        while True:
            try:
                return open_session("client", [], [where], self.security)
            except LinkError:
                if time.monotonic() > until:
                    raise LinkError(
                        f"Expected a Zenoh router at {where} within {patience:g} s, got no connection. Start "
                        "a router with armlab fleet router, or check the certificates and the password."
                    ) from None
                time.sleep(_TRIED)

    def ask(self, session: Any, selector: str, patience: float = _ANSWER) -> bytes:
        """Return the first reply to a query."""
        until = time.monotonic() + patience
        while not (found := queried(session, selector, patience)):
            if time.monotonic() > until:
                raise LinkError(
                    f"Expected a reply to {selector} at {self.host}:{self.port}, got none. Check that the bridge of "
                    "that robot is running and serves this lab."
                )
            time.sleep(_AGAIN)
        return found[0][1]


_WAITING = 2500  # rows queued for a slow recorder: 10 s of data from one arm
_LAST = 1.0  # s to send the queue when closing


class Publisher:
    """Publisher of one key, which sends only while the key has readers and drops messages for slow readers."""

    wanted: bool = False
    sent: int = 0
    dropped: int = 0

    def __init__(self, session: Any, key: str, changed: Callable[[], None] = lambda: None) -> None:
        self._changed = changed
        self._publisher = self._declared(session, key)
        self._listener = self._publisher.declare_matching_listener(self._matched)
        self.wanted = self.wanted or self._publisher.matching_status.matching

    def put(self, data: bytes, attachment: bytes | None = None) -> None:
        """Send a message if the key has readers."""
        if self.wanted:
            self._publisher.put(data, attachment=attachment)
            self.sent += 1

    def _declared(self, session: Any, key: str) -> Any:
        control = zenoh().CongestionControl.DROP
        return session.declare_publisher(key, congestion_control=control, express=True)

    def _matched(self, status: Any) -> None:
        self.wanted = status.matching
        self._changed()


class LatchedPublisher(Publisher):
    """Publisher that keeps its last message for late-joining readers, as rmw_zenoh does."""

    def __init__(self, session: Any, key: str) -> None:
        ext = zenoh().ext
        self._publisher = ext.declare_advanced_publisher(
            session,
            key,
            cache=ext.CacheConfig(1),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),  # else timestamps
            publisher_detection=True,
        )

    def put(self, data: bytes, attachment: bytes | None = None) -> None:
        self._publisher.put(data, attachment=attachment)


class BlockingPublisher(Publisher):
    """Publisher for readers that need every message: its thread waits for slow readers.

    A stalled reader is disconnected after a few seconds; once it has reconnected, message numbers reveal the gap.
    """

    def __init__(self, session: Any, key: str) -> None:
        self._queue: queue.Queue[tuple[bytes, bytes | None] | None] = queue.Queue(_WAITING)
        self._thread = threading.Thread(target=self._send, name=key, daemon=True)
        super().__init__(session, key)
        self._thread.start()

    def put(self, data: bytes, attachment: bytes | None = None) -> None:
        """Queue a message if the key has readers."""
        if self.wanted:
            try:
                self._queue.put_nowait((data, attachment))
            except queue.Full:
                self.dropped += 1

    def close(self) -> None:
        """Send the queued messages and stop; must be called before the session is closed."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=_LAST)
        self._thread.join(_LAST)

    def _declared(self, session: Any, key: str) -> Any:
        module = zenoh()
        return session.declare_publisher(
            key,
            congestion_control=module.CongestionControl.BLOCK,
            priority=module.Priority.DATA_LOW,  # a separate queue, which does not delay other readers
            express=True,
        )

    def _send(self) -> None:
        while (message := self._queue.get()) is not None:
            try:
                self._publisher.put(message[0], attachment=message[1])
                self.sent += 1
            except zenoh().ZError:  # the session is closed
                self.dropped += 1
