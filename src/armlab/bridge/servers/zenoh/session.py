"""Zenoh sessions without multicast, quick to connect again, always closed; addresses of labs, and publishers."""

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
_OPENED = 1500  # ms for the other end to answer a connection
_ROOM = 16  # messages that wait for a connection, the most there is: two would not last while a process is not run
_BEFORE_DROP = 20_000  # us for room, once when a reader falls behind: it may only not have been run
_BEFORE_CLOSE = 250_000  # us, after seconds in buffers: a put that waits holds up whoever declares, and they all others
_TRIES = 2  # to be router or else to find one: it may end just then
_FOUND = 1.0  # s in which a router on this computer is found
_ANYWHERE = "0.0.0.0"
# Bytes of a message that is put together of its parts. The largest of ours, an answer to "about", has three texts of
# 2**17 of the loop; a router of ours also passes on what programs of others send each other, such as small pictures.
_LARGEST = 2**20
_ANSWERS = 2**26  # bytes of all answers to a query: of a thousand bridges a few KiB each
_UNUSED = "127.0.0.2"  # of this computer; nobody listens there who does not listen at every address

_open: set[Any] = set()
_lock = threading.Lock()
_watcher: list[threading.Thread] = []


def zenoh() -> Any:
    try:
        import zenoh as module
    except ImportError:
        raise MissingExtra(
            "Expected eclipse-zenoh to speak Zenoh, got none. Install it: pip install 'armlab[net]'."
        ) from None
    return module


def open_session(
    mode: Literal["router", "peer", "client"],
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    security: Security | None = None,
) -> Any:
    """Return a session; `close_session` ends it. One that is forgotten is closed when the program ends.

    A "router" is found by others at its address; a "peer" finds them through a router; a "client" stays behind it.
    Addresses are "HOST:PORT"; connections that fail are tried again for ever.
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
        **({"scouting/delay": 0} if mode == "router" else {}),  # it would wait half a second for multicast
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
        raise LinkError(f"Expected a Zenoh session, but {_short(error)}. Choose another address or port.") from None
    with _lock:
        _open.add(session)
        if not _watcher:
            _watcher.append(threading.Thread(target=_close_at_exit, name="zenoh at exit"))
            _watcher[0].start()
    return session


def open_near(
    host: str, port: int, router: str = "", security: Security | None = None, commands: bool = False
) -> tuple[Any, str]:
    """Return the session of a server, and where it is in words: a router of its own, unless there is one.

    host, port : where others find it. When the port is taken, by the router of another server, that one is used, and
        the session is found directly at a port that the system chooses. router : "HOST:PORT" of a router elsewhere.
    """
    safe = security or Security()
    protocol = "tls" if safe.ca is not None else "tcp"
    is_open = commands and not safe.is_safe  # to whoever comes
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
        f"Expected a Zenoh router at {place} or a free port, but something else holds it, or it asks for other "
        "certificates and passwords. Choose another `port`."
    )


def _opened(
    mode: Literal["router", "peer"], listen: Sequence[str], connect: Sequence[str], security: Security
) -> Any | None:
    """Return a session, None when the port to listen at is taken."""
    try:
        return open_session(mode, listen, connect, security)
    except LinkError as error:
        if "in use" not in str(error):
            raise
        return None


def _free_port(host: str) -> int:
    """Return a port that is free now; Zenoh does not tell which one it was given."""
    with socket.socket() as probe:
        try:
            probe.bind((host, 0))
        except OSError as error:
            raise LinkError(
                f"Expected an address of this computer to listen at, got {host} ({error.strerror})."
            ) from None
        return int(probe.getsockname()[1])


def _check_router(router: str, is_open: bool) -> None:
    """Refuse that commands come from anybody by a router that is named."""
    port = router.rpartition(":")[2]
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
        raise ConfigError(f"Expected a router like 192.168.1.9:7447, got {router!r}.")
    if is_open and not is_here(router):
        raise ConfigError(
            f"Expected certificates and users, since `commands` names this server and its router {router} is not on "
            "this computer: whoever reaches it could command. Write them: armlab bridge certificates; or take the "
            "server out of `commands`."
        )
    _check_router_here("", int(port), is_open)


def _check_router_here(host: str, port: int, is_open: bool) -> None:
    """Refuse a router at our port that lets anybody command, or that is not found where we would be."""
    with socket.socket() as probe:
        try:
            probe.bind((_UNUSED, port))
        except OSError:  # taken by what listens at every address; or, where one cannot tell, maybe
            if is_open:
                raise ConfigError(
                    f"Expected no commands from other computers, but the Zenoh router at port {port} listens at every "
                    "address of this one, and whoever reaches it could command. Let it listen at 127.0.0.1 only, or "
                    "choose another `port`, or write certificates and users: armlab bridge certificates."
                ) from None
            return
    if host == _ANYWHERE:
        raise LinkError(
            f"Expected TCP port {port} to be free at every address, but another router listens there on this computer "
            "only. Choose another `port`, or give both servers the same --listen."
        )


def wait_for_router(session: Any, patience: float) -> bool:
    """Return whether a peer has found a router, or another peer."""
    until = time.monotonic() + patience
    while not (session.info.routers_zid() or session.info.peers_zid()):
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def close_session(session: Any) -> None:
    """Close a session; again is no mistake."""
    with _lock:
        known = session in _open
        _open.discard(session)
    if known:
        session.close()


def queried(session: Any, selector: str, patience: float) -> list[tuple[str, bytes]]:
    """Return what was answered to a query: keys and bytes; what is more than 64 MiB together is left out."""
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
    """Close what is open when the main thread has ended: Python waits for the threads of callbacks before `atexit`."""
    threading.main_thread().join()
    for session in list(_open):
        close_session(session)


def _short(error: Exception) -> str:
    """Return what a ZError says without the places in its sources."""
    return str(error).partition(" at /")[0].rstrip(".")


_PERIOD = 0.5  # s between two questions to a bridge
_ANSWER = 2.0  # s for an answer


class Discovery:
    """Asks "about" of bridges, each at most twice a second."""

    def __init__(self, session: Any, answered: Callable[[str, str, bytes], None]) -> None:
        self._session, self._answered = session, answered
        self._due: dict[tuple[str, str], float] = {}

    def ask(self, lab: str, robot: str) -> None:
        """Ask when it is time to."""
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
"""Name of a lab that was given none."""

PORT = 7447
"""Where Zenoh's routers listen."""

_PATIENCE = 5.0  # s for the first connection
_TRIED = 0.1  # s between two tries to reach a router
_AGAIN = 0.1  # s until it is asked again: who has just connected does not know all of those who could answer
_OPTIONS = ("ca", "secret")


class LabAddress(NamedTuple):
    """Where a lab is found."""

    host: str = "127.0.0.1"
    port: int = PORT
    lab: str = LAB
    security: Security = Security()

    @classmethod
    def read(cls, url: str) -> LabAddress:
        """Return the address in ``zenoh://HOST:PORT/LAB?ca=FILE&secret=FILE``; only the host is needed."""
        parts = split_url(url)
        try:
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        lab = parts.path.strip("/")
        if parts.scheme != "zenoh" or not host or "/" in lab or "*" in lab:
            raise ConfigError(f"Expected a place like zenoh://192.168.1.5:7447/lab1, got {url!r}.")
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        return cls.of(host, PORT if port is None else port, {"lab": lab, **options})

    @classmethod
    def of(cls, host: str, port: int, options: dict[str, str]) -> LabAddress:
        unknown = sorted(set(options) - {"lab", *_OPTIONS})
        if unknown:
            raise ConfigError(f"Expected only ca and secret as options of a zenoh link, got {', '.join(unknown)}.")
        return cls(host, port, options.get("lab") or LAB, Security.of(options))

    def open(self, patience: float = _PATIENCE) -> Any:
        """Return a session there; see `close_session`."""
        where = f"{self.host}:{self.port}"
        listen = ["127.0.0.1:0"] if self.security.ca is None and self.host.startswith("127.") else []
        session = open_session("peer", listen, [where], self.security)
        if not wait_for_router(session, patience):
            close_session(session)
            secrets = "its certificates and passwords fit" if self.security.ca or self.security.secret else "it runs"
            raise LinkError(
                f"Expected a bridge or a Zenoh router at {where} within {patience:g} s, but none let us in. "
                f"See whether {secrets}."
            )
        return session

    def open_behind(self, patience: float = _PATIENCE) -> Any:
        """Return a session all of whose messages go through the router, however many robots there are."""
        where, until = f"{self.host}:{self.port}", time.monotonic() + patience
        while True:
            try:
                return open_session("client", [], [where], self.security)
            except LinkError:
                if time.monotonic() > until:
                    raise LinkError(
                        f"Expected a Zenoh router at {where} within {patience:g} s, but none let us in. Start it: "
                        "armlab fleet router; or see whether certificates and password fit."
                    ) from None
                time.sleep(_TRIED)

    def ask(self, session: Any, selector: str, patience: float = _ANSWER) -> bytes:
        """Return the one answer to a query."""
        until = time.monotonic() + patience
        while not (found := queried(session, selector, patience)):
            if time.monotonic() > until:
                raise LinkError(
                    f"Expected an answer to {selector} at {self.host}:{self.port}, but none came. See whether the "
                    "bridge of that robot runs and serves this lab."
                )
            time.sleep(_AGAIN)
        return found[0][1]


_WAITING = 2500  # rows of a recorder that is slow: 10 s of one arm
_LAST = 1.0  # s for what waits at the end


class Publisher:
    """One key. Nothing is sent while nobody reads it; for a slow reader it is dropped."""

    def __init__(self, session: Any, key: str, changed: Callable[[], None] = lambda: None) -> None:
        self.wanted, self.sent, self.dropped = False, 0, 0
        self._changed = changed
        self._publisher = self._declared(session, key)
        self._listener = self._publisher.declare_matching_listener(self._matched)
        self.wanted = self.wanted or self._publisher.matching_status.matching

    def put(self, data: bytes, attachment: bytes | None = None) -> None:
        """Send when it is wanted."""
        if self.wanted:
            self._publisher.put(data, attachment=attachment)
            self.sent += 1

    def _declared(self, session: Any, key: str) -> Any:
        control = zenoh().CongestionControl.DROP
        return session.declare_publisher(key, congestion_control=control, express=True)

    def _matched(self, status: Any) -> None:
        self.wanted = status.matching
        self._changed()


class BlockingPublisher(Publisher):
    """The same for readers that must have everything: a thread of its own waits for the slow one.

    A reader that stands still loses its connection when the buffers on the way are full, after some seconds; it gets
    rows again when it has connected again, and the hole shows in their numbers.
    """

    def __init__(self, session: Any, key: str) -> None:
        self._queue: queue.Queue[tuple[bytes, bytes | None] | None] = queue.Queue(_WAITING)
        self._thread = threading.Thread(target=self._send, name=key, daemon=True)
        super().__init__(session, key)
        self._thread.start()

    def put(self, data: bytes, attachment: bytes | None = None) -> None:
        """Queue what is wanted."""
        if self.wanted:
            try:
                self._queue.put_nowait((data, attachment))
            except queue.Full:
                self.dropped += 1

    def close(self) -> None:
        """Send what waits, and end; call it before the session is closed."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=_LAST)
        self._thread.join(_LAST)

    def _declared(self, session: Any, key: str) -> Any:
        module = zenoh()
        return session.declare_publisher(
            key,
            congestion_control=module.CongestionControl.BLOCK,
            priority=module.Priority.DATA_LOW,  # a queue of its own: what others read goes on meanwhile
            express=True,
        )

    def _send(self) -> None:
        while (message := self._queue.get()) is not None:
            try:
                self._publisher.put(message[0], attachment=message[1])
                self.sent += 1
            except zenoh().ZError:  # the session is closed
                self.dropped += 1
